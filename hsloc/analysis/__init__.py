"""What a finished run shows: metrics, comparison with the reference, residuals, warnings, verdict."""
