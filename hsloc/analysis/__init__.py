"""What a finished run shows: metrics, comparison with the reference, residuals, warnings, verdict."""

from hsloc.analysis.analysis import Analysis, analyse
from hsloc.analysis.metrics import run_timings
from hsloc.analysis.scan_overlay import ScanOverlay
from hsloc.analysis.second_pass import PosedEvent, posed_events

__all__ = ["Analysis", "PosedEvent", "ScanOverlay", "analyse", "posed_events", "run_timings"]
