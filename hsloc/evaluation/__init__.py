"""Errors of an estimate against its reference, and the quality of maps."""

from hsloc.evaluation.metrics import Comparison, Evaluation, RelativeError, compare, evaluate, write_json
from hsloc.evaluation.relations import RelationsResult, evaluate_relations, read_relations
from hsloc.evaluation.rpe import Delta
from hsloc.evaluation.statistics import PoseStatistics, Statistics
from hsloc.trajectory_io.reader import read_tum
from hsloc.trajectory_io.tum import write_tum

__all__ = [
    "Comparison",
    "Delta",
    "Evaluation",
    "PoseStatistics",
    "RelationsResult",
    "RelativeError",
    "Statistics",
    "compare",
    "evaluate",
    "evaluate_relations",
    "read_relations",
    "read_tum",
    "write_json",
    "write_tum",
]
