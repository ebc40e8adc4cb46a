"""Errors of tcbi_bringup."""

from tcbi_contract.errors import TcbiError


class BringupError(TcbiError):
    """The base of all errors of this package."""


class UnknownExecutableError(BringupError):
    """A package or an executable that the workspace does not have."""


class LaunchError(BringupError):
    """The graph could not be started, or a process of it gave up."""


class SecondGraphError(LaunchError):
    """Another graph already runs in this ROS domain."""


class RobotListensError(BringupError):
    """Recorded commands would move a robot that listens."""


class DemoError(BringupError):
    """A step of the demo failed."""
