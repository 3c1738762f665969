"""Which topics carry the transforms of the robot whose scans are read, and which of their links is its odometry.

Transforms are found by their type, in any namespace (`/robot1/tf`, `/robot1/tf_static`), with frames that have prefixes
or none. Of several namespaces the one that holds the scans' frame counts, nearest to the scans' own namespace first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.errors import LogFormatError
from hsloc.log.messages import definitions
from hsloc.log.messages.decoders import Undecodable, canonical_type, decoder_for, is_decodable
from hsloc.log.summary import Losses
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from hsloc.log.container import Channel, Container
    from hsloc.log.messages.decode import LinkMessage
    from hsloc.log.messages.decoders import Decoder
    from hsloc.log.transforms import Transform3

MAP_FRAME = "map"
BASE_FRAMES = ("base_footprint", "base_link", "base")
"""Names to try where no odometry names the base, in this order."""
_LINKS_AT_OPENING = 2000
"""Messages of a file that are read to learn which links there are."""


def last_name(frame: str) -> str:
    """The name of a frame without its prefixes: `robot1/base_link` is a `base_link`."""
    return frame.rpartition("/")[2]


def is_map_frame(frame: str | None) -> bool:
    """Whether a frame is that of a map by its name, under any prefix."""
    return frame is not None and last_name(frame) == MAP_FRAME


def is_odometry_frame(frame: str | None) -> bool:
    """Whether a frame is one in which odometry is given: `odom`, `odom_combined`, `robot1/odom`, `wheel_odom`."""
    return frame is not None and "odom" in last_name(frame).lower()


def is_transform_topic(channel: Channel) -> bool:
    """Whether a channel carries transforms that can be decoded."""
    return canonical_type(channel.typename) == definitions.TF_MESSAGE and is_decodable(channel)


def is_static_topic(topic: str) -> bool:
    """Whether transforms on a topic are meant to hold for good, by its name."""
    return "static" in topic.rpartition("/")[2]


def namespace(topic: str) -> str:
    """The namespace of a topic: `robot1` of `/robot1/tf`, empty for `/tf`."""
    return topic.strip("/").rpartition("/")[0]


def read_links(
    containers: Sequence[Container],
    topics: Collection[str],
    limit: int | None = None,
    warnings: list[RunWarning] | None = None,
) -> Iterator[LinkMessage]:
    """All transforms on some topics, in the order of the log; at most `limit` messages of each file.

    A log can be read without them: what prevents reading them is added to `warnings`.
    """
    for container in containers:
        decoders: dict[int, Decoder] = {}
        for channel in container.channels.values():
            if channel.topic not in topics or canonical_type(channel.typename) != definitions.TF_MESSAGE:
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


@dataclass(slots=True)
class TransformTopics:
    """The topics of transforms that are read, and what they say of odometry.

    `odometry` is (parent, child) of the link that is odometry, None without one; `fixed_odometry` that of a static link
    which has its place, where there is none. `has_map_to_odometry` says whether a localiser published its correction.
    `stated` are the parent and the first pose of each frame on the dynamic topics. `warnings` are what had to be
    decided.
    """

    dynamic: frozenset[str] = frozenset()
    static: frozenset[str] = frozenset()
    odometry: tuple[str, str] | None = None
    fixed_odometry: tuple[str, str] | None = None
    has_map_to_odometry: bool = False
    stated: dict[str, tuple[str, Transform3]] = field(default_factory=dict)
    warnings: list[RunWarning] = field(default_factory=list)

    @property
    def names(self) -> str:
        """The topics, for a message."""
        return " and ".join([*sorted(self.static), *sorted(self.dynamic)]) or "/tf_static and /tf"


def choose_transforms(
    containers: Sequence[Container], scans: Sequence[tuple[str, str]], base: str | None, named: str | None
) -> TransformTopics:
    """The transforms of the robot with these `scans` (topic, frame); `base` is its frame if the user named it.

    `named` is a topic of transforms from which the user wants the odometry.
    """
    topics = sorted({c.topic for container in containers for c in container.channels.values() if is_transform_topic(c)})
    links = {topic: _links(containers, topic) for topic in topics}
    groups: dict[str, list[str]] = {}
    for topic in topics:
        groups.setdefault(namespace(topic), []).append(topic)
    found = TransformTopics()
    # `tf` means the transforms wherever they are.
    chosen = [] if named is None else groups.get(namespace(named), [])
    if all(map(is_static_topic, chosen)):
        chosen = _nearest(groups, links, scans, found.warnings)
    if namespace(chosen[0]) if chosen else "":
        # What a robot's namespace does not say may be said for all: a description on /tf_static, say.
        own = {child for topic in chosen for _, child in links[topic]}
        frames = {frame for topic in chosen for link in links[topic] for frame in link}
        missing = any(frame not in frames for _, frame in scans) or not own
        chosen = [*chosen, *(groups.get("", []) if missing else [])]
    found.static = frozenset(topic for topic in chosen if is_static_topic(topic))
    found.dynamic = frozenset(chosen) - found.static
    if named in found.dynamic:
        found.dynamic = frozenset([named]) if named is not None else found.dynamic
    moving = [link for topic in sorted(found.dynamic) for link in links[topic]]
    resting = [link for topic in sorted(found.static) for link in links[topic]]
    lasers = [frame for _, frame in scans]
    found.odometry = odometry_link(moving, resting, lasers, base)
    if found.odometry is None and named is not None:
        found.odometry = _topmost_link(moving, resting, lasers, base)
    if found.odometry is None:
        found.fixed_odometry = odometry_link(resting, (), lasers, base)
    for topic in sorted(found.dynamic):
        found.stated.update({child: (parent, first) for (parent, child), first in links[topic].items()})
    found.has_map_to_odometry = any(is_map_frame(parent) for parent, _ in moving) or any(
        is_map_frame(child) and is_odometry_frame(parent) for parent, child in moving
    )
    return found


def _links(containers: Sequence[Container], topic: str) -> dict[tuple[str, str], Transform3]:
    """(parent, child) of the links on a topic, in their order, each with its first transform, normalised."""
    found: dict[tuple[str, str], Transform3] = {}
    for link in read_links(containers, (topic,), _LINKS_AT_OPENING):
        if (link.parent, link.child) not in found:
            found[link.parent, link.child] = link.transform.normalised()
    return found


def _nearest(
    groups: dict[str, list[str]],
    links: Mapping[str, Iterable[tuple[str, str]]],
    scans: Sequence[tuple[str, str]],
    warnings: list[RunWarning],
) -> list[str]:
    """The topics of the namespace that the scans belong to."""
    if len(groups) < 2:
        return next(iter(groups.values()), [])

    def distance(name: str) -> tuple[int, int]:
        """Namespaces that hold the scans' namespace come first, the deepest of them; then the others."""
        own = namespace(scans[0][0]) if scans else ""
        holds = name == "" or own == name or own.startswith(name + "/")
        return (0, -len(name)) if holds else (1, len(name))

    def knows(name: str) -> bool:
        frames = {frame for topic in groups[name] for link in links[topic] for frame in link}
        return any(frame in frames for _, frame in scans)

    order = sorted(groups, key=lambda name: (not knows(name), distance(name), name))
    tied = [name for name in order if knows(name) and distance(name)[0] == 1]
    if len(tied) > 1 and order[0] in tied:
        warnings.append(
            RunWarning(
                WarningCode.TRANSFORMS_AMBIGUOUS,
                f"transforms in {len(tied)} namespaces hold the frame of the scans; those on "
                f"{', '.join(groups[order[0]])} are used",
                "choose others with --odom-topic",
            )
        )
    return groups[order[0]]


