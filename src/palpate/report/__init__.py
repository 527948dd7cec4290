"""Results as something a person looks at: one HTML page per question, figures for documents.

A run leaves `evidence.npz` (see `write_evidence`); `build_report` turns one or several runs into a
page that opens without a network. Nothing here knows what kind of object was handled.
"""

from palpate.report.evidence import Curves, Evidence, Motion, read_evidence, write_evidence
from palpate.report.figures import motion_figure
from palpate.report.page import build_report

__all__ = [
    "Curves",
    "Evidence",
    "Motion",
    "build_report",
    "motion_figure",
    "read_evidence",
    "write_evidence",
]
