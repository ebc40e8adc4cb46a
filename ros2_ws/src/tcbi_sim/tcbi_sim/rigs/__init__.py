"""The built-in rigs by name."""

from tcbi_sim.rigs.hexapod import hexapod_rig
from tcbi_sim.rigs.servo_bench import motor_bench_rig, servo_bench_rig

RIGS = {"hexapod": hexapod_rig, "servo_bench": servo_bench_rig, "motor_bench": motor_bench_rig}
