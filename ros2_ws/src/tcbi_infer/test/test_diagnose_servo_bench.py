"""A diagnosis from end to end on a servo bench whose truth is known; another time step plays the robot."""

import dataclasses
import json

import numpy as np
import pytest
from bench_recordings import BASE, NOISE, record

from tcbi_infer.compare import compare
from tcbi_infer.compare.errors import NothingToCompareError, WrongRigError
from tcbi_infer.compare.history import VersionError, history, remember
from tcbi_infer.diagnose import Diagnosis, adopt, diagnose
from tcbi_infer.diagnose.leftover import POSITION
from tcbi_infer.diagnose.settings import QUICK, Settings
from tcbi_infer.errors import InferError
from tcbi_infer.report import Report, add_diagnosis
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import base_model

CANDIDATES = ("command_latency", "rotor_inertia", "torque_saturation")


@pytest.fixture(scope="module")
def late() -> Diagnosis:
    truth = base_model("servo_bench").with_effect("command_latency")
    return diagnose(base_model("servo_bench"), record(truth, np.r_[BASE, 0.06]), uses=CANDIDATES)


def test_a_hidden_latency_is_named(late):
    assert (late.verdict, late.effects) == ("effect", ("command_latency",))
    assert late.statement.startswith("The model lacks command_latency")


def test_its_size_is_inside_the_interval_and_the_interval_leaves_out_zero(late):
    (delay,) = late.ranking[0].parameters
    assert delay.low90 <= 0.06 <= delay.high90
    assert delay.excludes_null and delay.high90 - delay.low90 < 0.02


def test_a_latency_of_less_than_half_a_time_step_may_be_the_simulations_own():
    truth = base_model("servo_bench").with_effect("command_latency")
    found = diagnose(base_model("servo_bench"), record(truth, np.r_[BASE, 0.0008]), uses=["command_latency"])
    assert found.verdict == "nothing_missing"
    for e in found.ranking:
        assert not any(p.excludes_null for p in e.parameters)


def test_the_error_falls_to_the_noise_floor_on_sealed_motions(late):
    best = late.ranking[0]
    assert best.error_before > 3.0 and best.error_after < 1.3
    assert late.sealed and not set(late.sealed) & set(adopted(late).evidence["rollouts"])


def adopted(diagnosis: Diagnosis):
    return adopt.adopt(base_model("servo_bench"), "command_latency", diagnosis.to_json())


def test_the_new_version_holds_the_fitted_distribution(late):
    child = adopted(late)
    assert child.effects == ("command_latency",) and child.parent == "servo_bench-v0"
    assert child.mean()[-1] == pytest.approx(0.06, abs=0.01)
    assert 0 < np.std(child.particles[:, -1]) < 0.01


def test_history_never_compares_on_rollouts_that_a_fit_has_seen(late):
    truth = base_model("servo_bench").with_effect("command_latency")
    lines = history([base_model("servo_bench"), adopted(late)], record(truth, np.r_[BASE, 0.06]))
    assert set(lines[0].rollouts) == set(late.sealed)
    assert lines[1].error_over_floor < 1.3 < lines[0].error_over_floor


def test_what_was_measured_last_is_kept_for_the_dashboard(tmp_path):
    lines = [VersionError("bench-v0", None, (), 7.0, ("a", "b"), True), VersionError("bench-v1", "bench-v0", (), None)]
    kept = json.loads(remember(lines, tmp_path, "bench", ["seen"]).read_text())
    assert (kept["rig"], kept["given"], kept["not_counted"]) == ("bench", 3, ["seen"])
    assert [(v["model"], v["error_over_floor"]) for v in kept["lines"]] == [("bench-v0", 7.0), ("bench-v1", None)]


def test_a_diagnosis_of_another_model_is_refused(late):
    with pytest.raises(InferError, match="is of model"):
        adopt.adopt(base_model("hexapod"), "command_latency", late.to_json())


