"""THE ONE DOOR to MCAP, ROS bags and CARMEN."""
