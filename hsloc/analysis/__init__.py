"""What a finished run shows: metrics, residuals, quality warnings."""
