"""All rigs by name: built in, described by files that come with this package, and the user's own files.

The user's own lie in the folder that TCBI_RIGS names, else in `rigs` of the store (docs/rigs.md).
"""

import functools
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from tcbi_sim.errors import UnknownNameError
from tcbi_sim.places import rigs_folder
from tcbi_sim.rig import Rig
from tcbi_sim.rig_file import RigFileError, read_rig
from tcbi_sim.rigs.hexapod import hexapod_rig
from tcbi_sim.rigs.servo_bench import motor_bench_rig, servo_bench_rig

DESCRIBED = Path(str(resources.files("tcbi_sim.rigs"))) / "described"


@functools.cache
def _read(path: Path, changed: int) -> Rig:
    return read_rig(path)


def _reader(path: Path) -> Callable[[], Rig]:
    return lambda: _read(path, path.stat().st_mtime_ns)


RIGS: dict[str, Callable[[], Rig]] = {
    "hexapod": hexapod_rig,
    "servo_bench": servo_bench_rig,
    "motor_bench": motor_bench_rig,
    **{path.stem: _reader(path) for path in sorted(DESCRIBED.glob("*.toml"))},
}


def user_rigs() -> dict[str, Path]:
    """Name and file of each rig of the user's own, usable or not."""
    return {path.stem: path for path in sorted(rigs_folder().glob("*.toml"))}


def rig_names() -> tuple[str, ...]:
    """Every rig that there is a name of."""
    return tuple(dict.fromkeys([*RIGS, *user_rigs()]))


def usable_rigs() -> tuple[str, ...]:
    """Those whose files can be used."""
    return tuple(name for name in rig_names() if _usable(name))


def _usable(name: str) -> bool:
    try:
        load_rig(name)
    except RigFileError:
        return False
    return True


def missing_sensors(rig: Rig) -> tuple[str, ...]:
    """The fields of a measurement that a rig's simulation does not have."""
    imu = () if rig.has_imu else ("attitude", "angular_velocity", "linear_acceleration")
    return (*imu, *(() if rig.foot_names else ("contact",)), *(() if rig.floating else ("position",)))


def load_rig(name: str) -> Rig:
    """The rig of this name.

    Raises:
      UnknownNameError: there is none.
      RigFileError: its file cannot be used.
    """
    own = user_rigs().get(name)
    if name in RIGS:
        if own is not None:
            raise RigFileError(own, [f"the name {name!r} is that of a built-in rig; rename the file"])
        return RIGS[name]()
    if own is None:
        raise UnknownNameError("rig", name, rig_names())
    return _reader(own)()
