"""Preprocessing of events: merged scans, deskewing, continuous odometry."""
