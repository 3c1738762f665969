"""Trajectories as files: TUM, and evo's result archives."""
