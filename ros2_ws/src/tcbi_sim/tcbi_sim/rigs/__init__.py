"""The built-in rigs by name."""

from tcbi_sim.errors import UnknownNameError
from tcbi_sim.rig import Rig
from tcbi_sim.rigs.hexapod import hexapod_rig
from tcbi_sim.rigs.servo_bench import motor_bench_rig, servo_bench_rig

RIGS = {"hexapod": hexapod_rig, "servo_bench": servo_bench_rig, "motor_bench": motor_bench_rig}


def load_rig(name: str) -> Rig:
    """The built-in rig of this name.

    Raises:
      UnknownNameError: there is none.
    """
    if name not in RIGS:
        raise UnknownNameError("rig", name, tuple(RIGS))
    return RIGS[name]()