def test_a_law_that_the_library_lacks_is_outside_it_and_the_verdict_names_the_variable():
    """Teeth that pull and push as the joint turns: dry friction is the nearest of the candidates."""
    model = base_model("servo_bench")
    toothed = [with_teeth(m) for m in record(model, BASE)]
    diagnosis = diagnose(model, toothed, uses=CANDIDATES, settings=Settings(refine=1, further=1, escape=False))
    assert diagnosis.verdict == "outside_library"
    assert diagnosis.leftover.variables[0].name == POSITION and diagnosis.leftover.variables[0].sure
    assert f"{POSITION} alone" in diagnosis.statement
    assert diagnosis.to_json()["leftover"]["share"] > 0.5
    report = Report("What does the model lack?")
    add_diagnosis(report, diagnosis)
    assert "What does the rest of the error go with?" in report.html()


def with_teeth(recording: Measurement) -> Measurement:
    """One recording, its joint 0.02 rad off at most, six times a turn of 60 degrees."""
    position = recording.joint_position
    return dataclasses.replace(recording, joint_position=position + 0.02 * np.sin(36.0 * position))


def test_nothing_is_missing_where_nothing_is_hidden():
    diagnosis = diagnose(base_model("servo_bench"), record(base_model("servo_bench"), BASE), uses=CANDIDATES)
    assert (diagnosis.verdict, diagnosis.effects) == ("nothing_missing", ())
    assert diagnosis.errors["base"] < 1.6  # 1.5 at the truth: steps of 2 ms against the recording's 1 ms


def test_one_kind_of_motion_tells_nothing():
    truth = base_model("servo_bench").with_effect("command_latency")
    sines = record(truth, np.r_[BASE, 0.06])[:2]
    diagnosis = diagnose(base_model("servo_bench"), sines, uses=CANDIDATES)
    assert (diagnosis.verdict, diagnosis.effects) == ("cannot_tell", ())
    assert "one kind of motion" in diagnosis.statement and "held out in turn" not in " ".join(diagnosis.claims)
    assert "no candidate was tried" in diagnosis.statement and diagnosis.nothing_held_out
    told = diagnosis.to_json()
    assert told["ranking"] == [] and told["threshold"] is None and told["kinds"] == 1
    report = Report("What does the model lack?")
    add_diagnosis(report, diagnosis)
    assert "Nothing was held out" in report.html() and "Every effect of the library was tried" not in report.html()


def test_a_parameter_of_the_model_that_changes_nothing_is_told():
    rollouts = record(base_model("servo_bench"), BASE)
    model = base_model("servo_bench").with_effect("torque_saturation").with_effect("thermal_fading")
    found = diagnose(model, rollouts, uses=["rotor_inertia"], settings=QUICK)
    idle = [told for told in found.guards if "changes nothing" in told]
    assert idle == ["The model's parameter thermal_fading.time_constant changes nothing in these rollouts."]


def test_one_kind_of_motion_is_enough_to_fit_the_one_effect_that_is_asked_for():
    truth = base_model("servo_bench").with_effect("command_latency")
    found = adopt.fit_effect(base_model("servo_bench"), "command_latency", record(truth, np.r_[BASE, 0.06])[:2])
    assert (found.verdict, found.effects) == ("cannot_tell", ()) and found.nothing_held_out
    report = Report("one motion")
    add_diagnosis(report, found)
    assert found.ranking[0].reason == "of one kind of motion none can be held out"
    assert " inf " not in report.html().replace(".", " ")
    child = adopted(found)
    assert child.mean()[-1] == pytest.approx(0.06, abs=0.02)
    (kept,) = history([dataclasses.replace(child, version="servo_bench-v1")])
    assert kept.error_over_floor is None, "an error on the motion of the fit is none on unseen ones"
    assert np.isfinite(child.evidence["error_over_floor"])


