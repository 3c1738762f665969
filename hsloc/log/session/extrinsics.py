"""Where the laser stands on the robot, and which frame is the robot: from /tf_static, /tf, or the user."""

from __future__ import annotations

from math import degrees, radians
from typing import TYPE_CHECKING

from hsloc.errors import LogFormatError
from hsloc.log.messages import definitions
from hsloc.log.messages.decoders import Undecodable, canonical_type, decoder_for, is_decodable
from hsloc.log.session.topic_selection import TF, TF_STATIC, carries
from hsloc.log.summary import Losses
from hsloc.log.transforms import FrameTree, Mounting, Transform3, laser_mounting
from hsloc.model import IDENTITY, Pose2
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hsloc.log.container import Container
    from hsloc.log.messages.decode import LinkMessage
    from hsloc.log.messages.decoders import Decoder

BASE_FRAMES = ("base_footprint", "base_link", "base")
"""Names to try where no odometry names the base, in this order."""
TILT_WARNING = radians(3.0)


def read_links(
    containers: Sequence[Container], topic: str, limit: int | None = None, warnings: list[RunWarning] | None = None
) -> Iterator[LinkMessage]:
    """All transforms on a topic, in the order of the log; at most `limit` messages of each file.

    A log can be read without them: what prevents reading them is added to `warnings`.
    """
    for container in containers:
        decoders: dict[int, Decoder] = {}
        for channel in container.channels.values():
            if not carries(channel, topic) or canonical_type(channel.typename) != definitions.TF_MESSAGE:
                continue
            try:
                if is_decodable(channel):
                    decoders[channel.id] = decoder_for(channel)
            except LogFormatError as error:
                if warnings is not None:
                    warnings.append(RunWarning(WarningCode.TRANSFORMS_UNREADABLE, f"transforms are not read: {error}"))
        if not decoders:
            continue
        # Damage is counted when the log is read for its events.
        for number, (_, _, channel_id, data) in enumerate(container.messages(decoders.keys(), Losses())):
            if limit is not None and number >= limit:
                break
            try:
                yield from decoders[channel_id](data)
            except Undecodable:
                continue


class Extrinsics:
    """The mounting of each laser frame; `warnings` grows with what had to be assumed."""

    def __init__(self, containers: Sequence[Container], base_frame: str | None, override: Pose2 | None) -> None:
        self._containers = containers
        self._override = override
        self._static = FrameTree()
        self.warnings: list[RunWarning] = []
        for link in read_links(containers, TF_STATIC, warnings=self.warnings):
            self._static.add(link.parent, link.child, link.transform)
        self._all: FrameTree | None = None
        self._known: dict[str, tuple[Mounting, str]] = {}
        self._spatial: dict[str, Transform3] = {}
        self.base_frame = base_frame if base_frame is not None else self._guessed_base()

    def of(self, laser_frame: str, T_frame_laser: Transform3 | None = None) -> Mounting:
        """The mounting of a laser's frame, or of a laser that stands elsewhere in the frame."""
        if T_frame_laser is None or self._override is not None:
            return self.found(laser_frame)[0]
        self.found(laser_frame)
        return laser_mounting(self._spatial.get(laser_frame, Transform3()) @ T_frame_laser)

    def found(self, laser_frame: str) -> tuple[Mounting, str]:
        """The mounting, and where it comes from: `option`, `/tf_static`, `/tf` or `identity`."""
        known = self._known.get(laser_frame)
        if known is None:
            known = self._known[laser_frame] = self._find(laser_frame)
        return known

    def between(self, target: str, source: str) -> Transform3 | None:
        """T_target_source from all that the log knows, or None."""
        transform = self._static.lookup(target, source)
        return transform if transform is not None else self._whole_tree().lookup(target, source)

    def _find(self, laser: str) -> tuple[Mounting, str]:
        if self._override is not None:
            return Mounting(self._override), "option"
        base = self.base_frame
        if base is not None and base == laser:
            return Mounting(IDENTITY), "same frame"
        if base is not None:
            transform, source = self._static.lookup(base, laser), TF_STATIC
            if transform is None:
                tree = self._whole_tree()
                transform, source = tree.lookup(base, laser), TF
                self._warn_if_moving(tree, base, laser)
            if transform is not None:
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
                return mounting, source
        self.warnings.append(
            RunWarning(
                WarningCode.EXTRINSICS_ASSUMED,
                f"no transform from {base or 'the base'} to {laser or 'the laser'} in /tf_static or /tf: the laser is "
                "assumed to be at the origin of the base",
                "give --laser-pose x,y,yaw",
            )
        )
        return Mounting(IDENTITY), "identity"

    def _whole_tree(self) -> FrameTree:
        """Static and dynamic transforms, the latest of each; static ones win."""
        if self._all is None:
            self._all = FrameTree()
            static = self._static.children()
            for link in read_links(self._containers, TF, warnings=self.warnings):
                if link.child not in static:
                    self._all.add(link.parent, link.child, link.transform)
            for link in read_links(self._containers, TF_STATIC):
                self._all.add(link.parent, link.child, link.transform)
        return self._all

    def _warn_if_moving(self, tree: FrameTree, base: str, laser: str) -> None:
        path = tree.path(base, laser)
        moving = sorted(frame for frame in (path[0] + path[1] if path else ()) if tree.is_moving(frame))
        if moving:
            self.warnings.append(
                RunWarning(
                    WarningCode.LASER_MOVES,
                    f"the laser's mounting moves during the log ({', '.join(moving)}); its last pose is used for all",
                )
            )

    def _guessed_base(self) -> str | None:
        static = next((frame for frame in BASE_FRAMES if frame in self._static), None)
        return static or next((frame for frame in BASE_FRAMES if frame in self._whole_tree()), None)
