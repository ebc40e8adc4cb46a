"""Robots with hidden effects: how often a diagnosis names the right one, and a wrong one; see `hidden_effects/`."""

import sys

from hidden_effects.main import main
from hidden_effects.robots import PLANS, judged, recorded
from hidden_effects.truth import BASE

__all__ = ["BASE", "PLANS", "judged", "main", "recorded"]

if __name__ == "__main__":
    sys.exit(main())
