"""HOW FAST: the figures that the project promises, measured on this machine, and peers on the same work."""
