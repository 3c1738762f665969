"""Frozen value types: poses, trajectories, scans, odometry, estimates and occupancy grids."""

from hsloc.model.estimate import Estimate, Evidence, ScanDiagnostics, State, Status
from hsloc.model.events import Event, Heading, Odometry, PairedScan, Scan, Truth
from hsloc.model.occupancy_grid import OccupancyGrid
from hsloc.model.pose2 import IDENTITY, Pose2, wrap_angle, wrap_angles
from hsloc.model.trajectory import Trajectory

__all__ = [
    "IDENTITY",
    "Estimate",
    "Event",
    "Evidence",
    "Heading",
    "OccupancyGrid",
    "Odometry",
    "PairedScan",
    "Pose2",
    "Scan",
    "ScanDiagnostics",
    "State",
    "Status",
    "Trajectory",
    "Truth",
    "wrap_angle",
    "wrap_angles",
]
