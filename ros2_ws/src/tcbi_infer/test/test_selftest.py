"""Known effects, planted in a model by another solver: the robots, what is found in them, and how a run goes on."""

import dataclasses

import mujoco
import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.compare.replicates import find_replicates
from tcbi_infer.diagnose.evidence import Diagnosis
from tcbi_infer.diagnose.motions import standard_motions
from tcbi_infer.diagnose.settings import QUICK
from tcbi_infer.errors import InferError
from tcbi_infer.selftest import Bench, Limits, Robot, robots, summarise, trials
from tcbi_infer.selftest.robot import other_solver
from tcbi_infer.selftest.trial import FALSE_ALARM, MISSED, RIGHT, UNSURE, WRONG, kept, motions_of, outcome, remember
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

MODEL = base_model("servo_bench")
HEAVY = Robot("rotor_inertia", "strong", 0)
SOUND = Robot("", "none", 0)


@pytest.fixture(scope="module")
def bench() -> Bench:
    """Five short motions of the servo bench, two candidates."""
    motions = tuple(m for m in standard_motions(load_rig("servo_bench"), 2.0) if m.name != "hold")
    return Bench(MODEL, motions, QUICK, ("rotor_inertia", "backlash"))


@pytest.fixture(scope="module")
def finished(bench, tmp_path_factory):
    """Both robots' results, and the file in which they are kept."""
    file = tmp_path_factory.mktemp("selftest") / "kept.jsonl"
    return list(trials(bench, [SOUND, HEAVY], file)), file


def test_a_planted_effect_is_found_and_nothing_is_found_where_nothing_is_planted(finished):
    sound, heavy = finished[0]
    assert (sound["outcome"], sound["verdict"]) == (RIGHT, "nothing_missing")
    assert heavy["outcome"] == RIGHT and heavy["uses"] == ["rotor_inertia"]
    assert heavy["error_after"] < heavy["error_before"]
    (truth,) = heavy["planted"].values()
    assert heavy["detectable"]["rotor_inertia.inertia"] < truth


def test_a_run_goes_on_where_it_was_stopped(bench, finished, monkeypatch):
    results, file = finished
    monkeypatch.setattr("tcbi_infer.selftest.trial.trial", lambda *a: pytest.fail("it was run before"))
    assert list(trials(bench, [SOUND, HEAVY], file)) == results


def test_results_of_other_motions_or_settings_are_not_taken(bench, finished):
    other = dataclasses.replace(bench, motions=bench.motions[1:])
    assert len(kept(finished[1], bench.fingerprint)) == 2 and not kept(finished[1], other.fingerprint)


def test_whatever_else_a_result_depends_on_makes_another_fingerprint(bench, monkeypatch, tmp_path):
    def played(**changes):
        first = bench.motions[0]
        commands = dataclasses.replace(first.commands, **changes)
        return dataclasses.replace(bench, motions=(dataclasses.replace(first, commands=commands), *bench.motions[1:]))

    weights = MODEL.log_weights + np.log(np.linspace(0.5, 1.5, len(MODEL.log_weights)))
    benches = [
        bench,
        played(ramp=0.0),
        played(torque_on=np.zeros(len(bench.motions[0].commands.time), bool)),
        dataclasses.replace(bench, model=dataclasses.replace(MODEL, log_weights=weights)),
        dataclasses.replace(bench, model=dataclasses.replace(MODEL, joint_gains=(1.1,))),
    ]
    monkeypatch.setenv("TCBI_EFFECTS", str(tmp_path))
    seen = {b.fingerprint for b in benches}
    (tmp_path / "own.py").write_text("# another effect of the user's own")
    assert len({*seen, bench.fingerprint}) == len(benches) + 1


def test_a_line_that_was_cut_off_is_run_again_and_another_file_is_refused(finished, bench, tmp_path):
    results, file = finished
    lines, cut = file.read_text().splitlines(), tmp_path / "cut.jsonl"
    cut.write_text(f"{lines[0]}\n{lines[1][:40]}")
    assert list(kept(cut, bench.fingerprint)) == [SOUND]
    remember(cut, bench.fingerprint, results[1])
    assert kept(cut, bench.fingerprint) == {SOUND: results[0], HEAVY: results[1]}
    cut.write_text("time,angle\n0,1\n")
    with pytest.raises(InferError, match=r"line 1, is no result"):
        kept(cut, bench.fingerprint)


def test_a_robot_is_the_same_whenever_it_is_recorded_and_never_repeats_itself(bench):
    first, again = (HEAVY.record(MODEL, bench.motions[:1]) for _ in range(2))
    assert np.array_equal(first[0].joint_position, again[0].joint_position)
    difference = np.std(first[0].joint_position - first[1].joint_position)
    assert difference == pytest.approx(np.sqrt(2) * 0.0005, rel=0.5)  # the rig's noise, and the encoder's steps


def test_a_weak_effect_is_smaller_than_a_strong_one_and_another_seed_is_another_robot():
    strong, weak = (Robot("rotor_inertia", s, 0).planted(MODEL)["rotor_inertia.inertia"] for s in ("strong", "weak"))
    assert 0 < weak < strong
    assert not np.array_equal(HEAVY.truth(MODEL)[1], Robot("rotor_inertia", "strong", 1).truth(MODEL)[1])


