"""What the proof of a match costs, and how much the pose that it starts from is worth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from hsloc.benchmark.cases import LEVELS, window_at
from hsloc.matching import CertificateParameters, HarmonySearch, Hide, LikelihoodField, Match, StopReason, certify

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.benchmark.cases import Cases
    from hsloc.matching import Window

    F64 = NDArray[np.float64]

SEEDS = ("HIDE", "HS", "window's centre")
"""Where the proof starts from: what a search found, or the prediction as it is."""
_BOXES = 10_000_000


@dataclass(frozen=True, slots=True)
class CertificateResult:
    """The proofs of all cases of a level, from one kind of start; times are processor time of the proof alone, in
    milliseconds.

    `optimal`, `distinct`: the shares for which that was proven. `corrected`: the share in which the proof found a pose
    that is fitter by more than epsilon. `worst_gap`: the largest gap.
    """

    level: str
    seed: str
    cases: int
    optimal: float
    distinct: float
    corrected: float
    worst_gap: float
    median_ms: float
    p95_ms: float
    median_boxes: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def measure_certificates(
    cases: Cases, progress: Callable[[float], None] = lambda share: None
) -> tuple[CertificateResult, ...]:
    """Certify every case of every level, from each kind of start, with the default parameters and no limit of work."""
    field = LikelihoodField.from_grid(cases.grid)
    parameters = replace(CertificateParameters(), max_boxes=_BOXES)
    results: list[CertificateResult] = []
    for level, half in LEVELS.items():
        for seed in SEEDS:
            rows = []
            for index, scan in enumerate(cases.scans):
                window = window_at(cases.starts[level][index], half)
                start = _start(seed, scan, field, window, index)
                if index == 0:
                    certify(start, scan, field, window, parameters)
                begin = process_time()
                certificate = certify(start, scan, field, window, parameters).certificate
                seconds = process_time() - begin
                assert certificate is not None
                rows.append(
                    (
                        certificate.is_optimal,
                        certificate.is_distinct,
                        certificate.gain > parameters.epsilon,
                        certificate.gap,
                        1e3 * seconds,
                        certificate.boxes,
                    )
                )
                progress((len(results) + (index + 1) / len(cases)) / (len(LEVELS) * len(SEEDS)))
            table = np.array(rows, dtype=np.float64)
            optimal, distinct, corrected = (float(share) for share in table[:, :3].mean(axis=0))
            results.append(
                CertificateResult(
                    level=level,
                    seed=seed,
                    cases=len(cases),
                    optimal=optimal,
                    distinct=distinct,
                    corrected=corrected,
                    worst_gap=float(table[:, 3].max()),
                    median_ms=float(np.median(table[:, 4])),
                    p95_ms=float(np.percentile(table[:, 4], 95)),
                    median_boxes=float(np.median(table[:, 5])),
                )
            )
    return tuple(results)


def _start(seed: str, scan: F64, field: LikelihoodField, window: Window, index: int) -> Match:
    if seed == "HIDE":
        return Hide().match(scan, field, window, np.random.default_rng(index))
    if seed == "HS":
        return HarmonySearch().match(scan, field, window, np.random.default_rng(index))
    covariance = np.diag(np.square(window.half_widths()) / 3.0)
    return Match(window.centre, field.fitness(scan, window.centre), covariance, 1, StopReason.BUDGET)
