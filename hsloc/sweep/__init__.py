"""Many runs: logs x configurations x seeds."""
