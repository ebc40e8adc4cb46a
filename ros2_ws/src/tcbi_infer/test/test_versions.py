"""Two versions of a model side by side, and a version that an effect was removed from."""

import dataclasses
import zlib

import numpy as np
import pytest

from tcbi_infer.compare import replay as replay_module
from tcbi_infer.compare.comparison import error_figure
from tcbi_infer.compare.history import history
from tcbi_infer.compare.ladder import was_seen
from tcbi_infer.compare.versions import compare_versions, linked_parameters, marginal_evidence
from tcbi_infer.errors import InferError
from tcbi_infer.report import Report, add_difference, add_kept_ladder, add_version
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model, base_model

KEY = "rotor_inertia"


def model(gain: tuple[float, float], link: float = 0.0, version: str = "servo_bench-v1") -> Model:
    """A bench with one effect: gain uniform between two values, the effect's size following it by `link` (0 to 1)."""
    base = base_model("servo_bench").with_effect(KEY)
    rng = np.random.default_rng(0)
    share = rng.random((200, len(base.names)))
    share[:, -1] = link * share[:, 0] + (1 - link) * share[:, -1]
    values = base.from_unit(0.4 + 0.2 * share)
    values[:, 0] = gain[0] + (gain[1] - gain[0]) * share[:, 0]
    made = base.with_particles(values, rollouts=["a", "b"], statement="why", error_over_floor=1.4, kind="diagnosis")
    return dataclasses.replace(made, version=version)


def test_added_and_removed_effects_are_named():
    base, with_effect = base_model("servo_bench"), model((4e-3, 5e-3))
    there, back = compare_versions(base, with_effect), compare_versions(with_effect, base)
    assert (there.effects_added, there.effects_removed) == ((KEY,), ())
    assert (back.effects_added, back.effects_removed) == ((), (KEY,))
    own = next(p for p in there.parameters if p.name == f"{KEY}.inertia")
    assert own.before is None and own.after is not None and own.overlap is None


@pytest.mark.parametrize(
    ("other", "overlap", "ratio"),
    [((2e-3, 4e-3), 1.0, 1.0), ((2e-3, 2.4e-3), 1.0, 0.27), ((8e-3, 9e-3), 0.0, None)],
)
def test_intervals_that_lie_in_each_other_overlap_wholly_and_those_apart_not_at_all(other, overlap, ratio):
    change = compare_versions(model((2e-3, 4e-3)), model(other, version="servo_bench-v2")).parameters[0]
    assert change.name == "gain" and change.overlap == pytest.approx(overlap, abs=0.2)
    if ratio:
        assert change.width_ratio == pytest.approx(ratio, abs=0.06)


def test_the_statement_names_what_is_apart():
    d = compare_versions(model((2e-3, 3e-3)), model((8e-3, 9e-3), version="servo_bench-v2"))
    assert "gain do not overlap" in d.statement and "same effects" in d.statement


def test_what_both_rest_on_stands_side_by_side():
    d = compare_versions(base_model("servo_bench"), model((2e-3, 3e-3)))
    assert (d.grounds_before.kind, d.grounds_before.error_over_floor) == ("built in", None)
    assert d.grounds_after.rollouts == ("a", "b") and d.grounds_after.error_over_floor == 1.4
    assert compare_versions(model((2e-3, 3e-3)), model((2e-3, 3e-3))).rollouts_shared == 2


def test_versions_of_different_rigs_are_refused():
    with pytest.raises(InferError, match="one rig"):
        compare_versions(base_model("hexapod"), base_model("servo_bench"))


def test_parameters_that_were_fitted_together_with_a_removed_effect_are_named():
    tied, free = model((2e-3, 4e-3), link=0.9), model((2e-3, 4e-3), link=0.0)
    assert set(linked_parameters(tied, KEY)) == {"gain"} and linked_parameters(tied, KEY)["gain"] > 0.9
    assert linked_parameters(free, KEY) == {}
    told = marginal_evidence(tied, KEY)
    assert "gain: correlation +" in told["statement"] and "marginalised" in told["statement"]
    assert told["rollouts"] == ["a", "b"], "what was fitted to stays seen"
    assert "None of them went with it" in marginal_evidence(free, KEY)["statement"]


def test_the_report_of_a_difference_shows_both_versions():
    report = Report("two versions")
    add_difference(report, compare_versions(model((2e-3, 4e-3)), model((8e-3, 9e-3), version="servo_bench-v2")))
    for words in ("servo_bench-v1", "servo_bench-v2", "do not overlap", "error over noise floor", "<svg"):
        assert words in report.html()


