"""Predicted against measured motion: errors beside noise floors, guards before them, and where they live."""

from tcbi_infer.compare.comparison import Comparison, SignalError, compare

__all__ = ["Comparison", "SignalError", "compare"]
