"""From log events to what an estimator takes: merged scans, deskewing, continuous odometry."""
