"""What diverges counts against the model, and is told; only what was not measured is left out."""

import numpy as np
import pytest
from bench_recordings import BASE, motions, record
from legged_cases import walk

from tcbi_infer.compare import replay as replay_module
from tcbi_infer.compare.comparison import compare, error_figure
from tcbi_infer.compare.errors import CompareError
from tcbi_infer.compare.ladder import explained
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.replicates import Split
from tcbi_infer.diagnose import diagnose, paired
from tcbi_infer.diagnose.evidence import NOT_CONVERGED
from tcbi_infer.diagnose.judge import Judge
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.settings import QUICK
from tcbi_infer.report import Report, add_comparison
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")
SLOPE = 0.1  # rad, of the second motion


@pytest.fixture(scope="module")
def rollouts():
    return walk()


def diverge(monkeypatch, which):
    """From now on simulations (N, S) of the second motion diverge where `which(N)` says so."""
    simulate = replay_module.simulate

    def broken(model, parameters, scenarios, **options):
        out = simulate(model, parameters, scenarios, **options)
        for s, scenario in enumerate(scenarios):
            if scenario.slope_roll == SLOPE:
                out.diverged[:, s] |= which(len(parameters))
        return out

    monkeypatch.setattr(replay_module, "simulate", broken)


def test_a_model_that_diverges_in_one_motion_is_not_judged_by_the_others(rollouts, monkeypatch):
    diverge(monkeypatch, lambda count: np.ones(count, bool))
    found = compare(MODEL, rollouts, particles=0)
    assert found.error_over_floor == np.inf and error_figure(MODEL, rollouts) == np.inf
    errors = {e.name: e.error for e in (*found.signals, *found.statistics)}
    assert errors["lf_tibia"] == errors["roll"] == errors["distance"] == errors["return"] == np.inf
    (sentence,) = [g for g in found.guards if "diverged" in g]
    assert "diverged in 2 of 4 rollouts (motion1_0, motion1_1): the error counts as infinite" in sentence
    report = Report("x")
    add_comparison(report, found)
    assert "inf times the noise floor" in report.html()


def test_a_model_that_diverges_everywhere_has_a_report(rollouts, monkeypatch):
    diverge(monkeypatch, lambda count: np.ones(count, bool))
    found = compare(MODEL, rollouts[2:], particles=0)
    report = Report("x")
    add_comparison(report, found)
    assert "Not told: the prediction diverged in every rollout." in report.html()


def test_what_one_rollout_did_not_measure_makes_no_error_infinite(rollouts):
    blind = walk(count=1, repeats=1)[0]
    blind.joint_position[40:50] = np.nan
    found = compare(MODEL, [blind, *rollouts[2:]], particles=0)
    assert np.isfinite(found.error_over_floor) and not any("diverged" in g for g in found.guards)


def test_particles_that_diverge_are_counted(rollouts, monkeypatch):
    diverge(monkeypatch, lambda count: (np.arange(count) < 3) & (count == 4))
    found = compare(MODEL, rollouts, particles=4)
    assert np.isfinite(found.error_over_floor)
    (sentence,) = [g for g in found.guards if "diverged" in g]
    assert sentence.startswith("3 of 4 particles diverged in 2 of 4 rollouts (motion1_0, motion1_1): the bands")


def test_motions_that_diverge_make_the_error_of_a_fit_infinite(rollouts, monkeypatch):
    replay = Replay.of(MODEL, rollouts)
    floor = replay.noise_floor(np.zeros_like(replay.measured))
    problem = Problem.of(replay, floor.values)
    diverge(monkeypatch, lambda count: np.ones(count, bool))
    judge = Judge(MODEL, problem, Split(((0,), (1,)), ()), floor, 0.002)
    assert judge.unfitted == np.inf
    assert sorted(np.isfinite(list(judge.unfitted_misfit().by_kind.values()))) == [False, True]


