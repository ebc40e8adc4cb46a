"""A comparison from end to end, on motions whose truth and noise are known."""

import dataclasses
import re

import numpy as np
import pytest
from bench_recordings import BASE, record
from legged_cases import NOISE, walk

from tcbi_infer.compare import comparison as module
from tcbi_infer.compare.comparison import compare, error_figure
from tcbi_infer.compare.errors import CompareError
from tcbi_infer.compare.guards import guard
from tcbi_infer.compare.history import history
from tcbi_infer.compare.ladder import explained, ladder, lineage, unexplained
from tcbi_infer.report import Report, add_comparison, file_name
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")


@pytest.fixture(scope="module")
def rollouts():
    return walk()


@pytest.fixture(scope="module")
def found(rollouts):
    return compare(MODEL, rollouts, particles=4)


def named(errors, name):
    return next(e for e in errors if e.name == name)


def test_a_model_that_is_right_errs_by_the_noise_in_every_signal_and_statistic(found):
    assert found.error_over_floor == pytest.approx(1.0, abs=0.15)
    knee = named(found.signals, "lf_tibia")
    assert knee.error == pytest.approx(np.degrees(NOISE), rel=0.2) and knee.floor_from == "replicates"
    assert named(found.signals, "distance").error == pytest.approx(NOISE * np.sqrt(2), rel=0.5)
    assert {"reward", "distance"} <= {e.name for e in found.signals}
    statistics = {"return", "final_inclination", "distance_end", "contact_ratio_lf", "contact_ratio_rr"}
    assert statistics <= {e.name for e in found.statistics}
    assert all(e.ratio < 3 for e in found.statistics)


def test_a_foot_that_never_touches_shows_in_its_contact_ratio_alone(rollouts):
    lifted = []
    for m in rollouts:
        contact = m.contact.copy()
        contact[:, 0] = False
        lifted.append(dataclasses.replace(m, contact=contact))
    statistics = compare(MODEL, lifted, particles=0).statistics
    share = np.sqrt(np.mean([m.contact[:, 0].mean() ** 2 for m in rollouts]))
    assert named(statistics, "contact_ratio_lf").error == pytest.approx(share, abs=0.05)
    assert named(statistics, "contact_ratio_lm").ratio < 3


def test_without_repeats_every_floor_says_that_it_is_estimated(rollouts):
    single = compare(MODEL, rollouts[::2], particles=0)
    assert {e.floor_from for e in (*single.signals, *single.statistics)} == {"residual", "minimum"}
    assert np.isnan(named(single.statistics, "return").noise_floor), "two rollouts cannot show their own scatter"


def test_copies_of_a_recording_make_no_floor_for_any_signal_or_statistic(rollouts):
    copies = [rollouts[0], dataclasses.replace(rollouts[0], rollout_id="copy")]
    once, twice = (compare(base_model("hexapod"), given, particles=0) for given in (copies[:1], copies))
    assert {e.floor_from for e in (*twice.signals, *twice.statistics)} == {"residual", "minimum"}
    assert [e.noise_floor for e in twice.signals] == pytest.approx([e.noise_floor for e in once.signals], nan_ok=True)
    thrice = compare(
        base_model("hexapod"), [*copies, dataclasses.replace(rollouts[0], rollout_id="another")], particles=0
    )
    assert np.isnan(named(thrice.statistics, "return").noise_floor), "copies do not scatter"


def test_bands_and_scores_do_not_depend_on_how_many_motions_fit_into_memory(rollouts, found, monkeypatch):
    monkeypatch.setattr(module, "MEMORY", 1)
    one_by_one = compare(MODEL, rollouts, particles=4)
    assert one_by_one.signals == found.signals and one_by_one.statistics == found.statistics


def test_a_repeat_that_is_late_as_a_whole_is_set_right_before_any_error_is_measured(rollouts, found):
    late = [rollouts[0], dataclasses.replace(rollouts[1], time=rollouts[1].time + 0.08), *rollouts[2:]]
    put_right = compare(MODEL, late, particles=0)
    assert any("All signals come 80 ms later" in g for g in put_right.guards) and found.guards == ()
    assert put_right.error_over_floor == pytest.approx(1.0, abs=0.3)


def test_a_latency_of_one_joint_is_kept_and_told_as_its_lag(rollouts):
    late = []
    for m in rollouts:
        joints = m.joint_position.copy()
        joints[4:, 7] = m.joint_position[:-4, 7]
        late.append(dataclasses.replace(m, joint_position=joints))
    kept = compare(MODEL, late, particles=0)
    assert kept.guards == ()
    assert kept.where[0].channels == ("lr_femur",)
    lag = re.search(r"lags the prediction by (\d+) ms", kept.where[0].statement)
    assert lag and 65 < int(lag[1]) < 85, "a straight line through the error tells long lags a little short"


def test_a_parameter_that_changes_nothing_is_named_and_only_that(rollouts, found):
    bench = base_model("servo_bench")
    still = Commands(np.arange(5) * 0.2, np.zeros((5, 1)))
    out = simulate(bench, bench.mean()[None], [Scenario("log", 1.0, settle=0.0)], commands=[still])
    hanging = dataclasses.replace(out.measurement(0), commands=still)
    guards = compare(bench, [hanging], particles=0).guards
    assert sum("changes nothing" in g for g in guards) == len(bench.names)
    assert not any("changes nothing" in g for g in found.guards)


