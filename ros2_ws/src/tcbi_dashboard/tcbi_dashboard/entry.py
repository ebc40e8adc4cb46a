"""What may be typed into a field for a number, and what it means. Nothing is ever rounded or moved into the limits."""

import math
from dataclasses import dataclass

from tcbi_dashboard.errors import DashboardError


@dataclass(frozen=True)
class Allowed:
    """The entries that one field takes.

    Attributes:
      low, high: the limits; both are allowed.
      whole: whole numbers only.
      unset: what an empty field stands for; "" where there must be a number.
    """

    low: float
    high: float
    whole: bool = False
    unset: str = ""

    def __str__(self) -> str:
        number = "whole numbers from " if self.whole else ""
        return f"allowed: {number}{self.low:.10g} to {self.high:.10g}{f', or empty ({self.unset})' * bool(self.unset)}"

    def read(self, text: str) -> float | None:
        """The number that was typed; None for an empty field that may be empty.

        Raises:
          DashboardError: it is none that is allowed.
        """
        typed = text.strip().replace(",", ".")
        if not typed and self.unset:
            return None
        try:
            value = float(typed)
        except ValueError:
            value = math.nan
        if not self.low <= value <= self.high or (self.whole and value != int(value)):
            raise DashboardError(str(self))
        return value

    def fault(self, text: str) -> str | None:
        """What is allowed, if this is not; for the mark under the field."""
        try:
            self.read(text)
        except DashboardError as e:
            return str(e)
        return None
