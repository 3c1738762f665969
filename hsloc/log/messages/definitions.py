"""The ROS 2 message definitions that hsloc writes, and knows by heart when it reads.

The texts are constants, and not taken from a library at run time, so that the same calls write the same bytes
on every machine. A test holds them equal to what rosbags generates.
"""

from __future__ import annotations

LASER_SCAN = "sensor_msgs/msg/LaserScan"
MULTI_ECHO_LASER_SCAN = "sensor_msgs/msg/MultiEchoLaserScan"
POINT_CLOUD2 = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE_STAMPED = "geometry_msgs/msg/PoseWithCovarianceStamped"
PATH = "nav_msgs/msg/Path"
LOG = "rcl_interfaces/msg/Log"
FLOAT64 = "std_msgs/msg/Float64"
STRING = "std_msgs/msg/String"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
TWIST_WITH_COVARIANCE_STAMPED = "geometry_msgs/msg/TwistWithCovarianceStamped"
JOINT_STATE = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"

KNOWN_TYPES = (
    LASER_SCAN,
    ODOMETRY,
    TF_MESSAGE,
    OCCUPANCY_GRID,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE_STAMPED,
    PATH,
    LOG,
    FLOAT64,
    STRING,
    MARKER_ARRAY,
)

FIELDS: dict[str, tuple[str, ...]] = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "geometry_msgs/Point": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x", "float64 y", "float64 z", "float64 w"),
    "geometry_msgs/Pose": ("geometry_msgs/Point position", "geometry_msgs/Quaternion orientation"),
    "geometry_msgs/Twist": ("geometry_msgs/Vector3 linear", "geometry_msgs/Vector3 angular"),
    "geometry_msgs/Transform": ("geometry_msgs/Vector3 translation", "geometry_msgs/Quaternion rotation"),
    "geometry_msgs/PoseWithCovariance": ("geometry_msgs/Pose pose", "float64[36] covariance"),
    "geometry_msgs/TwistWithCovariance": ("geometry_msgs/Twist twist", "float64[36] covariance"),
    "geometry_msgs/TwistStamped": ("std_msgs/Header header", "geometry_msgs/Twist twist"),
    "geometry_msgs/TwistWithCovarianceStamped": (
        "std_msgs/Header header",
        "geometry_msgs/TwistWithCovariance twist",
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header",
        "string[] name",
        "float64[] position",
        "float64[] velocity",
        "float64[] effort",
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header",
        "geometry_msgs/Quaternion orientation",
        "float64[9] orientation_covariance",
        "geometry_msgs/Vector3 angular_velocity",
        "float64[9] angular_velocity_covariance",
        "geometry_msgs/Vector3 linear_acceleration",
        "float64[9] linear_acceleration_covariance",
    ),
    "geometry_msgs/PoseStamped": ("std_msgs/Header header", "geometry_msgs/Pose pose"),
    "geometry_msgs/PoseWithCovarianceStamped": (
        "std_msgs/Header header",
        "geometry_msgs/PoseWithCovariance pose",
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/Transform transform",
    ),
    "tf2_msgs/TFMessage": ("geometry_msgs/TransformStamped[] transforms",),
    "nav_msgs/MapMetaData": (
        "builtin_interfaces/Time map_load_time",
        "float32 resolution",
        "uint32 width",
        "uint32 height",
        "geometry_msgs/Pose origin",
    ),
    "nav_msgs/OccupancyGrid": ("std_msgs/Header header", "nav_msgs/MapMetaData info", "int8[] data"),
    "rcl_interfaces/Log": (
        "byte DEBUG=10",
        "byte INFO=20",
        "byte WARN=30",
        "byte ERROR=40",
        "byte FATAL=50",
        "builtin_interfaces/Time stamp",
        "uint8 level",
        "string name",
        "string msg",
        "string file",
        "string function",
        "uint32 line",
    ),
    "std_msgs/Float64": ("float64 data",),
    "std_msgs/String": ("string data",),
    "std_msgs/ColorRGBA": ("float32 r", "float32 g", "float32 b", "float32 a"),
    "builtin_interfaces/Duration": ("int32 sec", "uint32 nanosec"),
    "sensor_msgs/CompressedImage": ("std_msgs/Header header", "string format", "uint8[] data"),
    "visualization_msgs/UVCoordinate": ("float32 u", "float32 v"),
    "visualization_msgs/MeshFile": ("string filename", "uint8[] data"),
    "visualization_msgs/Marker": (
        *("int32 ARROW=0", "int32 CUBE=1", "int32 SPHERE=2", "int32 CYLINDER=3", "int32 LINE_STRIP=4"),
        *("int32 LINE_LIST=5", "int32 CUBE_LIST=6", "int32 SPHERE_LIST=7", "int32 POINTS=8"),
        *("int32 TEXT_VIEW_FACING=9", "int32 MESH_RESOURCE=10", "int32 TRIANGLE_LIST=11"),
        *("int32 ADD=0", "int32 MODIFY=0", "int32 DELETE=2", "int32 DELETEALL=3"),
        "std_msgs/Header header",
        "string ns",
        "int32 id",
        "int32 type",
        "int32 action",
        "geometry_msgs/Pose pose",
        "geometry_msgs/Vector3 scale",
        "std_msgs/ColorRGBA color",
        "builtin_interfaces/Duration lifetime",
        "bool frame_locked",
        "geometry_msgs/Point[] points",
        "std_msgs/ColorRGBA[] colors",
        "string texture_resource",
        "sensor_msgs/CompressedImage texture",
        "visualization_msgs/UVCoordinate[] uv_coordinates",
        "string text",
        "string mesh_resource",
        "visualization_msgs/MeshFile mesh_file",
        "bool mesh_use_embedded_materials",
    ),
    "visualization_msgs/MarkerArray": ("visualization_msgs/Marker[] markers",),
    "nav_msgs/Path": ("std_msgs/Header header", "geometry_msgs/PoseStamped[] poses"),
    "nav_msgs/Odometry": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/PoseWithCovariance pose",
        "geometry_msgs/TwistWithCovariance twist",
    ),
    "sensor_msgs/PointField": ("string name", "uint32 offset", "uint8 datatype", "uint32 count"),
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "sensor_msgs/PointField[] fields",
        "bool is_bigendian",
        "uint32 point_step",
        "uint32 row_step",
        "uint8[] data",
        "bool is_dense",
    ),
    "sensor_msgs/LaserEcho": ("float32[] echoes",),
    "sensor_msgs/MultiEchoLaserScan": (
        "std_msgs/Header header",
        "float32 angle_min",
        "float32 angle_max",
        "float32 angle_increment",
        "float32 time_increment",
        "float32 scan_time",
        "float32 range_min",
        "float32 range_max",
        "sensor_msgs/LaserEcho[] ranges",
        "sensor_msgs/LaserEcho[] intensities",
    ),
    "sensor_msgs/LaserScan": (
        "std_msgs/Header header",
        "float32 angle_min",
        "float32 angle_max",
        "float32 angle_increment",
        "float32 time_increment",
        "float32 scan_time",
        "float32 range_min",
        "float32 range_max",
        "float32[] ranges",
        "float32[] intensities",
    ),
}
"""Fields of each type, by its name without `/msg/`."""