def test_every_joint_of_a_walking_robot_has_a_gain_of_its_own():
    truth, values = SOUND.truth(base_model("hexapod"))
    scatter = values[[name.startswith("gain_scatter:") for name in truth.names]]
    assert len(scatter) == 18 and 0.005 < np.std(scatter) < 0.06


@pytest.mark.parametrize("rig", ["hexapod", "servo_bench"])
def test_the_planting_solver_is_not_the_models(rig):
    own, other = load_rig(rig).build(0).option, other_solver(load_rig(rig))
    assert other["integrator"] == mujoco.mjtIntegrator.mjINT_EULER != own.integrator
    assert rig == "servo_bench" or other["impratio"] < own.impratio


def test_of_an_effect_with_many_places_each_robot_has_one():
    planned = robots(("weak_leg:lf", "weak_leg:rm", "backlash"), ("strong", "weak"), 2)
    assert [r.use for r in planned].count("") == 2
    assert len([r for r in planned if r.effect == "weak_leg"]) == 4 == len([r for r in planned if r.use == "backlash"])
    assert len(set(planned)) == len(planned)


def test_recorded_commands_are_played_once_for_all_their_repeats():
    rollouts = record(MODEL, BASE)
    motions = motions_of(rollouts)
    assert len(motions) == len(rollouts) // 2 == len({m.name for m in motions})
    assert np.array_equal(motions[0].commands.target, rollouts[0].commands.target)


def test_recorded_motions_are_split_into_the_kinds_that_a_diagnosis_of_the_recording_has():
    pieces = [dataclasses.replace(m, policy_id=f"log-{i // 6}") for i, m in enumerate(record(MODEL, BASE))]
    played = SOUND.record(MODEL, motions_of(pieces))
    assert [r.kind for r in find_replicates(played)] == [r.kind for r in find_replicates(pieces)]
    assert len({m.rollout_id for m in played}) == len(played) and {m.policy_id for m in played} == {
        m.policy_id for m in pieces
    }


def test_noise_does_not_follow_from_a_robots_own_values(bench, monkeypatch):
    drawn = []
    monkeypatch.setattr("tcbi_infer.selftest.robot.add_noise", lambda m, _, rng: drawn.append(rng.random()) or m)
    HEAVY.record(MODEL, bench.motions[:1])
    assert drawn[0] != np.random.default_rng(HEAVY._seed).random()


@pytest.mark.parametrize(
    ("planted", "verdict", "uses", "word"),
    [
        ("backlash", "effect", ("backlash",), RIGHT),
        ("backlash", "effect", ("payload",), WRONG),
        ("backlash", "cannot_tell", ("payload", "backlash"), UNSURE),
        ("weak_leg:lf", "effect", ("weak_leg:rm",), WRONG),
        ("backlash", "nothing_missing", (), MISSED),
        ("backlash", "outside_library", (), MISSED),
        ("", "nothing_missing", (), RIGHT),
        ("", "effect", ("backlash",), FALSE_ALARM),
        ("", "outside_library", (), FALSE_ALARM),
        ("", "cannot_tell", (), RIGHT),
        ("", "cannot_tell", ("backlash",), FALSE_ALARM),
    ],
)
def test_outcomes(planted, verdict, uses, word):
    blank = {f.name: None for f in dataclasses.fields(Diagnosis) if f.default is dataclasses.MISSING}
    found = Diagnosis(**{**blank, "verdict": verdict, "uses": uses})
    assert outcome(Robot(planted, "strong", 0), found) == word


def result(use: str, word: str, strength: str = "strong") -> dict:
    return {
        "use": use,
        "effect": use.partition(":")[0],
        "strength": strength,
        "outcome": word,
        "uses": [],
        "verdict": "v",
    }


def test_a_missed_strong_effect_or_a_false_alarm_does_not_pass_and_a_missed_weak_one_does():
    good = [result("", RIGHT, "none"), result("backlash", RIGHT), result("payload", UNSURE)]
    assert summarise([*good, result("payload", MISSED, "weak")], Limits()).passed
    assert not summarise([*good, result("weak_leg:lf", MISSED)], Limits()).passed
    assert not summarise([*good, result("", FALSE_ALARM, "none")], Limits()).passed


def test_where_only_weak_effects_were_planted_these_count():
    found = [result("", RIGHT, "none"), result("payload", MISSED, "weak")]
    assert summarise(found, Limits()).faults == ("1 weak effects were not found, allowed are 0: payload (missed)",)
    assert summarise(found, Limits(missed=1)).passed


def test_limits_are_the_users():
    found = [result("", FALSE_ALARM, "none"), result("backlash", WRONG), result("payload", UNSURE)]
    assert summarise(found, Limits(missed=1, false_alarms=1)).passed
    strict = summarise(found, Limits(missed=1, false_alarms=0, unsure=False))
    assert len(strict.faults) == 2 and "payload (unsure)" in strict.faults[0]


def test_few_robots_without_an_effect_claim_little():
    claim = summarise([result("", RIGHT, "none")] * 10, Limits()).claim
    assert "0 false alarms in 10 robots" in claim and "26 %" in claim  # 1 - 0.05 ** (1 / 10)
    assert "nothing is said" in summarise([result("backlash", RIGHT)], Limits()).claim
