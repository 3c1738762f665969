"""The exact matcher: the fittest pose of the window up to epsilon, and the proof of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from hsloc.matching.certificate import CertificateParameters, certify
from hsloc.matching.hide import Hide
from hsloc.matching.match import Match, Matcher, StopReason
from hsloc.parameters import Parameters

if TYPE_CHECKING:
    import numpy as np
    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.window import Window


@dataclass(frozen=True, slots=True, kw_only=True)
class Exact(Parameters):
    """Branch and bound over the continuous window, from the pose that HIDE finds.

    The pose that HIDE finds makes the proof shorter (benchmarks/README.md) and decides nothing else: a fitter pose by
    more than epsilon is found whatever the search missed, unless `certificate.max_boxes` does not suffice.
    """

    seed: Hide = field(default_factory=Hide)
    certificate: CertificateParameters = field(default_factory=CertificateParameters)

    def match(self, points: NDArray[np.float64], field: LikelihoodField, window: Window, rng: Generator) -> Match:
        """See `Matcher`; the Match has a certificate, and its evaluations count the boxes bounded too."""
        found = certify(self.seed.match(points, field, window, rng), points, field, window, self.certificate)
        if found.certificate is None:
            return found
        stopped = StopReason.PROVEN if found.certificate.is_optimal else StopReason.BUDGET
        return replace(found, evaluations=found.evaluations + found.certificate.boxes, stopped=stopped)


def heuristic(matcher: Matcher) -> Matcher:
    """The search within an exact matcher, where many windows are searched and one of them is believed later."""
    return matcher.seed if isinstance(matcher, Exact) else matcher
