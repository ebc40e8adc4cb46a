"""The checks of `./tcbi doctor` that need no running graph: environment, versions, build, disk, rendering, ports."""

import dataclasses
import importlib
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tcbi_bringup.errors import LaunchError
from tcbi_bringup.executables import PACKAGES, executables
from tcbi_contract.check import FAULT, OK, WARNING, Check

PACKAGES_NEEDED = ("numpy", "scipy", "mujoco", "torch", "stable-baselines3", "arviz", "mcap", "rosbags", "pyserial")
SPACE_FAULT_GB, SPACE_WARNING_GB = 0.5, 2.0
EARLIEST_CLOCK = 1_735_689_600  # 2025-01-01; a board without a clock battery starts in 1970
RENDER_TIMEOUT_S = 60


def environment_checks(store: Path) -> Iterator[Check]:
    """All checks of this machine, one after the other.

    Args:
      store: folder whose disk is asked for space.
    """
    yield python_check()
    yield from version_checks()
    yield interfaces_check()
    yield executables_check()
    yield space_check(store)
    yield writable_check(store)
    yield rendering_check()
    yield domain_check()
    yield clock_check(time.time())


def python_check() -> Check:
    """The interpreter."""
    found = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    if not (3, 11) <= sys.version_info[:2] <= (3, 13):
        return Check("python", FAULT, found, "use Python 3.11, 3.12 or 3.13: TCBI_PYTHON=python3.12 ./tcbi doctor")
    return Check("python", OK, f"{found}, {sys.prefix}")


def version_checks() -> Iterator[Check]:
    """The packages that everything stands on."""
    versions, missing = [], []
    for name in PACKAGES_NEEDED:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        yield Check("packages", FAULT, f"missing: {', '.join(missing)}", "remove .venv and call ./tcbi again")
    else:
        yield Check("packages", OK, ", ".join(versions))


def interfaces_check() -> Check:
    """Can messages be made and sent."""
    try:
        importlib.import_module("rclpy")
        importlib.import_module("tcbi_msgs.msg").RolloutEvent()
    except (ImportError, AttributeError, RuntimeError, OSError) as e:
        return Check("interfaces", FAULT, str(e), "remove .tcbi/ws and call ./tcbi again, or build with colcon")
    rmw = os.environ.get("RMW_IMPLEMENTATION", "the default middleware")
    return Check("interfaces", OK, f"rclpy and tcbi_msgs, on {rmw}")


def executables_check() -> Check:
    """Are all packages installed."""
    missing = [package for package in PACKAGES if not executables(package)]
    if missing:
        return Check("workspace", FAULT, f"not built: {', '.join(missing)}", "remove .tcbi/ws and call ./tcbi again")
    return Check(
        "workspace", OK, f"{sum(len(executables(p)) for p in PACKAGES)} executables of {len(PACKAGES)} packages"
    )


def space_check(folder: Path) -> Check:
    """Is there room for bags and models."""
    existing = next(f for f in (folder, *folder.parents) if f.exists())
    free = shutil.disk_usage(existing).free / 1e9
    found = f"{free:.1f} GB free for {folder}"
    if free < SPACE_WARNING_GB:
        status = FAULT if free < SPACE_FAULT_GB else WARNING
        return Check("disk", status, found, "make room, or choose another folder with --store or TCBI_STORE")
    return Check("disk", OK, found)


def writable_check(folder: Path) -> Check:
    """May this user write the store."""
    existing = next(f for f in (folder, *folder.parents) if f.exists())
    if not os.access(existing, os.W_OK):
        return Check(
            "store", FAULT, f"{existing} cannot be written", "choose another folder with --store or TCBI_STORE"
        )
    return Check("store", OK, f"{folder} can be written")


def rendering_check() -> Check:
    """Can MuJoCo draw without a screen; in a process of its own, because a broken driver may end it."""
    code = (
        "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); r = mujoco.Renderer(m, 16, 16); "
        "d = mujoco.MjData(m); mujoco.mj_forward(m, d); r.update_scene(d); r.render(); r.close()"
    )
    backend = os.environ.get("MUJOCO_GL", "egl")
    try:
        result = subprocess.run(
            [sys.executable, "-P", "-c", code],
            env={**os.environ, "MUJOCO_GL": backend},
            capture_output=True,
            text=True,
            timeout=RENDER_TIMEOUT_S,
            check=False,
        )
        good, words = result.returncode == 0, result.stderr.strip().splitlines()[-1:]
    except subprocess.TimeoutExpired:
        good, words = False, [f"no picture after {RENDER_TIMEOUT_S} s"]
    if good:
        return Check("rendering", OK, f"MuJoCo draws with {backend}")
    remedy = (
        "only pictures and videos need it; on Debian or Ubuntu: sudo apt install libegl1 libegl-mesa0 libgl1-mesa-dri"
    )
    return Check("rendering", WARNING, f"{backend} failed: {' '.join(words)}", remedy)


