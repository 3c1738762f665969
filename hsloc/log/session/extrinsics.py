"""Where the laser stands on the robot, and which frame is the robot: from /tf_static, /tf, a calibration, or the user.

A calibration file is YAML that `hsloc calibrate` writes and `--calibration` reads::

    odometry: {scale: 1.012, rotation_scale: 0.987, turn_per_metre: 0.0004}
    lidars:
      /scan: {x: 0.21, y: 0.0, yaw: 0.012, time_offset: -0.031}

Metres, radians and seconds; `time_offset` is added to the stamps of the topic. What is left out stays as it is; `x`,
`y` and `yaw` are given together or not at all. Further keys, such as the intervals of an estimate, are for people.
"""

from __future__ import annotations

from dataclasses import replace
from math import degrees, radians
from typing import TYPE_CHECKING, Any, NamedTuple

from hsloc.errors import ConfigError, TopicError
from hsloc.log.session.transform_topics import BASE_FRAMES, last_name, read_links
from hsloc.log.transforms import FrameTree, Mounting, Transform3, differ, laser_mounting
from hsloc.model import IDENTITY, Pose2, wrap_angle
from hsloc.model.calibration import Calibration, LidarCalibration, OdometryCorrection
from hsloc.warnings import RunWarning, WarningCode
from hsloc.yaml_table import is_number, load_table

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from hsloc.log.container import Container
    from hsloc.log.session.transform_topics import TransformTopics
    from hsloc.log.summary import ReadOptions

TILT_WARNING = radians(3.0)
_LISTED = 12

_ODOMETRY = {"scale": (0.5, 2.0), "rotation_scale": (0.5, 2.0), "turn_per_metre": (-1.0, 1.0)}
"""Keys and limits: what lies beyond is a mistake of units or of the file."""
_LIDAR = {"x": (-100.0, 100.0), "y": (-100.0, 100.0), "yaw": (-7.0, 7.0), "time_offset": (-1e6, 1e6)}
_REMEDY = "; write it with `hsloc calibrate`"


class KnownMountings(NamedTuple):
    """Mountings by the laser's frame that are better known than by the log: in the plane, and in space."""

    calibrated: Mapping[str, Pose2]
    chosen: Mapping[str, Transform3]

    @staticmethod
    def of(options: ReadOptions, frames: Iterable[tuple[str, str]]) -> KnownMountings:
        """Those of a calibration, and those chosen among several; `frames` are pairs of topic and frame."""
        calibration = options.calibration
        lidars = {} if calibration is None else {frame: calibration.lidar(topic) for topic, frame in frames}
        calibrated = {frame: each.T_base_laser for frame, each in lidars.items() if each and each.T_base_laser}
        return KnownMountings(calibrated, dict(options.mountings))


NOTHING_KNOWN = KnownMountings({}, {})


