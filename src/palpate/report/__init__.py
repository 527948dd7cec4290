"""Results as something a person looks at: one HTML page per question.

A run leaves `evidence.npz` (see `write_evidence`); `build_report` turns one or several runs into a
page that opens without a network. Nothing here knows what kind of object was handled.
"""

from palpate.report.evidence import Curves, Evidence, Motion, Piece, read_evidence, write_evidence
from palpate.report.page import build_report

__all__ = [
    "Curves",
    "Evidence",
    "Motion",
    "Piece",
    "build_report",
    "read_evidence",
    "write_evidence",
]