SEPARATOR = "=" * 80


def short_name(typename: str) -> str:
    """`sensor_msgs/msg/LaserScan` as `sensor_msgs/LaserScan`; ROS 1 names stay as they are."""
    return typename.replace("/msg/", "/")


def long_name(typename: str) -> str:
    """The name of a type as ROS 2 spells it: `sensor_msgs/LaserScan` as `sensor_msgs/msg/LaserScan`.

    Recorders beside rosbag2 write the names of DDS (`sensor_msgs::msg::dds_::LaserScan_`), of C++, of Python
    (`sensor_msgs.msg.LaserScan`), or the last part alone, which is enough where one known type has it.
    """
    name = typename.replace("::", "/")
    if "/" not in name and not name.startswith("foxglove."):
        name = name.replace(".", "/")
    if "/dds_/" in name:
        name = name.replace("/dds_/", "/").removesuffix("_")
    if "/" not in name:
        known = [full for full in FIELDS if full.rpartition("/")[2] == name]
        name = known[0] if len(known) == 1 else name
    package, _, last = short_name(name).partition("/")
    return f"{package}/msg/{last}" if last else typename


def definition_text(typename: str) -> str:
    """The full `ros2msg` definition of a known type: its fields, then those of the types it is made of."""
    order: list[str] = []

    def visit(name: str) -> None:
        if name not in order:
            order.append(name)
            for field in FIELDS[name]:
                kind = field.split()[0].partition("[")[0]
                if "/" in kind:
                    visit(kind)

    first = short_name(typename)
    visit(first)
    parts = ["\n".join(FIELDS[first])]
    parts += [f"{SEPARATOR}\nMSG: {name}\n" + "\n".join(FIELDS[name]) for name in order[1:]]
    return "\n".join(parts) + "\n"
