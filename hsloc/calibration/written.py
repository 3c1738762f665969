"""A calibration as it is written: YAML for `--calibration`, a URDF joint, a command for tf2, JSON and lines of text."""

from __future__ import annotations

import json
import re
from math import degrees, pi
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from hsloc.calibration.estimator import NAMES, UNITS
from hsloc.model.pose2 import wrap_angle

if TYPE_CHECKING:
    from hsloc.calibration.calibrate import LogCalibration
    from hsloc.model import Pose2

_PLAIN = re.compile(r"[A-Za-z0-9_/.~-]+")


def as_json(found: LogCalibration) -> dict[str, Any]:
    """Everything as plain data; `interval` is half of the 95 % interval, None where a value is not determined."""
    estimate = found.estimate
    values = _values(found)
    track, track_sigma = estimate.track
    return {
        "topic": found.topic,
        "parameters": {
            name: {
                "value": values[k],
                "unit": UNITS[k],
                "interval": estimate.quantile * float(estimate.sigmas[k]) if estimate.determined[k] else None,
                "not_determined": estimate.reasons.get(name),
            }
            for k, name in enumerate(NAMES)
        },
        "track_factor": {"value": track, "interval": estimate.quantile * track_sigma},
        "wheels": {
            name: {"value": value, "unit": "m", "interval": estimate.quantile * sigma}
            for name, (value, sigma) in _wheels(found).items()
        },
        "covariance": [[float(value) for value in row] for row in estimate.covariance],
        "steps": estimate.steps,
        "outliers": estimate.outliers,
        "residual_m": estimate.residual_m,
        "residual_rad": estimate.residual_rad,
        "path_length_m": estimate.driven_m,
        "rotation_rad": estimate.turned_rad,
        "log_mounting": [found.nominal.x, found.nominal.y, found.nominal.theta],
        "passes": found.passes,
    }


def as_yaml(found: LogCalibration) -> str:
    """The file that `hsloc.log.read_calibration` reads; what is not determined is in comments."""
    estimate, values = found.estimate, _values(found)
    half = estimate.quantile * estimate.sigmas
    source = ", ".join(path.name for path in found.summary.paths)
    lines = [
        f"# Made by hsloc calibrate from {json.dumps(source)[1:-1]}; use it with hsloc replay LOG --calibration FILE.",
        "# In comments: half of the 95 % interval.",
        "odometry:",
    ]

    def add(k: int, indent: str, keep: bool) -> None:
        line = f"{NAMES[k]}: {values[k]:.6f}"
        if estimate.determined[k]:
            lines.append(f"{indent}{line}  # ± {half[k]:.6f} {UNITS[k]}".rstrip())
        else:
            lines.append(f"{indent}{'' if keep else '# '}{line}  # not determined: {estimate.reasons[NAMES[k]]}")

    for k in range(3):
        add(k, "  ", True)
    lines += ["lidars:", f"  {_key(found.topic)}:"]
    has_mounting = bool(estimate.determined[3:6].any())
    for k in range(3, 7):
        add(k, "    ", has_mounting or k == 6)
    shown = [k for k in range(7) if estimate.determined[k]]
    names = ", ".join(NAMES[k] for k in shown)
    lines += ["estimate:", f"  parameters: [{names}]", "  covariance:"]
    lines += [f"  - [{', '.join(f'{estimate.covariance[i, j]:.6e}' for j in shown)}]" for i in shown]
    if not shown:
        lines[-1] += " []"
    return "\n".join(lines) + "\n"


def as_urdf(found: LogCalibration) -> str:
    """A fixed joint from the base to the laser. Height and tilt are not seen in the plane."""
    pose, base, laser = _placed(found)
    roll = pi if found.summary.laser_flipped else 0.0
    return (
        "<!-- By hsloc calibrate. z, roll and pitch are not seen by a planar calibration: keep your own. -->\n"
        f'<joint name={quoteattr(f"{base}_to_{laser}")} type="fixed">\n'
        f"  <parent link={quoteattr(base)}/>\n"
        f"  <child link={quoteattr(laser)}/>\n"
        f'  <origin xyz="{pose.x:.6f} {pose.y:.6f} 0" rpy="{roll:.6f} 0 {pose.theta:.6f}"/>\n'
        "</joint>\n"
    )


def as_static_transform(found: LogCalibration) -> str:
    """The command that publishes the mounting on /tf_static."""
    from shlex import quote

    pose, base, laser = _placed(found)
    roll = f" --roll {pi:.6f}" if found.summary.laser_flipped else ""
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {pose.x:.6f} --y {pose.y:.6f}{roll} --yaw {pose.theta:.6f} "
        f"--frame-id {quote(base)} --child-frame-id {quote(laser)}"
    )


def as_lines(found: LogCalibration) -> list[str]:
    """For people."""
    estimate, values = found.estimate, _values(found)
    half = estimate.quantile * estimate.sigmas
    odom = found.summary.odom_topic
    lines = [
        f"{found.topic} against {odom}: {estimate.driven_m:.1f} m, {degrees(estimate.turned_rad):.0f} deg of rotation",
        f"{estimate.steps} steps were compared, {estimate.outliers} of them outliers",
        f"left over of a step, median: {1000.0 * estimate.residual_m:.1f} mm, {degrees(estimate.residual_rad):.3f} deg",
        f"{'':<16}{'value':>12}{'95 %':>13}",
    ]
    logged = (None, None, None, found.nominal.x, found.nominal.y, found.nominal.theta, None)
    for k, name in enumerate(NAMES):
        if not estimate.determined[k]:
            continue
        beside = "" if logged[k] is None else f"  (the log: {logged[k]:.4f})"
        lines.append(f"{name:<16}{values[k]:>12.5f}  ± {half[k]:<9.5f} {UNITS[k]}{beside}".rstrip())
        if name == "turn_per_metre" and estimate.determined[:2].all():
            track, sigma = estimate.track
            lines.append(f"{'track':<16}{track:>12.5f}  ± {estimate.quantile * sigma:<9.5f} of the assumed track")
    for name, (value, sigma) in _wheels(found).items():
        lines.append(f"{name:<16}{value:>12.5f}  ± {estimate.quantile * sigma:<9.5f} m")
    reasons: dict[str, list[str]] = {}
    for name, reason in estimate.reasons.items():
        reasons.setdefault(reason, []).append(name)
    lines += [f"not determined: {', '.join(names)} ({reason})" for reason, names in reasons.items()]
    return lines


def _wheels(found: LogCalibration) -> dict[str, tuple[float, float]]:
    """Radii and track with standard deviations, where odometry is made of wheels and the motion determines them."""
    if found.wheels is None or not found.estimate.determined[:3].all():
        return {}
    return found.estimate.wheels(*found.wheels)


def _values(found: LogCalibration) -> list[float]:
    """The values, the time offset in all that is to be added to the stamps."""
    values = found.estimate.values.copy()
    values[5] = wrap_angle(float(values[5]))
    values[6] = found.time_offset_s if found.estimate.determined[6] else 0.0
    return [float(value) for value in np.round(values, 6) + 0.0]


def _placed(found: LogCalibration) -> tuple[Pose2, str, str]:
    summary = found.summary
    return found.estimate.T_base_laser, summary.base_frame or "base_link", summary.laser_frame or "laser"


def _key(topic: str) -> str:
    """A key of YAML."""
    return topic if _PLAIN.fullmatch(topic) else json.dumps(topic)