def domain_check() -> Check:
    """How far this graph reaches."""
    from tcbi_bringup.domain_lock import present_domain

    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    try:
        domain = present_domain()
    except LaunchError as e:
        return Check("domain", FAULT, str(e), "unset ROS_DOMAIN_ID")
    if os.environ.get("ROS_SECURITY_ENABLE", "").lower() == "true":
        found = "ROS_SECURITY_ENABLE is true, but the ROS wheels carry no DDS security"
        return Check("domain", FAULT, found, "unset it, or use a ROS 2 Jazzy installation")
    hint = "" if reach != "LOCALHOST" else "; other machines: ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
    return Check("domain", OK, f"ROS_DOMAIN_ID {domain}, discovery {reach}{hint}")


def clock_check(now: float) -> Check:
    """Is the clock set; stamps in bags come from it."""
    found = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now))
    if now < EARLIEST_CLOCK:
        return Check("clock", FAULT, found, "set it: sudo timedatectl set-ntp true")
    return Check("clock", OK, found)


def port_checks() -> Iterator[Check]:
    """The serial ports that are present: permitted, free. None is a fault, since it may belong to another device.

    Each is opened and closed again; nothing is sent.
    """
    from serial.tools.list_ports import comports

    ports = sorted(p.device for p in comports())
    if not ports:
        remedy = "only a real robot needs one: switch it on, plug it in or pair it"
        yield Check("ports", OK, f"no serial port present ({remedy})")
    for name in ports:
        yield port_check(name, wanted=False)


def port_check(name: str, wanted: bool = True) -> Check:
    """One serial port.

    Args:
      name: its path.
      wanted: it was named as the robot's; another may be in use, and nothing of it is a fault.
    """
    import serial

    label, bad = f"port {name}", FAULT if wanted else WARNING
    if not Path(name).exists():
        remedy = "switch the robot on and pair it; ./tcbi doctor lists what is there"
        return Check(label, bad, "does not exist", remedy)
    if not os.access(name, os.R_OK | os.W_OK):
        return Check(label, bad, "no permission", "sudo usermod -a -G dialout $USER, then log in again")
    try:
        serial.Serial(name, exclusive=True, timeout=0).close()
    except serial.SerialException as e:
        if "lock" in str(e) or "busy" in str(e).lower():
            if not wanted:
                return Check(label, OK, "in use")
            return Check(label, FAULT, "busy", f"another program holds it; find it with: fuser {name}")
        remedy = "give the robot's port; if it is that, its device has gone: unplug it and plug it in again"
        return Check(label, bad, f"is no serial port ({e})", remedy)
    return Check(label, OK, "there, permitted and free")


def robot_checks(
    port: str, sensor_port: str = "", calibration_file: str = "", baud_rate: int = 0, sensor_baud_rate: int = 0
) -> Iterator[Check]:
    """The robot behind a port, or behind two: every servo, the sensor board, one sample. Nothing moves.

    Args:
      port: the sensor board's if it carries the servo bus, else the servo bus.
      sensor_port: the sensor board's own port, or empty.
      calibration_file: the robot's; empty for the shipped one.
      baud_rate: of `port`, bit/s; 0 for the driver's own.
      sensor_baud_rate: of `sensor_port`.
    """
    from hexapod_driver import calibration
    from hexapod_driver.errors import CalibrationError
    from hexapod_driver.link import LinkSettings
    from hexapod_driver.probe import probe
    from hexapod_driver.serial_port import BAUD_RATE, SENSOR_BAUD_RATE

    ports = [port_check(name) for name in (port, sensor_port) if name]
    yield from ports
    if any(check.status == FAULT for check in ports):
        return
    try:
        robot = calibration.load(calibration_file)
    except CalibrationError as error:
        yield Check("calibration", FAULT, str(error), "correct the file; docs/driver.md says what stands in it")
        return
    rates = baud_rate or BAUD_RATE, sensor_baud_rate or SENSOR_BAUD_RATE
    for finding in probe(LinkSettings(port, rates[0], sensor_port, rates[1], robot)):
        yield dataclasses.replace(finding, name=f"robot: {finding.name}")
