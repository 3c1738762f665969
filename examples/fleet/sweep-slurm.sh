#!/bin/bash
# A sweep in 4 parts as a job array: sbatch sweep-slurm.sh; then: hsloc sweep --merge --out nightly
# The range may begin anywhere: the part is found from SLURM_ARRAY_TASK_ID, _MIN, _STEP and _COUNT.
#SBATCH --job-name=hsloc-sweep
#SBATCH --array=0-3
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=02:00:00
#SBATCH --requeue
#SBATCH --output=%x-%A-%a.txt
export NUMBA_NUM_THREADS="${SLURM_CPUS_PER_TASK:-1}"
exec hsloc sweep logs/*.mcap --out nightly --seeds 0-9 --shard auto --no-progress
