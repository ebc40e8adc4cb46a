"""The hidden-effect benchmark: robots with something hidden in them, recorded, diagnosed and judged."""