def test_more_particles_than_allowed_are_refused(rollouts):
    with pytest.raises(CompareError, match="allowed is 0 to 256"):
        compare(MODEL, rollouts, particles=1000)


def test_the_ladder_leads_from_the_base_model_to_the_one_compared(rollouts):
    child = dataclasses.replace(
        MODEL.with_effect("backlash").with_particles(MODEL.with_effect("backlash").particles, rollouts=["motion0_0"]),
        version="hexapod-v1",
    )
    line = lineage(child, [child, MODEL])
    assert [m.version for m in line] == ["hexapod-v0", "hexapod-v1"]
    c = compare(child, rollouts, particles=0)
    rungs = ladder(c, line, rollouts)
    assert [r.label for r in rungs] == ["hexapod-v0: base model, not fitted", "hexapod-v1: with backlash"]
    assert [r.fitted_here for r in rungs] == [False, True]
    assert rungs[0].error_over_floor == pytest.approx(error_figure(MODEL, rollouts, floor=c.floor))
    report = Report("x")
    add_comparison(report, c, rungs=rungs)
    page = report.html()
    assert "the robot against itself" in page and "left unexplained" in page and "fitted to some of these" in page


def test_only_repeats_let_a_report_speak_of_the_robot_against_itself(rollouts):
    single = compare(MODEL, rollouts[::2], particles=0)
    report = Report("x")
    add_comparison(report, single, rungs=ladder(single, [MODEL], rollouts[::2]))
    assert "noise floor, estimated" in report.html() and "the robot against itself" not in report.html()


def test_squares_beyond_the_floor_add_up():
    assert unexplained(np.sqrt(1 + 3.0**2)) == pytest.approx(3.0) and unexplained(0.8) == 0.0
    assert explained(np.sqrt(1 + 4.0**2), np.sqrt(1 + 2.0**2)) == pytest.approx(0.75)


def version(number, parent, **evidence):
    return dataclasses.replace(
        MODEL.with_particles(MODEL.particles, **evidence), version=f"hexapod-v{number}", parent=parent
    )


def test_no_figure_is_kept_for_a_version_that_was_fitted_to_the_rollouts_it_was_measured_on():
    first = version(1, "hexapod-v0", rollouts=["a"])
    fresh = version(2, "hexapod-v1", rollouts=["b"], errors={"unfitted": 4.0}, error_over_floor=2.0)
    again = version(2, "hexapod-v1", rollouts=["a", "b"], errors={"unfitted": 4.0}, error_over_floor=2.0)
    sealed = version(2, "hexapod-v1", rollouts=["a"], sealed=["c"], errors={"unfitted": 4.0}, error_over_floor=2.0)
    kept = [history([MODEL, first, child])[1].error_over_floor for child in (fresh, again, sealed)]
    assert kept == [4.0, None, 4.0]


def test_what_an_ancestor_was_fitted_to_counts_as_seen():
    first = version(1, "hexapod-v0", rollouts=["a"])
    second = version(2, "hexapod-v1", rollouts=["b"])
    third = version(3, "hexapod-v2", rollouts=["a"], errors={"unfitted": 4.0}, error_over_floor=2.0)
    assert history([MODEL, first, second, third])[2].error_over_floor is None


def test_reports_of_other_rollouts_have_other_names():
    names = {file_name("compare", "hexapod-v1", r) for r in (("a", "b"), ("a", "c"), ("a",), ())}
    assert len(names) == 4 and file_name("compare", "v", ("a", "b")) == file_name("compare", "v", ("b", "a"))


def test_what_lasts_a_few_samples_only_is_refused_with_the_unit_of_its_times_in_doubt():
    (m,) = record(base_model("servo_bench"), BASE)[:1]
    hasty = dataclasses.replace(m, time=m.time / 1000, scenario=dataclasses.replace(m.scenario, duration=0.005))
    with pytest.raises(CompareError, match=r"lasts only 0\.005 s, .*is the unit of its times right"):
        compare(base_model("servo_bench"), [hasty])


def test_signals_that_the_rig_has_no_sensor_for_are_left_out_and_told():
    (m,) = record(base_model("servo_bench"), BASE)[:1]
    turned = dataclasses.replace(m, attitude=np.tile([1.0, 0, 0, 0], (len(m.time), 1)))
    found = compare(base_model("servo_bench"), [turned], particles=0)
    assert [s.name for s in found.signals] == [s.name for s in compare(base_model("servo_bench"), [m]).signals]
    assert any("servo_bench has no sensor for attitude: that is not compared" in told for told in found.guards)


def test_a_joint_that_changes_by_rounding_alone_is_looked_at_all_the_same():
    (m,) = record(base_model("servo_bench"), BASE)[:1]
    still = dataclasses.replace(m, joint_position=1e-12 * np.random.default_rng(0).random(m.joint_position.shape))
    assert isinstance(guard([still]), list)


def test_a_copy_that_was_cut_is_no_repeat():
    (m,) = record(base_model("servo_bench"), BASE)[:1]
    half = len(m.time) // 2
    cut = dataclasses.replace(m, rollout_id="cut", time=m.time[:half], joint_position=m.joint_position[:half])
    assert any("again to the last bit" in told for told in guard([m, cut]))
    assert not compare(base_model("servo_bench"), [m, cut], particles=0).floor.from_replicates