def test_twins_that_only_body_sensors_could_tell_apart_are_not_told_apart():
    truth = base_model("servo_bench").with_effect("command_latency")
    diagnosis = diagnose(
        base_model("servo_bench"), record(truth, np.r_[BASE, 0.06]), uses=["command_latency", "sensor_latency"]
    )
    assert diagnosis.verdict == "cannot_tell"
    assert set(diagnosis.effects) == {"command_latency", "sensor_latency"}


def test_at_the_truth_the_error_is_the_noise_floor():
    model = base_model("servo_bench")
    comparison = compare(model, record(model, BASE), parameters=BASE)
    assert comparison.floor.from_replicates
    assert comparison.error_over_floor == pytest.approx(1.0, abs=0.25)
    assert comparison.signals[0].noise_floor == pytest.approx(np.degrees(NOISE), rel=0.1)
    assert comparison.signals[0].coverage90 == pytest.approx(0.9, abs=0.07)
    assert not comparison.guards


def test_without_rollouts_there_is_nothing_to_compare():
    with pytest.raises(NothingToCompareError):
        compare(base_model("servo_bench"), [])


def test_rollouts_of_another_robot_are_refused():
    with pytest.raises(WrongRigError, match="servo_bench"):
        compare(base_model("hexapod"), record(base_model("servo_bench"), BASE, repeats=1))


@pytest.mark.parametrize("place", [0.5, 0.9, 0.03, 0.0])
@pytest.mark.parametrize("sd", [0.001, 0.05, 0.2, 0.8])
def test_the_particles_have_the_fits_mean_and_its_intervals_far_end_also_beside_a_bound(place, sd):
    model = base_model("servo_bench")
    correlation = np.array([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 1.0]])
    values = model.from_unit(np.array([0.5, 0.5, place]))
    unit = model.to_unit(adopt.draw(model, values, sd**2 * correlation, 0))
    least = 0.3 * min(sd, 12**-0.5)  # from a bound, without which there is no spread
    assert unit.mean(axis=0) == pytest.approx(np.maximum([0.5, 0.5, place], least), abs=0.01 * min(sd, 0.3))
    assert np.all((unit >= 0.0) & (unit <= 1.0)) and np.corrcoef(unit.T)[0, 1] == pytest.approx(0.8, abs=0.1)
    assert unit.std(axis=0)[0] == pytest.approx(min(sd, np.sqrt(1 / 12)), rel=0.02)
    if sd <= 0.2:
        far, end = (0.05, -1) if place > 0.5 else (0.95, 1)
        expected = np.clip(place + end * 1.645 * sd, 0.0, 1.0)
        assert abs(np.quantile(unit[:, 2], far) - expected) < 0.3 * sd


def test_an_effect_that_the_model_has_is_not_shown_again(late, monkeypatch):
    """As in the second round of `diagnose --add --show EFFECT`."""
    truth = base_model("servo_bench").with_effect("command_latency")
    rollouts = record(truth, np.r_[BASE, 0.06])[:4]
    found = diagnose(adopted(late), rollouts, uses=["rotor_inertia"], settings=QUICK, show=["command_latency"])
    assert not [m for m in found.next_motions if "command_latency" in m.between]


def test_no_effect_is_tried_on_a_mirrored_joint_unless_it_is_insisted_on():
    base = base_model("servo_bench")
    mirrored = [dataclasses.replace(m, joint_position=-m.joint_position) for m in record(base, BASE)]
    found = diagnose(base, mirrored, uses=["command_latency"])
    assert (found.verdict, found.uses, found.ranking) == ("cannot_tell", (), ())
    assert "its sign may be mirrored" in found.statement and "no effect was tried" in found.statement
    assert found.next_motions == () and found.headline == "The recordings look wrong: no effect was tried"
    insisted = diagnose(base, mirrored, uses=["command_latency"], settings=Settings(trust_recording=True))
    assert insisted.verdict == "outside_library" and "no effect was tried" not in insisted.statement
