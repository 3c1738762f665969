"""Reports of a run: report.png and report.html."""
