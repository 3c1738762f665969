"""What a user is warned of: a value with a stable code, a text and a remedy. All codes are listed here.

A warning does not stop a run: it describes what was assumed, or what makes its result less certain. What stops one is
an `HslocError`. Programs look at `code`; `text` and `remedy` are for people and may change.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class WarningCode(StrEnum):
    """The codes of all warnings; a code keeps its meaning for ever."""

    CHANNELS_UNDEFINED = "channels_undefined"
    """Messages on channels of an MCAP file that nothing describes are ignored."""
    TOPIC_MISSING = "topic_missing"
    """The log has no topic with scans, or none with odometry, where the command does not need one."""
    TOPIC_AMBIGUOUS = "topic_ambiguous"
    """The log has several topics with scans or odometry and none was chosen."""
    TRANSFORMS_UNREADABLE = "transforms_unreadable"
    """Transforms on /tf or /tf_static cannot be decoded and are ignored."""
    EXTRINSICS_ASSUMED = "extrinsics_assumed"
    """Nothing states where the laser is mounted: it is assumed to be at the origin of the base frame."""
    EXTRINSICS_RESTATED = "extrinsics_restated"
    """A static transform on the way to the laser is stated several times with different values."""
    TRANSFORMS_AMBIGUOUS = "transforms_ambiguous"
    """Transforms in several namespaces hold the frame of the scans; those of one are used."""
    DEFINITION_INCOMPLETE = "definition_incomplete"
    """The log's definition of a standard message type is incomplete; the standard one is used."""
    SCAN_ECHOES = "scan_echoes"
    """Several scan topics are echoes of one laser; one of them is used."""
    SCAN_SEGMENTS = "scan_segments"
    """Each scan message is a segment of a turn; the segments are joined."""
    SCAN_ANGLE_UNIT = "scan_angle_unit"
    """The angles of the scans are larger than a turn: they may be in degrees."""
    SCAN_ANGLE_INCREMENT = "scan_angle_increment"
    """angle_min, angle_max, angle_increment and the number of beams contradict each other."""
    SCAN_RANGE_MAX = "scan_range_max"
    """Many readings are larger than range_max and are discarded."""
    SCAN_NO_RETURN_CODE = "scan_no_return_code"
    """A finite reading at the end of the scale that follows no wall is read as no return."""
    SCAN_TIME_INCREMENT = "scan_time_increment"
    """time_increment does not fit the time between scans."""
    MAP_IS_COSTMAP = "map_is_costmap"
    """The only grids of the log are costmaps, which are not used as a map."""
    START_FRAME = "start_frame"
    """An initial pose is given in a frame that no transform connects with the map; it is not used."""
    REFERENCE_READ_AS = "reference_read_as"
    """A file of poses was read in a unit, an order or a frame that it does not state."""
    REFERENCE_STAMPS_REPEAT = "reference_stamps_repeat"
    """Most poses of a file share their stamps: they were written with too few digits."""
    LASER_TILTED = "laser_tilted"
    """The laser is mounted with a tilt; its ranges are used as if it were level."""
    LASER_MOVES = "laser_moves"
    """The mounting of the laser changes during the log; its last pose is used for the whole log."""
    LASER_POSE_SHARED = "laser_pose_shared"
    """One --laser-pose is used for several lasers."""
    ODOMETRY_FRAME_ASSUMED = "odometry_frame_assumed"
    """No transform leads from the child frame of the odometry to the base: they are assumed to be the same."""
    CLOCK_OFFSET = "clock_offset"
    """The stamps of the scans are earlier or later than those of the odometry, by what their headings show."""
    CLOCK_OFFSET_LARGE = "clock_offset_large"
    """The same by a tenth of a second or more."""
    CLOCK_OFFSET_APPLIED = "clock_offset_applied"
    """The offset between scans and odometry was estimated and removed, as asked for."""
    CALIBRATION_UNUSED = "calibration_unused"
    """A calibration names a lidar whose scans are not read."""
    CLOCKS_APART = "clocks_apart"
    """The stamps of scans and odometry differ by more than their log times: they may come from two clocks."""
    PARTS_GAP = "parts_gap"
    """There is a long time between two files of one run."""
    PARTS_ODOMETRY_RESET = "parts_odometry_reset"
    """The odometry starts again from zero with a later file of the run."""
    PARTS_ODOMETRY_JUMP = "parts_odometry_jump"
    """The odometry is somewhere else when a later file of the run begins."""
    MAP_UNKNOWN_READ_AS_FREE = "map_unknown_read_as_free"
    """The thresholds of the map's YAML make free cells of pixels that mean unknown."""
    MAP_EMPTY = "map_empty"
    """The map has no occupied cell."""
    MAP_NOT_USED = "map_not_used"
    """A map is there, but was not given or cannot be read, so a new one is built."""
    MAP_PARAMETERS_DIFFER = "map_parameters_differ"
    """The map that is extended was built with other parameters."""
    START_STALE = "start_stale"
    """The log states an initial pose long before the first event; it is not used."""
    START_LATE = "start_late"
    """The log states an initial pose long after the first event; it is not used."""
    ODOMETRY_FROM_VELOCITIES = "odometry_from_velocities"
    """The log has no odometry; it is made of measured velocities, or rotations are predicted by an IMU."""
    ODOMETRY_RESET = "odometry_reset"
    """The odometry jumps; it is continued from the pose before the jump."""
    ODOMETRY_JUMPS = "odometry_jumps"
    """The odometry jumps too often to be corrected."""
    ODOMETRY_UNUSABLE = "odometry_unusable"
    """The odometry does not move while the scans do, or never states a heading; the run goes on without it."""
    SCANS_WITHOUT_PLACE = "scans_without_place"
    """Most scans were rejected, or did not determine the pose on the map."""
    LASER_MISFIT = "laser_misfit"
    """The scans of one laser fit the map far worse than those of another."""
    EXTRINSICS_DISAGREE = "extrinsics_disagree"
    """Two lasers, each matched alone, disagree about the pose of the base: a mounting is wrong."""


@dataclass(frozen=True, slots=True)
class RunWarning:
    """A warning about a log, a map or a run."""

    code: str
    """Stable name of the kind of warning, one of `WarningCode`."""
    text: str
    """What was found or assumed, in one line."""
    remedy: str = ""
    """What to do about it; empty where nothing can be done."""

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text
