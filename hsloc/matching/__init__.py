"""POSE SEARCH: find the pose in a box that fits a scan best."""