@pytest.mark.parametrize("lost", [-np.inf, np.nan])
def test_a_candidate_that_diverges_in_one_kind_of_motion_gains_nothing(lost):
    sizes = np.ones(5)
    gains = np.array([30.0, 25.0, 28.0, lost, 27.0])
    assert paired.statistic(gains, sizes) == paired.total(gains, sizes)[0] == -np.inf
    both = np.stack([gains, np.full(5, 27.0)], axis=-1)
    assert paired.statistic(both, sizes)[0] == -np.inf and paired.statistic(both, sizes)[1] > 5
    assert paired.statistic(gains[2:], sizes[2:]) == paired.statistic(gains[3:4], sizes[3:4]) == -np.inf


def test_where_only_the_base_model_diverges_the_kind_is_trimmed_as_any_large_gain_is():
    sizes = np.ones(5)
    gain = np.array([30.0, 25.0, 28.0, np.inf, 27.0])
    assert paired.statistic(gain, sizes) == paired.statistic(np.where(gain > 30, 1e6, gain), sizes)


def test_no_share_is_explained_of_an_infinite_error():
    assert np.isnan(explained(np.inf, 1.2)) and np.isnan(explained(3.0, np.inf))


def diverge_in(monkeypatch, names):
    """From now on every replay of some motions of the bench diverges."""
    simulate, targets = replay_module.simulate, [motions()[name] for name in names]

    def broken(model, parameters, scenarios, *, commands, **options):
        out = simulate(model, parameters, scenarios, commands=commands, **options)
        for s, asked in enumerate(commands):
            out.diverged[:, s] |= any(np.array_equal(asked.target[:, 0], target) for target in targets)
        return out

    monkeypatch.setattr(replay_module, "simulate", broken)


def test_a_motion_that_diverges_wherever_the_fit_could_start_is_left_out_and_named(monkeypatch):
    bench = base_model("servo_bench")
    late = record(bench.with_effect("command_latency"), np.r_[BASE, 0.06])
    late = [m for m in late if m.policy_id in ("fast", "steps", "chirp", "saw")]
    diverge_in(monkeypatch, ["fast"])
    found = diagnose(bench, late, uses=("command_latency",), settings=QUICK)
    assert (found.verdict, found.uses, found.kinds) == ("effect", ("command_latency",), 3)
    (told,) = [g for g in found.guards if "diverges" in g]
    assert "(fast_0, fast_1)" in told and found.claims[0].startswith("3 kinds of motion were held out in turn")
    assert np.isfinite(found.misfit.total) and found.base.converged


def test_a_fit_that_diverges_in_one_motion_or_another_wherever_it_goes_tells_nothing(monkeypatch):
    bench, simulate = base_model("servo_bench"), replay_module.simulate
    (gain, *_), steps = bench.parameters, motions()["steps"]

    def broken(model, parameters, scenarios, *, commands, **options):
        out = simulate(model, parameters, scenarios, commands=commands, **options)
        stiff = gain.to_unit(np.atleast_2d(parameters)[:, 0]) > 0.45
        for s, asked in enumerate(commands):
            out.diverged[:, s] |= stiff == np.array_equal(asked.target[:, 0], steps)
        return out

    monkeypatch.setattr(replay_module, "simulate", broken)
    rollouts = [m for m in record(bench, BASE) if m.policy_id in ("steps", "saw")]
    found = diagnose(bench, rollouts, uses=("command_latency",), settings=QUICK)
    assert (found.verdict, found.uses, found.ranking) == ("cannot_tell", (), ())
    assert found.headline == NOT_CONVERGED and not found.nothing_held_out


def test_where_every_motion_diverges_that_is_told_instead_of_a_verdict(monkeypatch):
    bench = base_model("servo_bench")
    diverge_in(monkeypatch, list(motions()))
    with pytest.raises(CompareError, match=r"diverges in every motion.*\(sine_0, sine_1, fast_0 and 11 more\)"):
        diagnose(bench, record(bench, BASE), uses=("backlash",), settings=QUICK)
