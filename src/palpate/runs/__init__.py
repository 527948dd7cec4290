"""A run on disk: configuration, metrics, checkpoints, result."""

from palpate.runs.result import Figure as Figure
from palpate.runs.result import Result as Result
from palpate.runs.run import Run as Run
