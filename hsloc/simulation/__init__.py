"""THE RECORDER'S ROBOT: worlds, robots, sensors, scenarios."""
