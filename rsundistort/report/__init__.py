"""The report for people."""

from .diagnostics import Diagnostics, read_diagnostics, write_diagnostics
from .facts import map_facts, readout_facts
from .figures import write_figures
from .page import write_report
from .source import relative_folder
from .verdict import Verdict, verdict_of

__all__ = [
    "Diagnostics",
    "Verdict",
    "map_facts",
    "read_diagnostics",
    "readout_facts",
    "relative_folder",
    "verdict_of",
    "write_diagnostics",
    "write_figures",
    "write_report",
]
