"""The check before anything moves: is every servo and the sensor board there? One error names all that is missing."""

import time

from hexapod_driver import feetech, sensor_board
from hexapod_driver.calibration import Calibration
from hexapod_driver.errors import StartupError
from hexapod_driver.one_link import OneLink
from hexapod_driver.sensor_board import Feature, FrameError, Identity, Kind
from hexapod_driver.wire import Wire

ATTEMPTS = 3
REPLY_S = 0.4
BOOT_S = 1.0  # until servos that were without power answer
WATCHDOG_MS = 500  # the board's own default
SERVO_REMEDY = "check power, cables and the ids in the calibration"


def check(wire: Wire, calibration: Calibration) -> Identity:
    """Ask the sensor board and all servos, after taking the torque off: first of all, should the board be the fault.

    Raises:
      StartupError: the board does not answer, speaks another version, or servos are missing: expected and found.
    """
    wire.shout(feetech.torque(calibration.servos, False))
    identity = identify(wire)
    wire.submit(feetech.torque(calibration.servos, False))
    wake(wire, calibration)
    missing = missing_joints(wire, calibration)
    if missing:
        raise StartupError(f"servos: {absence(missing, calibration)}; {SERVO_REMEDY} of {calibration.robot}")
    return identity


def wake(wire: Wire, calibration: Calibration) -> None:
    """Clear the board's watchdog, which with two ports has cut the servos' power; wait until the first servo answers.

    The torque stays off: neither the board nor a servo that gets its power back puts it on. It takes no longer than
    BOOT_S, also where no servo is there.
    """
    wire.send_board(Kind.STREAM, sensor_board.stream_payload(0, WATCHDOG_MS))
    servo, deadline = calibration.servos[0], time.monotonic() + BOOT_S
    while not wire.transact(_question(servo), [servo], REPLY_S) and time.monotonic() < deadline:
        pass


def absence(missing: list[str], calibration: Calibration) -> str:
    """Which servos do not answer, beside how many should."""
    found = len(calibration.joints) - len(missing)
    names = ", ".join(f"{name} (id {calibration.joints[name].servo})" for name in missing)
    return f"expected {len(calibration.joints)}, found {found}; no answer from {names}"


def missing_joints(wire: Wire, calibration: Calibration) -> list[str]:
    """Joints whose servo does not answer: asked in rounds, with growing patience for those that are still missing."""
    missing = list(calibration.joints)
    for attempt, timeout_s in enumerate(wire.check_timeouts_s):
        if attempt == 2 and len(missing) == len(calibration.joints):
            break  # a dead bus needs no third round
        servos = {name: calibration.joints[name].servo for name in missing}
        tags = {name: wire.submit(_question(servo), [servo], timeout_s) for name, servo in servos.items()}
        replies = wire.gather(tags.values(), timeout_s * len(missing) + REPLY_S)
        missing = [n for n in missing if all(p.id != servos[n] for p in replies.get(tags[n], ()))]
        if not missing:
            break
    return missing


def _question(servo: int) -> bytes:
    """A read: the echo of a ping would look like the answer of a servo with an error."""
    return feetech.read(servo, feetech.TORQUE_ENABLE, 1)


def identify(wire: Wire) -> Identity:
    """Ask the sensor board who it is.

    Raises:
      StartupError: it does not answer, or speaks another version, or does not carry the servo bus where it should.
    """
    for _ in range(ATTEMPTS):
        frame = wire.ask_board(Kind.IDENTIFY, b"", Kind.IDENTITY, REPLY_S)
        if frame is None:
            continue
        try:
            identity = sensor_board.parse_identity(frame.payload)
        except FrameError as error:
            raise StartupError(f"sensor board: {error}") from error
        if isinstance(wire, OneLink) and not identity.features & Feature.SERVO_BUS:
            raise StartupError(
                f"sensor board {identity.name!r} does not carry the servo bus; give its port as sensor_port and "
                "the servo bus as port"
            )
        return identity
    raise StartupError(_silence(wire))


def _silence(wire: Wire) -> str:
    if wire.frames.foreign_versions:
        seen = ", ".join(map(str, sorted(wire.frames.foreign_versions)))
        return f"sensor board: speaks protocol version {seen}, allowed is {sensor_board.VERSION}; update its firmware"
    if wire.counters.bytes_read:
        return (
            f"sensor board: {wire.counters.bytes_read} bytes came, none of them a frame of this robot; check that the "
            "port belongs to the robot, and the baud rate"
        )
    return "sensor board: no answer, not one byte; check that the robot is switched on, and the port"
