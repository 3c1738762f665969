"""Write logs that every tool of the field opens: ROS 2 CDR in MCAP."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from mcap.writer import CompressionType, Writer

from hsloc.errors import OutputError, not_written
from hsloc.log.messages import definitions, encode

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import TracebackType

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.log.transforms import Transform3
    from hsloc.model import OccupancyGrid, Pose2, Scan, Trajectory

_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n"
    "    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n"
    "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""Quality of service of topics that late listeners must still get (`ros2 bag play` offers it): transient local."""

LATCHED_TOPICS = frozenset(("/map", "/tf_static"))


class LogWriter:
    """An MCAP file under construction: zstd chunks with CRCs, indexes, statistics, profile `ros2`.

    A context manager. The file appears under its name only on a clean exit; until then, and after an exception,
    there is nothing. The same calls write the same bytes: no wall time, no version goes in. `log_time_ns` defaults
    to the message's stamp; give it where stamps run backwards, so that the file is in order all the same.

    Raises OutputError (naming the path) where the file cannot be written, an existing file is replaced.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        library: str = "hsloc",
        profile: str = "ros2",
        chunk_size: int = 1 << 20,
    ) -> None:
        self.target = Path(path)
        self._partial = self.target.with_name(f".{self.target.name}.{os.getpid()}.part")
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        if self.target.is_dir():
            raise OutputError(f"{self.target}: is a folder; name a file to write, such as {self.target / 'run.mcap'}")
        try:
            self._stream: BinaryIO = self._partial.open("wb")
        except OSError as error:
            raise self._error(error) from error
        self._writer = Writer(self._stream, chunk_size=chunk_size, compression=CompressionType.ZSTD)
        try:
            self._writer.start(profile=profile, library=library)
        except OSError as error:
            self.abort()
            raise self._error(error) from error

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def close(self) -> None:
        """Write the index and give the file its name. A second call does nothing."""
        if self._stream.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
            self._partial.replace(self.target)
        except OSError as error:
            self.abort()
            raise self._error(error) from error

    def abort(self) -> None:
        """Leave nothing behind."""
        with suppress(OSError):
            self._stream.close()
        with suppress(OSError):
            self._partial.unlink(missing_ok=True)

    def scan(
        self,
        scan: Scan,
        topic: str = "/scan",
        frame_id: str | None = None,
        log_time_ns: int | None = None,
        scan_time: float | None = None,
    ) -> None:
        """sensor_msgs/LaserScan; `frame_id` defaults to the scan's, `scan_time` (s) to that of all its beams.

        The mounting is not part of the message: write it with `transforms(..., static=True)`.
        """
        duration = len(scan.ranges) * scan.time_increment if scan_time is None else scan_time
        data = encode.laser_scan(scan, scan.frame_id if frame_id is None else frame_id, duration)
        self._add(topic, definitions.LASER_SCAN, scan.stamp_ns, data, log_time_ns)

    def odometry(
        self,
        stamp_ns: int,
        pose: Pose2,
        *,
        topic: str = "/odom",
        frame_id: str = "odom",
        child_frame_id: str = "base_link",
        covariance: NDArray[np.float64] | None = None,
        twist: tuple[float, float, float] = (0.0, 0.0, 0.0),
        log_time_ns: int | None = None,
    ) -> None:
        """nav_msgs/Odometry; `covariance` is 3 x 3 of (x, y, theta) in m^2 and rad^2, `twist` (vx, vy, wz)."""
        data = encode.odometry(stamp_ns, pose, covariance, twist, (frame_id, child_frame_id))
        self._add(topic, definitions.ODOMETRY, stamp_ns, data, log_time_ns)

    def heading(self, stamp_ns: int, theta: float, frame_id: str, log_time_ns: int | None = None) -> None:
        """sensor_msgs/Imu on /imu: the heading of a frame (rad), no rates and no accelerations."""
        self._add("/imu", definitions.IMU, stamp_ns, encode.imu(stamp_ns, theta, frame_id), log_time_ns)

    def transforms(
        self,
        stamp_ns: int,
        links: Sequence[tuple[str, str, Pose2 | Transform3]],
        static: bool = False,
        log_time_ns: int | None = None,
        topic: str | None = None,
    ) -> None:
        """tf2_msgs/TFMessage on /tf, or /tf_static, or a topic by name; links are (parent, child, T_parent_child)."""
        topic = topic or ("/tf_static" if static else "/tf")
        self._add(topic, definitions.TF_MESSAGE, stamp_ns, encode.transforms(stamp_ns, links), log_time_ns)

    def occupancy_grid(
        self,
        grid: OccupancyGrid,
        stamp_ns: int,
        topic: str = "/map",
        frame_id: str = "map",
        log_time_ns: int | None = None,
    ) -> None:
        """nav_msgs/OccupancyGrid."""
        data = encode.occupancy_grid(grid, stamp_ns, frame_id)
        self._add(topic, definitions.OCCUPANCY_GRID, stamp_ns, data, log_time_ns)

    def pose(
        self,
        stamp_ns: int,
        pose: Pose2,
        topic: str = "/pose",
        frame_id: str = "map",
        log_time_ns: int | None = None,
    ) -> None:
        """geometry_msgs/PoseStamped."""
        data = encode.pose_stamped(stamp_ns, pose, frame_id)
        self._add(topic, definitions.POSE_STAMPED, stamp_ns, data, log_time_ns)

    def pose_with_covariance(
        self,
        stamp_ns: int,
        pose: Pose2,
        covariance: NDArray[np.float64] | None = None,
        topic: str = "/amcl_pose",
        frame_id: str = "map",
        log_time_ns: int | None = None,
    ) -> None:
        """geometry_msgs/PoseWithCovarianceStamped; `covariance` as in `odometry`."""
        data = encode.pose_with_covariance_stamped(stamp_ns, pose, covariance, frame_id)
        self._add(topic, definitions.POSE_WITH_COVARIANCE_STAMPED, stamp_ns, data, log_time_ns)

    def path(
        self,
        stamp_ns: int,
        trajectory: Trajectory,
        topic: str = "/path",
        frame_id: str = "map",
        log_time_ns: int | None = None,
    ) -> None:
        """nav_msgs/Path."""
        self._add(topic, definitions.PATH, stamp_ns, encode.path(stamp_ns, trajectory, frame_id), log_time_ns)

    def log(self, stamp_ns: int, level: int, text: str, name: str = "hsloc", topic: str = "/rosout") -> None:
        """rcl_interfaces/Log; `level` is 20 for information, 30 for a warning, 40 for an error."""
        self._add(topic, definitions.LOG, stamp_ns, encode.log_message(stamp_ns, level, name, text), None)

    def number(self, stamp_ns: int, value: float, topic: str) -> None:
        """std_msgs/Float64: a curve, of values at these times."""
        self._add(topic, definitions.FLOAT64, stamp_ns, encode.float64(value), None)

    def text(self, stamp_ns: int, text: str, topic: str) -> None:
        """std_msgs/String."""
        self._add(topic, definitions.STRING, stamp_ns, encode.string(text), None)

    def markers(self, stamp_ns: int, markers: Sequence[encode.Marker], topic: str, frame_id: str = "map") -> None:
        """visualization_msgs/MarkerArray."""
        data = encode.marker_array(stamp_ns, markers, frame_id)
        self._add(topic, definitions.MARKER_ARRAY, stamp_ns, data, None)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A metadata record: seed, scenario, versions."""
        try:
            self._writer.add_metadata(name, dict(values))
        except OSError as error:
            raise self._error(error) from error

    def attachment(
        self, name: str, data: bytes, media_type: str = "application/octet-stream", log_time_ns: int = 0
    ) -> None:
        """A file inside the log, such as the configuration."""
        try:
            self._writer.add_attachment(
                create_time=0, log_time=log_time_ns, name=name, media_type=media_type, data=data
            )
        except OSError as error:
            raise self._error(error) from error

    def _add(self, topic: str, typename: str, stamp_ns: int, data: bytes, log_time_ns: int | None) -> None:
        log_time = stamp_ns if log_time_ns is None else log_time_ns
        if not 0 <= log_time < 2**64:
            raise OutputError(f"{self.target}: log time {log_time} ns of {topic} does not fit MCAP (0 to 2^64 - 1)")
        try:
            channel = self._channels.get((topic, typename)) or self._register(topic, typename)
            sequence = self._sequences[channel]
            self._sequences[channel] = sequence + 1
            self._writer.add_message(channel, log_time, data, log_time, sequence)
        except OSError as error:
            raise self._error(error) from error

    def _register(self, topic: str, typename: str) -> int:
        if typename not in self._schemas:
            text = definitions.definition_text(typename)
            self._schemas[typename] = self._writer.register_schema(typename, "ros2msg", text.encode())
        quality = {"offered_qos_profiles": _LATCHED if topic in LATCHED_TOPICS else ""}
        channel = self._writer.register_channel(topic, "cdr", self._schemas[typename], quality)
        self._channels[topic, typename] = channel
        self._sequences[channel] = 0
        return channel

    def _error(self, error: OSError) -> OutputError:
        return OutputError(not_written(self.target, error))