def test_the_way_to_a_version_is_shown_as_far_as_its_errors_are_known():
    first, base = model((2e-3, 4e-3)), base_model("servo_bench")
    second = dataclasses.replace(first, version="servo_bench-v2", parent=first.version)
    second = dataclasses.replace(second, evidence={**first.evidence, "nothing_held_out": True})
    report = Report("the way")
    add_kept_ladder(report, second, [base, first, second])
    assert "The way to servo_bench-v2" in report.html() and f"servo_bench-v1 ({KEY})" in report.html()
    assert f"servo_bench-v2 ({KEY})" not in report.html(), "an error on the fit's own motion is no rung"
    third = dataclasses.replace(second, version="servo_bench-v3", parent=second.version)
    third = dataclasses.replace(third, evidence={"errors": {"unfitted": 4.0}, "sealed": ["new"]})
    errors = {v.model: v.error_over_floor for v in history([base, first, second, third])}
    assert errors["servo_bench-v2"] == 4.0, "measured by the next diagnosis, on motions that it had not seen"
    nothing = Report("nothing")
    add_kept_ladder(nothing, base, [base])
    assert [s.title for s in nothing.sections] == ["The way to servo_bench-v0"]
    assert "No error was measured on the way here" in nothing.html() and "<svg" not in nothing.html()


def test_an_effect_added_by_its_prior_is_drawn():
    base, report = base_model("servo_bench"), Report("a prior")
    add_version(report, base, dataclasses.replace(base.with_effect("backlash"), version="servo_bench-v1"))
    assert "<svg" in report.html() and "backlash.gap" in report.html()


def recorded(*names: str) -> list[Measurement]:
    """Ramps of the bench, of each name another."""
    return [ramp(name, 0.5 + zlib.crc32(name.encode()) % 100 / 100) for name in names]


def ramp(name: str, end: float) -> Measurement:
    """A ramp of the bench up to `end` (rad)."""
    base = base_model("servo_bench")
    values = np.array([[p.nominal for p in base.parameters]])
    commands = Commands(np.arange(10) * 0.1, np.linspace(0, end, 10)[:, None])
    out = simulate(base, values, [Scenario("log", 1.0, settle=0.0)], commands=[commands])
    return dataclasses.replace(out.measurement(0), rollout_id=name, commands=commands)


def fitted_to(*names: str, version: str = "servo_bench-v1") -> Model:
    base = base_model("servo_bench")
    return dataclasses.replace(base.with_particles(base.particles, inference={"rollouts": names}), version=version)


def test_rollouts_of_an_inference_count_as_seen_in_the_history():
    lines = history([base_model("servo_bench"), fitted_to("seen")], recorded("seen", "new"))
    assert {line.rollouts for line in lines} == {("new",)}


def test_a_repeat_of_a_rollout_that_a_fit_has_seen_is_no_unseen_one():
    given = [ramp("seen", 1.0), ramp("again", 1.0), ramp("new", 0.7)]
    assert history([fitted_to("seen")], given)[0].rollouts == ("new",)
    assert history([fitted_to("elsewhere")], given)[0].rollouts == ("seen", "again", "new")


def test_pieces_of_a_recording_that_a_fit_has_seen_whole_are_seen():
    rest, moving = (
        dataclasses.replace(m.scenario, initial_joint_velocity=v) for m in recorded("x") for v in (None, (0.0,))
    )
    pieces = [dataclasses.replace(m, scenario=moving) for m in recorded("run-01", "run-102", "other-01")]
    whole = [dataclasses.replace(m, scenario=rest) for m in recorded("run-2026")]
    lines = history([fitted_to("run")], [*pieces, *whole])
    assert lines[0].rollouts == ("other-01", "run-2026")
    assert was_seen(pieces[0], {"run-01"}) and not was_seen(whole[0], {"run"})
    (log,) = [dataclasses.replace(m, scenario=rest) for m in recorded("run")]
    assert was_seen(log, {"run-03"}) and was_seen(pieces[0], {"run-99"}), "cut otherwise, and the same motion"


def test_rollouts_without_commands_are_not_counted_as_compared():
    mute = dataclasses.replace(recorded("mute")[0], commands=Commands(np.empty(0), np.empty((0, 1))))
    assert history([base_model("servo_bench")], [mute, *recorded("told")])[0].rollouts == ("told",)


def test_the_floor_of_a_history_is_of_the_first_version_that_predicts(monkeypatch):
    def broken(model, *args, **options):
        out = simulate(model, *args, **options)
        out.diverged |= model.version == "servo_bench-v0"
        return out

    monkeypatch.setattr(replay_module, "simulate", broken)
    rng, (m,) = np.random.default_rng(0), recorded("a")
    m = dataclasses.replace(m, joint_position=m.joint_position + rng.normal(0, 0.02, m.joint_position.shape))
    second = fitted_to()
    lines = history([base_model("servo_bench"), second], [m])
    assert lines[0].error_over_floor == np.inf
    assert lines[1].error_over_floor == pytest.approx(error_figure(second, [m]))
