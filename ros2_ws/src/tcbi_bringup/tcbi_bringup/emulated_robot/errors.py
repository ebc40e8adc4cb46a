"""Errors of the emulated robot that a user can cause and mend."""

from tcbi_bringup.errors import BringupError


class EmulatedRobotError(BringupError):
    """The emulated robot was asked for something that it cannot be or do."""