def _topmost_link(
    moving: Sequence[tuple[str, str]], resting: Sequence[tuple[str, str]], lasers: Sequence[str], base: str | None
) -> tuple[str, str] | None:
    """(parent, child) of the dynamic link nearest to the root, or above the base; a map's pose is no odometry.

    Meant where the user says that transforms are the odometry and no frame has the name of one (`world`, say).
    """
    dynamic = [link for link in moving if not is_map_frame(link[0])]
    if base is not None:
        return next((link for link in dynamic if base in (link[1], last_name(link[1]))), None)
    return next((link for link in reversed([*_ways_up([*moving, *resting], lasers)]) if link in dynamic), None)


def _ways_up(links: Iterable[tuple[str, str]], lasers: Sequence[str]) -> Iterator[tuple[str, str]]:
    """(parent, child) of the links from each laser to the root, or to where they would close a loop."""
    parents = {child: parent for parent, child in links}
    for frame in lasers:
        seen = {frame}
        while (above := parents.get(frame)) is not None and above not in seen:
            yield above, frame
            seen.add(above)
            frame = above


def odometry_link(
    moving: Sequence[tuple[str, str]], resting: Sequence[tuple[str, str]], lasers: Sequence[str], base: str | None
) -> tuple[str, str] | None:
    """(parent, child) of the dynamic link that is the odometry of the robot with these laser frames, if there is one.

    It is the link on the way from a laser to the root whose parent is an odometry frame by its name.
    """
    found = [(parent, child) for parent, child in moving if is_odometry_frame(parent) and not is_map_frame(child)]
    if base is not None:
        return next(((parent, child) for parent, child in found if base in (child, last_name(child))), None) or (
            found[0] if len(found) == 1 else None
        )
    for link in _ways_up([*moving, *resting], lasers):
        if link in found:
            return link
    for name in BASE_FRAMES:
        named = sorted(link for link in found if last_name(link[1]) == name)
        if named:
            return named[0]
    return found[0] if len(found) == 1 else None
