"""What fits are held against: the same motions on either side of every comparison."""

import bench_recordings
import numpy as np
import pytest

from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.replicates import Split
from tcbi_infer.diagnose.evidence import OUTSIDE_LIBRARY, Misfit
from tcbi_infer.diagnose.judge import Judge
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.verdict import better_misfit, rule
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")
MOVING = bench_recordings.motions()
CALM = {"rest": np.zeros(25), "drift": np.linspace(0.0, 0.005, 25)}
KINDS = len(MOVING) + len(CALM)


@pytest.fixture
def replay(monkeypatch) -> Replay:
    """Nine kinds of motion of a bench that is twice as stiff as the model; the last two are calm."""
    monkeypatch.setattr(bench_recordings, "motions", lambda: {**MOVING, **CALM})
    return Replay.of(MODEL, bench_recordings.record(MODEL, bench_recordings.BASE * [2.0, 1.0, 1.0]))


def judge(replay: Replay, calm_sealed: bool) -> Judge:
    moving, calm = np.split(np.arange(KINDS), [len(MOVING)])
    opened, sealed = (moving, calm) if calm_sealed else (np.r_[calm, moving[:-2]], moving[-2:])
    floor = replay.noise_floor(np.zeros_like(replay.measured))
    problem = Problem.of(replay, floor.values)
    split = Split(tuple((int(s),) for s in opened), tuple(map(int, sealed)))
    return Judge(MODEL, problem, split, floor, 0.002)


def test_calm_sealed_motions_do_not_speak_for_a_model_that_errs_on_the_open_ones(replay):
    calm = judge(replay, calm_sealed=True)
    unfitted = calm.unfitted_misfit()
    assert len(replay.replicates) == KINDS and calm.unfitted < 3.0 < unfitted.total
    assert min(unfitted.by_kind.values()) <= unfitted.total <= max(unfitted.by_kind.values())
    base = Misfit(0.9 * unfitted.total, unfitted.by_kind)
    assert better_misfit(base, unfitted) is base
    assert rule([], base, 7, unfitted, unseen=calm.unfitted).verdict == OUTSIDE_LIBRARY


def test_without_sealed_motions_both_errors_of_the_model_as_it_was_are_the_same(replay):
    hard = judge(replay, calm_sealed=False)
    assert hard.unfitted > hard.unfitted_misfit().total
    every = Judge(MODEL, hard.problem, Split(tuple((s,) for s in range(KINDS)), ()), hard.floor, 0.002)
    assert every.unfitted == every.unfitted_misfit().total
