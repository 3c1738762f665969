"""Numbers that survive a change of machine.

The last bit of a sine differs between processors and libraries. A simulation feeds its results back, so that such
a bit would grow until the recording differs. Poses therefore live on a lattice so fine that no sensor sees it, and
are put back on it at every step: what is below is forgotten. Short binary numbers compress better, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

STEP = 2.0**-20
"""Pitch of the lattice: 0.95 micrometres, and as many microradians."""


def snap(value: float) -> float:
    """The nearest number of the lattice."""
    return round(value / STEP) * STEP


def snap_pose(pose: Pose2) -> Pose2:
    """The nearest pose of the lattice."""
    return Pose2(snap(pose.x), snap(pose.y), snap(pose.theta))


def short(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """A covariance to 12 binary digits: three and a half decimals are more than any covariance deserves.

    The diagonal grows by a thousandth, so that rounding cannot make it indefinite.
    """
    mantissa, exponent = np.frexp(covariance + 1e-3 * np.diag(np.diag(covariance)))
    return np.asarray(np.ldexp(np.round(mantissa * 4096.0), exponent - 12))
