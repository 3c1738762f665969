"""HOW WELL: an estimate against its reference, and what can be said without one."""

from hsloc.evaluation.metrics import Evaluation, evaluate, write_json
from hsloc.evaluation.relations import evaluate_relations, read_relations
from hsloc.evaluation.rpe import Delta
from hsloc.evaluation.statistics import Statistics
from hsloc.trajectory_io.tum import read_tum, write_tum

__all__ = [
    "Delta",
    "Evaluation",
    "Statistics",
    "evaluate",
    "evaluate_relations",
    "read_relations",
    "read_tum",
    "write_json",
    "write_tum",
]