class Extrinsics:
    """The mounting of each laser frame; `warnings` grows with what had to be assumed."""

    def __init__(
        self,
        containers: Sequence[Container],
        topics: TransformTopics,
        base_frame: str | None,
        override: Pose2 | None,
        assumed: Collection[str] = (),
        known: KnownMountings = NOTHING_KNOWN,
    ) -> None:
        """`assumed` are laser frames whose mounting was assumed when the log was written."""
        self._containers = containers
        self._topics = topics
        self._override = override
        self._assumed = assumed
        self._calibrated, self._chosen = known
        self._static = FrameTree()
        self.warnings: list[RunWarning] = []
        for link in read_links(containers, topics.static, warnings=self.warnings):
            self._static.add(link.parent, link.child, link.transform)
        self._all: FrameTree | None = None
        self._known: dict[str, tuple[Mounting, str]] = {}
        self._spatial: dict[str, Transform3] = {}
        self._alternatives: dict[str, list[Transform3]] = {}
        self.base_frame = base_frame if base_frame is not None else self._guessed_base()

    def of(self, laser_frame: str, T_frame_laser: Transform3 | None = None) -> Mounting:
        """The mounting of a laser's frame, or of a laser that stands elsewhere in the frame."""
        if T_frame_laser is None or self._override is not None or laser_frame in self._calibrated:
            return self.found(laser_frame)[0]
        self.found(laser_frame)
        return laser_mounting(self._spatial.get(laser_frame, Transform3()) @ T_frame_laser)

    def in_space(self, frame: str) -> Transform3:
        """T_base_frame in space, the identity where it is not known; a mounting that was given is in the plane."""
        if self._override is not None:
            return Transform3.from_pose2(self._override)
        stated = self.found(frame)[0]
        in_space = self._spatial.get(frame, Transform3())
        if frame not in self._calibrated:
            return in_space
        # Height and tilt stay as the log states them.
        moved = stated.T_base_laser @ in_space.to_pose2().inverse()
        return Transform3.from_pose2(moved) @ in_space

    def found(self, laser_frame: str) -> tuple[Mounting, str]:
        """The mounting, and where it comes from: `option`, topics of transforms, `same frame` or `identity`."""
        known = self._known.get(laser_frame)
        if known is None:
            known = self._known[laser_frame] = self._find(laser_frame)
        return known

    def alternatives(self, laser: str) -> tuple[Transform3, ...]:
        """The T_base_laser that differ in the plane, where the log states several and none was chosen."""
        self.found(laser)
        return tuple(self._alternatives.get(laser, ()))

    def require(self, base: str, known: Sequence[str | None]) -> None:
        """Raise TopicError where the log has transforms but not a base, whose prefix may be that of `known` frames."""
        if base in known or any(self._static.resolve(base, frame or "") for frame in known):
            return
        tree = self._whole_tree()
        frames = tree.frames()
        if frames and not any(tree.resolve(base, frame or "") for frame in known):
            there = ", ".join(frames[:_LISTED]) + (f" and {len(frames) - _LISTED} more" if frames[_LISTED:] else "")
            raise TopicError(
                f"{self._containers[0].path}: no frame {base}, or several of that name; --base-frame may be {there}"
            )

    def between(self, target: str, source: str) -> Transform3 | None:
        """T_target_source from all that the log knows, or None."""
        return self._lookup(target, source)[0]

    def of_frame(self, frame: str) -> Transform3:
        """T_base_frame of any frame as the log states it, the identity where it does not."""
        found = None if self.base_frame is None else self.between(self.base_frame, frame)
        return Transform3() if found is None else found

    def _lookup(self, target: str, source: str) -> tuple[Transform3 | None, FrameTree]:
        """T_target_source and the tree that says so; frames may lack their prefix."""
        for tree in (self._static, self._whole_tree):
            tree = tree if isinstance(tree, FrameTree) else tree()
            to, of = tree.resolve(target, source), tree.resolve(source, target)
            transform = tree.lookup(to, of) if to is not None and of is not None else None
            if transform is not None:
                return transform, tree
        return None, self._whole_tree()

    def _find(self, laser: str) -> tuple[Mounting, str]:
        if self._override is not None:
            return Mounting(self._override), "option"
        if laser in self._calibrated:
            return replace(self._stated(laser)[0], T_base_laser=self._calibrated[laser]), "calibration"
        return self._stated(laser)

    def _stated(self, laser: str) -> tuple[Mounting, str]:
        """What the log says."""
        base = self.base_frame
        if base is not None and base == laser:
            return Mounting(IDENTITY), "same frame"
        if base is not None:
            transform, tree = self._lookup(base, laser)
            transform = self._chosen.get(laser, transform)
            is_given = laser in self._chosen or laser in self._calibrated
            if tree is not self._static and not is_given:
                self._warn_if_moving(tree, base, laser)
            if transform is not None:
                if not is_given:
                    self._warn_if_restated(tree, base, laser)
                    self._warn_if_unturned(tree, base, laser)
                self._spatial[laser] = transform
                mounting = laser_mounting(transform)
                if mounting.tilt > TILT_WARNING:
                    self.warnings.append(
                        RunWarning(
                            WarningCode.LASER_TILTED,
                            f"the laser {laser} is tilted by {degrees(mounting.tilt):.1f} deg; "
                            "ranges are used as if it were level",
                        )
                    )
                if laser in self._assumed:
                    self.warnings.append(
                        RunWarning(
                            WarningCode.EXTRINSICS_ASSUMED,
                            f"the mounting of {laser} was assumed when this log was converted",
                            "give --laser-pose x,y,yaw",
                        )
                    )
                    return mounting, "identity"
                topics = self._topics.static if tree is self._static else self._topics.dynamic
                return mounting, ", ".join(sorted(topics))
        self.warnings.append(
            RunWarning(
                WarningCode.EXTRINSICS_ASSUMED,
                f"no transform from {base or 'the base'} to {laser or 'the laser'} in {self._topics.names}: the laser "
                "is assumed to be at the origin of the base",
                "give --laser-pose x,y,yaw, which hsloc calibrate finds",
            )
        )
        return Mounting(IDENTITY), "identity"

    def _whole_tree(self) -> FrameTree:
        """Static and dynamic transforms, the latest of each; static ones win."""
        if self._all is None:
            self._all = FrameTree()
            static = self._static.children()
            for link in read_links(self._containers, self._topics.dynamic, warnings=self.warnings):
                if link.child not in static:
                    self._all.add(link.parent, link.child, link.transform)
            for link in read_links(self._containers, self._topics.static):
                self._all.add(link.parent, link.child, link.transform)
        return self._all

    def _warn_if_moving(self, tree: FrameTree, base: str, laser: str) -> None:
        path = tree.path(base, laser)
        moving = sorted(frame for frame in (path[0] + path[1] if path else ()) if tree.is_moving(frame))
        few = [frame for frame in moving if tree.alternates(frame)]
        for frame in few:
            self._warn_of_places(sorted(self._topics.dynamic), frame, tree.statements(frame), "the last is used")
            self._add_alternatives(tree, base, laser, frame, tree.statements(frame))
        if len(few) < len(moving):
            self.warnings.append(
                RunWarning(
                    WarningCode.LASER_MOVES,
                    f"the laser's mounting moves during the log ({', '.join(moving)}); its last pose is used for all",
                )
            )

    def _warn_if_unturned(self, tree: FrameTree, base: str, laser: str) -> None:
        """Transforms to the laser whose quaternions were not filled, or hold angles."""
        path = tree.path(tree.resolve(base, laser) or base, tree.resolve(laser, base) or laser)
        for frame in path[0] + path[1] if path else ():
            if frame in tree.unturned:
                values = ", ".join(f"{value:g}" for value in tree.unturned[frame])
                self.warnings.append(
                    RunWarning(
                        WarningCode.EXTRINSICS_UNTURNED,
                        f"the transform to {frame} has the quaternion ({values}), which is no rotation: how {laser} is "
                        "turned is not known",
                        "give --laser-pose x,y,yaw, which hsloc calibrate finds",
                    )
                )

    def _warn_if_restated(self, tree: FrameTree, base: str, laser: str) -> None:
        """Static transforms that are stated twice with different values: the later ones were taken."""
        path = tree.path(tree.resolve(base, laser) or base, tree.resolve(laser, base) or laser)
        for frame in path[0] + path[1] if path else (laser,):
            statements, topics = self._static.statements(frame), sorted(self._topics.static)
            dynamic = self._topics.stated.get(frame)
            if statements and dynamic is not None and all(differ(dynamic, each) for each in statements):
                statements, topics = [dynamic, *statements], [*topics, *sorted(self._topics.dynamic)]
            if len(statements) > 1:
                self._warn_of_places(topics, frame, statements, f"the last that leads to {base} is used")
                self._add_alternatives(tree, base, laser, frame, statements)

    def _add_alternatives(
        self, tree: FrameTree, base: str, laser: str, frame: str, statements: Sequence[tuple[str, Transform3]]
    ) -> None:
        """Note the mountings that follow from the statements of a frame on the way to a laser."""
        target, source = tree.resolve(base, laser) or base, tree.resolve(laser, base) or laser
        kept = self._alternatives.setdefault(laser, [])
        for statement in statements:
            found = tree.lookup_if(frame, statement, target, source)
            if found is not None and all(_differ_in_plane(found, each) for each in kept):
                kept.append(found)

    def _warn_of_places(
        self, topics: Sequence[str], frame: str, statements: Sequence[tuple[str, Transform3]], taken: str
    ) -> None:
        places = [_in_plane(transform) for _, transform in statements]
        if len({*places}) < len(places):
            places = [
                f"{text}, {each.translation[2]:.3f} m high" for text, (_, each) in zip(places, statements, strict=True)
            ]
        listed = " and ".join(
            f"{parent} -> {frame} at {text}" for text, (parent, _) in zip(places, statements, strict=True)
        )
        self.warnings.append(
            RunWarning(
                WarningCode.EXTRINSICS_RESTATED,
                f"{', '.join(topics)} states the place of {frame} {len(statements)} times: {listed}; {taken}",
                "choose with --laser-pose x,y,yaw",
            )
        )

    def _guessed_base(self) -> str | None:
        for tree in (self._static, self._whole_tree()):
            for name in BASE_FRAMES:
                found = sorted(frame for frame in tree.frames() if last_name(frame) == name)
                if found:
                    return name if name in found else found[0]
        return None


