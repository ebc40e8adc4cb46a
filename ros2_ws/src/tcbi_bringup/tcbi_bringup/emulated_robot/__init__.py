"""A robot on a pseudo-terminal: the wire in front, physics behind."""
