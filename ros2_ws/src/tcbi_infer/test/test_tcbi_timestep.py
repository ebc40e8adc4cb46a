"""The time step of an inference does not decide what it finds."""

import numpy as np
import pytest

from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.problem import Problem
from tcbi_policy.artefact import find_policy
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

NOISE = load_rig("hexapod").noise
TRUTH = {"friction": 0.8, "mass": 0.85, "gain": 6.0}


@pytest.mark.slow
def test_a_stiff_servo_is_not_taken_for_a_softer_one() -> None:
    """A hexapod in steps of 1 ms. One seed, which is fixed; the 90 % interval may miss one time in ten."""
    model, found, rng = base_model("hexapod"), [], np.random.default_rng(0)
    for name in ("gait:steps", "gait:stride"):
        gait = find_policy(name)
        slopes = rng.uniform(-0.15, 0.15, (4, 2))
        scenarios = [Scenario("balance", 1.6, roll, pitch, seed=s) for s, (roll, pitch) in enumerate(slopes)]
        values = np.array([[TRUTH[p] for p in model.names]])
        out = simulate(model, values, scenarios, controller=gait, timestep=0.001)
        out.joint_position += NOISE.joint_position * rng.standard_normal(out.joint_position.shape)
        found += [out.measurement(0, s, f"{name}_{s}", gait.policy_id) for s in range(4)]
    result = infer(Problem.of(model, found), seed=1, particles=30, generations=4)
    gain = result.estimates[model.names.index("gain")]
    assert abs(np.log(gain.mean / TRUTH["gain"])) < 0.13  # with steps of 10 ms 0.15, of 2.5 ms 0.04
    assert gain.low90 < TRUTH["gain"] < gain.high90
