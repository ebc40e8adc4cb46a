"""From bags to the next model version on the command line: compare, diagnose, add, history, export-model."""

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tcbi_bringup import cli
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model

LATENCY = 0.06  # s
STEPS = np.arange(20) * 0.2


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> Path:
    """Five kinds of motion of a servo bench with late commands, each twice."""
    folder = tmp_path_factory.mktemp("bags")
    rng = np.random.default_rng(0)
    motions = [0.6 * np.sin(2 * np.pi * f * STEPS) for f in (0.3, 0.5, 0.8)] + [
        np.repeat(rng.uniform(-1, 1, 5), 4),
        np.linspace(0, 1.2, 20),
    ]
    commands = [Commands(STEPS, m[:, None]) for m in motions]
    scenarios = [Scenario("log", 4.0, settle=0.0) for _ in motions]
    model = base_model("servo_bench").with_effect("command_latency")
    out = simulate(model, np.array([[5e-3, 0.02, 0.015, LATENCY]]), scenarios, commands=commands, timestep=0.001)
    for s in range(len(motions)):
        for repeat in range(2):
            clean = out.measurement(0, s)
            noisy = clean.joint_position + rng.normal(0, 0.001, clean.joint_position.shape)
            name = f"motion{s}"
            recording = dataclasses.replace(
                clean, rollout_id=f"{name}_{repeat}", policy_id=name, commands=commands[s], joint_position=noisy
            )
            write_measurement(folder, recording)
    return folder


def answer(capsys, *words: object) -> dict:
    """The JSON object that a command prints; nothing else may stand on standard output."""
    capsys.readouterr()
    assert cli.main([str(w) for w in (*words, "--json")]) == 0
    return json.loads(capsys.readouterr().out)


def test_from_bags_to_the_next_version(bags, tmp_path, capsys):
    store = ("--store", tmp_path)
    before = answer(capsys, "compare", bags, "--model", "servo_bench-v0", *store)
    assert before["error_over_floor"] > 3 and before["floor_from_replicates"] and Path(before["report"]).is_file()
    assert {"model", "rollouts", "signals", "error_over_floor", "where"} <= set(before)

    found = answer(capsys, "diagnose", bags, "--effects", "command_latency,rotor_inertia", *store)
    assert (found["verdict"], found["effects"]) == ("effect", ["command_latency"])
    assert found["added"] is None and not found["then"] and not list(tmp_path.glob("models/servo_bench*"))
    (delay,) = found["ranking"][0]["parameters"]
    assert delay["low90"] <= LATENCY <= delay["high90"]

    (*_, size) = found["agreement"]["command_latency"]
    assert size["name"] == "command_latency.delay" and size["agrees"] and len(size["kinds"]) >= 3
    size["agrees"], size["statement"] = False, "command_latency.delay: the kinds of motion disagree."
    doubted = tmp_path / "doubted.json"
    doubted.write_text(json.dumps(found))
    other = ("--rig", "servo_bench", "--store", tmp_path / "other")
    add_doubted = ("add", "command_latency", "--diagnosis", doubted, *other)
    assert cli.main([str(w) for w in add_doubted]) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert "not offered" in told and "the kinds of motion disagree" in told and "--anyway" in told
    assert answer(capsys, *add_doubted, "--anyway")["disagreements"] == [
        f"{size['statement']} Its interval reaches over all of them."
    ]

    added = answer(capsys, "add", "command_latency", "--rig", "servo_bench", *store)
    assert (added["model"], added["parent"], added["effect"]) == ("servo_bench-v1", "servo_bench-v0", "command_latency")
    assert added["accepted"] and added["error_after"] < 1.5 < added["error_before"]
    assert "command_latency.delay" in Path(added["report"]).read_text()

    versions = answer(capsys, "history", bags, *store)["models"]
    assert [v["model"] for v in versions] == ["servo_bench-v0", "servo_bench-v1"]
    assert versions[1]["error_over_floor"] < 1.5 < versions[0]["error_over_floor"]
    assert versions[1]["effects"] == ["command_latency"]

    file = tmp_path / "bench.xml"
    exported = answer(capsys, "export-model", file, "--rig", "servo_bench", *store)
    assert (exported["model"], exported["left_out"]) == ("servo_bench-v1", ["command_latency"])
    assert mujoco.MjModel.from_xml_path(str(file)).nu == 1


def test_versions_are_listed_shown_and_deleted_the_last_of_a_line_first(tmp_path, capsys):
    store = ("--store", tmp_path)
    rig = ("--rig", "servo_bench")
    assert [answer(capsys, "add", e, "--prior", *rig, *store)["model"] for e in ("backlash", "command_latency")] == [
        "servo_bench-v1",
        "servo_bench-v2",
    ]
    listed = answer(capsys, "model", *rig, *store)["models"]
    assert [(m["model"], m["parent"], m["made_by"], m["newest"]) for m in listed] == [
        ("servo_bench-v0", None, "built in", False),
        ("servo_bench-v1", "servo_bench-v0", "prior", False),
        ("servo_bench-v2", "servo_bench-v1", "prior", True),
    ]
    shown = answer(capsys, "model", "servo_bench-v1", *store)
    assert shown["children"] == ["servo_bench-v2"] and "backlash.gap" in [p["name"] for p in shown["parameters"]]
    assert all(p["low90"] <= p["mean"] <= p["high90"] for p in shown["parameters"])
    assert cli.main(["model", "servo_bench-v1", "--delete", *map(str, store)]) == 1
    assert "is the parent of servo_bench-v2; delete those first" in capsys.readouterr().err
    assert answer(capsys, "model", "servo_bench-v2", "--delete", *store)["newest"] == "servo_bench-v1"
    assert answer(capsys, "add", "backlash", "--prior", *rig, "--model", "servo_bench-v0", *store)["model"] == (
        "servo_bench-v3"
    )
    assert cli.main(["model", "latest", "--delete", *map(str, store)]) == 2


