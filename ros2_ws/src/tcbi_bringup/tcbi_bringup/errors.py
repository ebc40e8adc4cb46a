"""Errors of tcbi_bringup."""

from tcbi_contract.errors import TcbiError, UsageError


class BringupError(TcbiError):
    """The base of all errors of this package."""


class UnknownExecutableError(BringupError, UsageError):
    """A package or an executable that the workspace does not have."""


class WrongCallError(BringupError, UsageError):
    """Words of a command line that do not go together, or name what is not there."""


class LaunchError(BringupError):
    """The graph could not be started, or a process of it gave up."""


class SecondGraphError(LaunchError):
    """Another graph already runs in this ROS domain."""


class RobotListensError(BringupError):
    """A recording would move a robot that runs, or speak in its place."""


class DemoError(BringupError):
    """A step of the demo failed."""
