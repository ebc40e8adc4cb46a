"""A replay's time step is as fine as the noise floor asks for."""

import numpy as np
from bench_recordings import BASE, record

from tcbi_infer.compare import compare
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.timestep import LEAST_STEP, USUAL_STEP, fine_step
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")


def test_the_step_is_halved_until_that_moves_nothing_beyond_the_floor():
    replay = Replay.of(MODEL, record(MODEL, BASE))
    wide = np.full(len(replay.layout.channels), 10.0)
    assert fine_step(replay, MODEL, wide) == USUAL_STEP
    at, finer = (replay.predict(MODEL, MODEL.mean()[None], timestep=step)[0] for step in (USUAL_STEP, USUAL_STEP / 2))
    moved = float(np.median(np.sqrt(np.mean((at - finer) ** 2, axis=1))))
    assert fine_step(replay, MODEL, wide / 10.0 * moved * 1.5) == USUAL_STEP / 2, "halved again it moves half as much"
    assert fine_step(replay, MODEL, wide * 1e-9) == LEAST_STEP


def test_a_comparison_says_with_which_step_it_was_made():
    rollouts = record(MODEL, BASE)
    assert compare(MODEL, rollouts, particles=0).timestep in (USUAL_STEP, USUAL_STEP / 2, LEAST_STEP)
    assert compare(MODEL, rollouts, particles=0, timestep=0.004).to_json()["timestep"] == 0.004
