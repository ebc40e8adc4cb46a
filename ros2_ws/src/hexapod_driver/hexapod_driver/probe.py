"""A look at the robot behind a port that moves nothing: who answers, where the joints stand, what the sensors say.

    for finding in probe(LinkSettings("/dev/rfcomm0", BAUD_RATE, "", SENSOR_BAUD_RATE, calibration.load(""))):
        print(finding.name, finding.found)

Servos are read, never written to. Sensor samples are switched on for a moment and off again; the board's watchdog
keeps its default, and with two ports gives back the power that it has cut, without torque. So a limp robot stays limp.
"""

import math
import time
from collections.abc import Iterator

from hexapod_driver import feetech, sensor_board, startup
from hexapod_driver.errors import DriverError, LinkLost, PortError, StartupError
from hexapod_driver.feetech import Packet
from hexapod_driver.link import LinkSettings, open_wire
from hexapod_driver.sensor_board import Feature, FrameError, Identity, Kind, Sample
from hexapod_driver.wire import Wire
from tcbi_contract.check import FAULT, OK, Check
from tcbi_contract.names import JOINT_LIMIT, LEGS

READ_S = 0.5
SAMPLE_S = 1.0
SAMPLE_RATE_HZ = 50
HEALTH_BYTES = 8  # position, speed, load, voltage, temperature
BEYOND_RAD = 0.1  # a joint this far outside its range cannot be calibrated right
GRAVITY, GRAVITY_TOLERANCE = 9.81, 2.0  # m/s^2


def probe(settings: LinkSettings) -> Iterator[Check]:
    """Ask the sensor board, every servo and the sensors, one after the other; ends at the first that makes the rest
    pointless."""
    try:
        wire = open_wire(settings, time.time_ns)
    except PortError as error:
        yield Check("port", FAULT, *_split(error))
        return
    try:
        yield from _ask(wire, settings)
    except LinkLost as error:
        yield Check("link", FAULT, str(error), "check plug, power and radio range, then call again")
    finally:
        wire.close()


def _ask(wire: Wire, settings: LinkSettings) -> Iterator[Check]:
    try:
        identity = startup.identify(wire)
    except StartupError as error:
        yield Check("sensor board", FAULT, *_split(error))
        return
    yield _board(identity)
    yield from _servos(wire, settings)
    yield _sample(wire)


def _board(identity: Identity) -> Check:
    parts = {"servo bus": Feature.SERVO_BUS, "IMU": Feature.IMU, "foot switches": Feature.FOOT_SWITCHES}
    has = [name for name, feature in parts.items() if identity.features & feature]
    found = f"{identity.name!r}, firmware {identity.firmware}, up for {identity.time_us * 1e-6:.0f} s"
    return Check("sensor board", OK, f"{found}, has {', '.join(has) or 'neither IMU nor foot switches'}")


def _servos(wire: Wire, settings: LinkSettings) -> Iterator[Check]:
    calibration = settings.calibration
    startup.wake(wire, calibration)
    missing = startup.missing_joints(wire, calibration)
    if missing:
        yield Check("servos", FAULT, startup.absence(missing, calibration), startup.SERVO_REMEDY)
    else:
        yield Check("servos", OK, f"all {len(calibration.joints)} answer")
    joints = {joint.servo: name for name, joint in calibration.joints.items() if name not in missing}
    if joints:
        question = feetech.sync_read(joints, feetech.PRESENT_POSITION, HEALTH_BYTES)
        packets = [p for p in wire.transact(question, list(joints), READ_S) if len(p.params) == HEALTH_BYTES]
        yield _positions({joints[p.id]: p for p in packets if p.id in joints}, settings, len(joints))


def _positions(packets: dict[str, Packet], settings: LinkSettings, asked: int) -> Check:
    if not packets:
        return Check("positions", FAULT, f"none of {asked} servos tells its position", "restart the servos' power")
    angles = {
        name: settings.calibration.to_radian(name, int.from_bytes(p.params[:2], "little"))
        for name, p in packets.items()
    }
    volt = min(p.params[feetech.PRESENT_VOLTAGE - feetech.PRESENT_POSITION] for p in packets.values()) / 10
    hot = max(p.params[feetech.PRESENT_TEMPERATURE - feetech.PRESENT_POSITION] for p in packets.values())
    low, high = math.degrees(min(angles.values())), math.degrees(max(angles.values()))
    found = f"{len(angles)} of {asked} joints read, {low:.1f} to {high:.1f} deg, {volt:.1f} V, up to {hot} deg C"
    complaints = [f"{name} reports {', '.join(feetech.error_names(p.code))}" for name, p in packets.items() if p.code]
    beyond = [name for name, angle in angles.items() if abs(angle) > JOINT_LIMIT + BEYOND_RAD]
    if complaints:
        return Check("positions", FAULT, f"{found}; {'; '.join(complaints)}", "let it cool, check load and supply")
    if beyond:
        outside = ", ".join(f"{name} {math.degrees(angles[name]):.0f} deg" for name in beyond)
        remedy = "correct direction and zero_step in the calibration, or lay the legs into their range"
        return Check("positions", FAULT, f"{found}; outside +-30 deg: {outside}", remedy)
    if len(angles) < asked:
        return Check("positions", FAULT, found, "bytes get lost: check cables, radio range and the baud rate")
    return Check("positions", OK, found)


def _sample(wire: Wire) -> Check:
    wire.send_board(Kind.STREAM, sensor_board.stream_payload(SAMPLE_RATE_HZ, startup.WATCHDOG_MS))
    frame = wire.ask_board(Kind.KEEP_ALIVE, b"", Kind.SAMPLE, SAMPLE_S)
    wire.send_board(Kind.STREAM, sensor_board.stream_payload(0, startup.WATCHDOG_MS))
    if frame is None:
        return Check("sensors", FAULT, f"no sample within {SAMPLE_S:g} s", "restart the sensor board")
    try:
        return _judge(sensor_board.parse_sample(frame.payload))
    except FrameError as error:
        return Check("sensors", FAULT, str(error), "restart the sensor board, or update its firmware")


def _judge(sample: Sample) -> Check:
    words, faults = [], []
    if sample.linear_acceleration is None:
        words.append("no acceleration")
    else:
        size = math.hypot(*sample.linear_acceleration)
        words.append(f"acceleration {size:.2f} m/s^2")
        if abs(size - GRAVITY) > GRAVITY_TOLERANCE:
            faults.append(f"a robot at rest should show {GRAVITY} m/s^2")
    words.append("no attitude" if sample.orientation is None else f"tilt {_tilt_deg(sample.orientation):.1f} deg")
    if sample.contact is None:
        words.append("no foot switches")
    else:
        touching = [leg for leg, on in zip(LEGS, sample.contact, strict=True) if on]
        words.append(f"feet that touch: {' '.join(touching) or 'none'}")
    remedy = "lay the robot still and call again; else the IMU is damaged or in other units" if faults else ""
    return Check(
        "sensors", FAULT if faults else OK, ", ".join(words) + "".join(f"; {fault}" for fault in faults), remedy
    )


def _tilt_deg(orientation: tuple[float, ...]) -> float:
    x, y, _, _ = orientation
    return math.degrees(math.acos(min(1.0, max(-1.0, 1 - 2 * (x * x + y * y)))))


def _split(error: DriverError) -> tuple[str, str]:
    """A message as what was found and what to do about it, which its last semicolon parts."""
    found, _, remedy = str(error).rpartition("; ")
    return (found.removeprefix("sensor board: "), remedy) if found else (str(error), "unplug it and plug it in again")