def test_what_is_found_is_added_and_looked_beyond(bags, tmp_path, capsys):
    report = tmp_path / "why.html"
    words = ("diagnose", bags, "--effects", "command_latency,rotor_inertia", "--add", "--report", report)
    found = answer(capsys, *words, "--store", tmp_path)
    assert (found["verdict"], found["effects"], found["added"]) == ("effect", ["command_latency"], "servo_bench-v1")
    (then,) = found["then"]
    assert (then["model"], then["verdict"], then["added"]) == ("servo_bench-v1", "nothing_missing", None)
    assert found["report"] == str(report) and "servo_bench-v1, with command_latency" in Path(then["report"]).read_text()
    lines = answer(capsys, "history", "--rig", "servo_bench", "--store", tmp_path)["models"]
    assert [v["effects"] for v in lines] == [[], ["command_latency"]]


def test_adding_what_no_diagnosis_fitted_is_refused_in_one_line(tmp_path, capsys):
    assert cli.main(["add", "backlash", "--rig", "servo_bench", "--store", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert error.splitlines()[0] == "model servo_bench-v0, the newest; --model names another"
    assert error.count("\n") == 2 and "--prior" in error


def test_an_unknown_effect_is_refused_before_any_fit(bags, tmp_path, capsys):
    assert cli.main(["add", "backlsh", str(bags), "--store", str(tmp_path)]) == 2
    assert "did you mean 'backlash'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("add", "backlash", "BAGS", "--prior"), "bags and --prior: each says where the size comes from"),
        (("add", "backlash", "--diagnosis", __file__, "--prior"), "--diagnosis and --prior: each says"),
        (("add", "backlash", "--prior", "--anyway"), "--anyway and --prior: a prior has no size to disagree on"),
        (("diagnose", "BAGS", "--quick", "--refine", "2"), "not allowed with argument --quick"),
    ],
)
def test_options_of_which_one_would_do_nothing_are_refused_together(bags, words, told, tmp_path, capsys):
    given = [str(bags) if word == "BAGS" else word for word in words]
    assert cli.main([*given, "--store", str(tmp_path)]) == 2
    assert told in capsys.readouterr().err


def test_an_unknown_candidate_is_refused_instead_of_being_left_out(bags, tmp_path, capsys):
    store = ("--store", str(tmp_path))
    assert cli.main(["diagnose", str(bags), "--effects", "backlash,command_latncy", *store]) == 2
    assert "did you mean 'command_latency'" in capsys.readouterr().err


def test_an_effect_that_was_not_fitted_says_so(bags, tmp_path, capsys):
    added = answer(capsys, "add", "backlash", "--prior", "--rig", "servo_bench", "--store", tmp_path)
    assert not added["accepted"] and added["error_after"] is None
    assert "as wide as their prior" in Path(added["report"]).read_text()


def test_a_model_is_not_exported_into_a_folder_that_does_not_exist(tmp_path, capsys):
    assert cli.main(["export-model", str(tmp_path / "new" / "bench.xml"), "--rig", "servo_bench"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"the folder {tmp_path / 'new'} does not exist" in error
    assert not (tmp_path / "new").exists()


def test_a_measured_value_is_fixed_and_fitted_no_more(bags, tmp_path, capsys):
    store = ("--store", tmp_path)
    made = answer(capsys, "model", "servo_bench-v0", "--fix", "gain=0.005", *store)
    assert made["model"] == "servo_bench-v1" and made["fixed"] == {"gain": 0.005} and "gain" not in made["parameters"]
    shown = answer(capsys, "model", "servo_bench-v1", *store)
    assert shown["made_by"] == "fix" and shown["fixed"] == {"gain": 0.005}
    told = answer(capsys, "diff", "servo_bench-v0", "servo_bench-v1", "--rig", "servo_bench", *store)["statement"]
    assert "fixed is gain 0.005" in told and "half as wide" not in told
    found = answer(capsys, "diagnose", bags, "--model", "servo_bench-v1", "--effects", "command_latency", *store)
    names = [p["name"] for p in found["base"]["parameters"]]
    assert names == made["parameters"]
    added = answer(capsys, "add", "command_latency", "--model", "servo_bench-v1", "--anyway", *store)
    assert answer(capsys, "model", added["model"], *store)["fixed"] == {"gain": 0.005}
    freed = answer(capsys, "model", added["model"], "--free", "gain", *store)
    assert freed["fixed"] == {} and "gain" in freed["parameters"]
    assert cli.main(["model", "servo_bench-v0", "--fix", "gain=1", "--delete", *map(str, store)]) == 2
    assert "allowed is one of them" in capsys.readouterr().err
