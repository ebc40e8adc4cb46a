"""The built-in rigs by name."""

from tcbi_sim.rigs.hexapod import hexapod
from tcbi_sim.rigs.servo_bench import servo_bench

RIGS = {"hexapod": hexapod, "servo_bench": servo_bench}
