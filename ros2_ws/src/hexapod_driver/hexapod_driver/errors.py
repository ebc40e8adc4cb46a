"""What can go wrong between this computer and the robot, one small class per fault."""

from tcbi_contract.errors import TcbiError


class DriverError(TcbiError):
    """Base of every fault of the driver."""


class PortError(DriverError):
    """A serial port cannot be opened: it does not exist, is busy, or is not ours to use."""


class LinkLost(DriverError):
    """An open port went away, or nothing that makes sense comes from it any more."""


class StartupError(DriverError):
    """The robot is not what the calibration says: servos are missing or the board does not answer."""


class CalibrationError(DriverError):
    """A calibration file is missing, broken, or does not describe this robot."""