def _differ_in_plane(first: Transform3, second: Transform3) -> bool:
    """Whether two mountings differ in what counts in the plane."""
    a, b = laser_mounting(first), laser_mounting(second)
    return a.flipped != b.flipped or differ(
        ("", Transform3.from_pose2(a.T_base_laser)), ("", Transform3.from_pose2(b.T_base_laser))
    )


def _in_plane(transform: Transform3) -> str:
    pose = transform.to_pose2()
    return f"{pose.x:.3f},{pose.y:.3f},{pose.theta:.3f}"


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file. Raises ConfigError that names the file and the key."""
    values = load_table(path, "calibration", _REMEDY)
    if not {"odometry", "lidars"} & values.keys():
        raise ConfigError(f"{path}: has neither odometry nor lidars, so it is no calibration{_REMEDY}")
    odometry = _numbers(path, "odometry", values.get("odometry") or {}, _ODOMETRY)
    lidars = values.get("lidars") or {}
    if not isinstance(lidars, dict):
        raise ConfigError(f"{path}: lidars must be a table of topics{_REMEDY}")
    found = []
    for topic, each in lidars.items():
        numbers = _numbers(path, f"lidars: {topic}", each or {}, _LIDAR)
        place = [numbers.get(name) for name in ("x", "y", "yaw")]
        given = [number for number in place if number is not None]
        if len(given) not in (0, 3):
            raise ConfigError(f"{path}: lidars: {topic}: give x, y and yaw together, or none of them")
        pose = Pose2(given[0], given[1], wrap_angle(given[2])) if given else None
        found.append((str(topic), LidarCalibration(pose, numbers.get("time_offset", 0.0))))
    return Calibration(OdometryCorrection(**odometry), tuple(found))


def _numbers(path: Path, where: str, values: Any, limits: dict[str, tuple[float, float]]) -> dict[str, float]:
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: {where} must be a table of {', '.join(limits)}{_REMEDY}")
    for name, value in values.items():
        if name not in limits:
            raise ConfigError(f"{path}: {where}: unknown key {name!r}; they are {', '.join(limits)}")
        low, high = limits[name]
        if not is_number(value) or not low <= value <= high:
            raise ConfigError(f"{path}: {where}: {name} is {value!r}; it must be a number from {low:g} to {high:g}")
    return {name: float(value) for name, value in values.items()}
