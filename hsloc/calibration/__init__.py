"""Calibration of a robot from its own log: odometry, the lidar's place on the base, the offset of its clock."""
