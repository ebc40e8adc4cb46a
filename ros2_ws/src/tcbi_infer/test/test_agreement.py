"""Whether the kinds of motion agree on a parameter: planted differences are told, ordinary errors are not."""

import dataclasses
import types
from collections.abc import Sequence

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import CONTACT, JOINT, RATE, Channel, Group, Layout
from tcbi_infer.diagnose import adopt
from tcbi_infer.diagnose.agreement import LEAST_KINDS, agreement, disagreeing
from tcbi_infer.diagnose.evidence import Agreement
from tcbi_infer.diagnose.fit import Fit, Fitter, Nuisance
from tcbi_infer.diagnose.least_squares import gram
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.errors import InferError
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model, base_model
from tcbi_sim.parameter import Parameter

MODEL = base_model("servo_bench")
EQUAL, MIXED = (150,) * 7, (60, 150, 90, 240, 130, 250, 75)  # samples of seven kinds of motion


def told(recordings: Sequence[Measurement]) -> dict[str, Agreement]:
    """What is said of each parameter after a fit to all recordings."""
    replay = Replay.of(MODEL, recordings)
    residual = replay.measured - replay.by_rollout(replay.predict(MODEL, BASE[None])[0])
    floor = noise_floor(replay.layout, replay.measured, residual, replay.replicates)
    problem, sets = Problem.of(replay, floor.values), np.arange(len(replay.replicates))
    none = Nuisance.none(problem)
    first = Fitter(problem, MODEL, none, sets, 0.002).run(MODEL.to_unit(BASE)[None], radii=(0.03,))
    problem = problem.with_autocorrelation(first.residual)
    fit = Fitter(problem, MODEL, none, sets, 0.002).run(first.unit[None], radii=(0.03, 0.03))
    covariance = np.linalg.inv(fit.normal.sum(axis=0) + 1e-3 * np.eye(3))
    return {a.name: a for a in agreement(problem, fit, sets, covariance)}


