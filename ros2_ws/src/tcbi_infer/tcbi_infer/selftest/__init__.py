"""What a diagnosis would find in robots like the user's own: known effects, planted by another solver."""

from tcbi_infer.selftest.robot import STRENGTHS, Robot, robots
from tcbi_infer.selftest.summary import Limits, Summary, summarise
from tcbi_infer.selftest.trial import Bench, trials

__all__ = ["STRENGTHS", "Bench", "Limits", "Robot", "Summary", "robots", "summarise", "trials"]
