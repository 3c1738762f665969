"""Simulation of recordings with known truth: worlds, robots, sensors, scenarios."""
