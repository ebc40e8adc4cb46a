"""Predicted against measured motion: errors beside noise floors, guards before them, and where they live."""

from tcbi_infer.compare.comparison import Comparison, compare
from tcbi_infer.compare.scorer import SignalError

__all__ = ["Comparison", "SignalError", "compare"]