def mixed(first: Sequence[Measurement], second: Sequence[Measurement]) -> list[Measurement]:
    """Every second kind of motion, both of its repeats, from the second robot."""
    return [(second if i // 2 % 2 else first)[i] for i in range(len(first))]


@pytest.fixture(scope="module")
def same() -> list[Measurement]:
    return record(MODEL, BASE)


def test_motions_of_one_robot_agree_and_each_holds_the_truth(same):
    found = told(same)
    assert all(a.agrees for a in found.values())
    for a, true in zip(found.values(), BASE, strict=True):
        assert len(a.kinds) == 7
        assert all(abs(k.value - true) < 2 * (k.high90 - k.low90) for k in a.kinds), a.name
    assert {k.kind for k in found["friction"].kinds} == {"sine", "fast", "steps", "ramp", "chirp", "walk", "saw"}


@pytest.mark.parametrize(("parameter", "factor"), [("friction", 3.0), ("gain", 1.7)])
def test_a_value_that_differs_between_motions_is_told_and_no_other(same, parameter, factor):
    other = BASE * np.where(np.array(MODEL.names) == parameter, factor, 1.0)
    found = told(mixed(same, record(MODEL, other)))
    assert [a.name for a in disagreeing(list(found.values()))] == [parameter]
    values = {k.kind: k.value for k in found[parameter].kinds}
    assert values["fast"] > 1.2 * values["sine"] and "no one value holds" in found[parameter].statement


def test_errors_that_have_nothing_to_do_with_a_parameter_are_no_disagreement(same):
    """Teeth that no parameter of the model could imitate, at three times the noise."""
    shifted = [
        dataclasses.replace(m, joint_position=m.joint_position + 0.005 * np.sin(36.0 * m.joint_position)) for m in same
    ]
    assert not disagreeing(list(told(shifted).values()))


def test_too_few_kinds_of_motion_tell_nothing(same):
    few = told(same[: 2 * (LEAST_KINDS - 1)])
    assert {a.agrees for a in few.values()} == {None} and not disagreeing(list(few.values()))


class Synthetic:
    """Kinds of motion of some lengths (in samples); one parameter acts on one kind of signal, and is known well."""

    def __init__(self, lengths: Sequence[int], group: Group, seed: int) -> None:
        layout = Layout(("a",), ("l",), tuple(Channel(g.name, g, 0) for g in (JOINT, RATE, CONTACT)))
        observed = np.zeros((len(lengths), max(lengths), 3))
        for s, length in enumerate(lengths):
            observed[s, length:] = np.nan
        weight = (layout.kept(max(lengths)) & np.isfinite(observed)).astype(float)
        measurements = [types.SimpleNamespace(policy_id=f"motion{s}") for s in range(len(lengths))]
        sets = [types.SimpleNamespace(members=(s,)) for s in range(len(lengths))]
        replay = types.SimpleNamespace(layout=layout, measurements=measurements, replicates=sets)
        self.problem = Problem(replay, observed, weight, np.ones(3), np.arange(3), np.ones(3), np.arange(len(sets)))
        self.acts = np.array([c.group is group for c in layout.channels], float)
        self.rng = np.random.default_rng(seed)

    def smooth(self) -> np.ndarray:
        """(S, T, C) of unit variance, correlated over some ten samples."""
        decay = np.exp(-np.arange(30) / 4.0)
        white = self.rng.normal(size=(*self.problem.observed.shape[::2], self.problem.observed.shape[1] + 29))
        windows = np.lib.stride_tricks.sliding_window_view(white, 30, axis=-1)
        return np.swapaxes(windows @ (decay / np.linalg.norm(decay)), 1, 2)

    def told(self, signature: np.ndarray, error: np.ndarray) -> Agreement:
        """What is said after a fit to recordings that err by `error` (S, T, C)."""
        problem, sets, none = self.problem, np.arange(len(self.problem.observed)), Nuisance.none(self.problem)
        size = Parameter("size", "1", -1.0, 1.0, 0.0)
        model = Model("one-v0", "hexapod", (), (size,), np.zeros((1, 1)), np.zeros(1))
        residual, scale, slopes = problem.residual(-error), np.ones(3), (signature * self.acts)[..., None]
        bend = np.zeros_like(residual)
        precision = Fitter(problem, model, none, sets, 0.0).precision(residual, scale, bend)
        normal, slope = gram(slopes, residual, precision)
        unit, square, loss = np.array([0.5]), np.zeros(len(sets)), np.zeros(len(sets))
        fit = Fit(
            model, unit, none, np.zeros(0), -error, residual, loss, scale, normal, slope, square, slopes, bend, True
        )
        return agreement(problem, fit, sets, np.array([[1e-4]]), int(self.rng.integers(2**31)))[0]


@pytest.mark.parametrize(("group", "lengths"), [(RATE, MIXED), (CONTACT, EQUAL), (CONTACT, MIXED)])
def test_errors_of_averaged_signals_raise_no_more_alarms_than_the_level_says(group, lengths):
    """Of 120 at 1 % more than 6 are due to chance once in 3000 times."""
    data = Synthetic(lengths, group, seed=1)
    p = [data.told(100 * data.smooth(), data.smooth()).p for _ in range(120)]
    assert sum(value < 0.01 for value in p) <= 6


@pytest.mark.parametrize("group", [JOINT, RATE, CONTACT])
@pytest.mark.parametrize("lengths", [EQUAL, MIXED])
def test_a_difference_between_motions_that_only_averaged_signals_show_is_told(group, lengths):
    data = Synthetic(lengths, group, seed=2)
    signature, other = 30 * data.smooth(), np.where(np.arange(7) % 2, 0.08, -0.08)[:, None, None]
    found = data.told(signature, data.smooth() + other * signature * data.acts)
    assert found.agrees is False and "no one value holds" in found.statement


@pytest.mark.parametrize("lengths", [EQUAL, MIXED])
def test_of_a_parameter_that_does_the_same_at_all_times_nothing_is_told(lengths):
    """Neither where the kinds differ by ten times their errors, nor where errors have heavy tails."""
    data = Synthetic(lengths, RATE, seed=3)
    for apart in (0.0, 1.0, 5.0):
        error = data.smooth() * np.exp(data.smooth()) + np.where(np.arange(7) % 2, apart, -apart)[:, None, None]
        found = data.told(np.full(error.shape, 100.0), error)
        assert (found.agrees, found.p, len(found.kinds)) == (None, None, 7)
        assert "cannot be told" in found.statement and not disagreeing([found])


def test_motions_too_short_to_be_shifted_tell_nothing():
    data = Synthetic((40, 35, 44), RATE, seed=4)
    assert data.told(100 * data.smooth(), data.smooth()).agrees is None


def diagnosis(agrees: bool | None, parameter: str = "backlash.gap") -> dict:
    """A diagnosis of backlash, as it is written, as far as offering a value takes it."""
    told = {"name": parameter, "agrees": agrees, "statement": f"{parameter}: the kinds of motion disagree."}
    return {
        "ranking": [{"use": "backlash", "parameters": [{"name": "backlash.gap"}]}],
        "agreement": {"backlash": [told]},
    }


def test_a_size_on_which_the_motions_disagree_is_not_offered():
    told = adopt.objection(diagnosis(False), "backlash")
    assert "backlash.gap: the kinds of motion disagree" in told and "--anyway" in told


@pytest.mark.parametrize("found", [diagnosis(True), diagnosis(None), diagnosis(False, "gain"), {"ranking": []}])
def test_what_agrees_or_is_not_known_or_is_of_the_base_model_is_offered(found):
    assert not adopt.objection(found, "backlash")


def test_a_version_is_not_made_of_sizes_on_which_the_motions_disagree(monkeypatch):
    monkeypatch.setattr(adopt, "adopt", lambda model, use, found: model)
    assert adopt.offered("a model", "backlash", diagnosis(True)) == "a model"
    with pytest.raises(InferError, match="not offered for use"):
        adopt.offered("a model", "backlash", diagnosis(False))


def test_a_base_parameter_on_which_the_motions_disagree_is_as_wide_as_their_values_are_apart():
    """The others keep their spread, and where all agree nothing is wider."""
    middle, step = MODEL.from_unit(np.full(3, 0.5)), np.array([0.0, 0.2, 0.0])
    ends = MODEL.from_unit(np.array([0.5 - step, 0.5 + step]))[:, 1]
    kinds = [{"kind": kind, "value": float(end)} for kind, end in zip(("sines", "steps"), ends, strict=True)]
    said = {"name": MODEL.parameters[1].name, "statement": "The kinds of motion disagree.", "kinds": kinds}
    base = {"use": "", "refined": True, "accepted": False, "values": middle, "spread": np.eye(3) * 0.02**2}
    found = {
        **{"model": MODEL.version, "verdict": "nothing_missing", "statement": "", "rollouts": [], "sealed": []},
        **{"errors": {}, "floor_from_replicates": True, "ranking": []},
        "base": {**base, "error_after": 1.0, "parameters": []},
    }

    def reach(agrees: bool) -> tuple[np.ndarray, list[str]]:
        version = adopt.adopt(MODEL, "", {**found, "agreement": {"": [{**said, "agrees": agrees}]}})
        unit = version.to_unit(version.particles)
        return np.quantile(unit, 0.95, axis=0) - np.quantile(unit, 0.05, axis=0), version.evidence["disagreements"]

    (wide, told), (narrow, silent) = reach(agrees=False), reach(agrees=True)
    assert wide[1] == pytest.approx(0.4, rel=0.05)
    assert np.delete(wide, 1) == pytest.approx(np.delete(narrow, 1)) and narrow == pytest.approx(0.066, rel=0.05)
    assert told == ["The kinds of motion disagree. Its interval reaches over all of them."] and not silent
