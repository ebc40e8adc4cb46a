"""The library on the command line, and versions that lose an effect or are set side by side."""

import json
import shutil
from pathlib import Path

import pytest

import tcbi_sim
from tcbi_bringup import cli
from tcbi_sim.effects import built_in, library

OWN = """
from tcbi_sim.effect import Effect
from tcbi_sim.parameter import Parameter


def apply(fields, rig, site, values):
    fields.model["jnt_stiffness"][:, [fields.mj.joint(n).id for n in rig.joint_names]] += values["stiffness"][:, None]


EFFECT = Effect(
    name="cable_spring",
    physics="Cables along a joint bend with it and pull it back to where they were laid, the more it turns.",
    source="measured with a spring balance",
    parameters=(Parameter("stiffness", "N m/rad", 0.0, 1.0, 0.2, null=0.0, description="of each joint's cables"),),
    apply=apply,
)
"""


@pytest.fixture
def store(tmp_path) -> Path:
    """A store with one effect of the user's own and one file that is broken."""
    folder = tmp_path / "store" / "effects"
    folder.mkdir(parents=True)
    (folder / "mine.py").write_text(OWN)
    (folder / "broken.py").write_text("def f(:")
    library.cache_clear()
    yield tmp_path / "store"
    library.cache_clear()


def answer(capsys, *words: object) -> dict:
    """The JSON object that a command prints."""
    capsys.readouterr()
    assert cli.main([str(w) for w in (*words, "--json")]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_list_has_every_effect_that_fits_the_rig_and_names_a_broken_file(store, capsys):
    listed = answer(capsys, "effects", "--store", store)
    assert {e["name"] for e in listed["effects"]} == {*built_in(), "cable_spring"} - set(listed["unsuited"])
    assert not {"cable_spring", "weak_leg"} & set(listed["unsuited"])
    assert [Path(f).name for f in listed["left_out"]] == ["broken.py"]
    bench = answer(capsys, "effects", "--rig", "servo_bench", "--store", store)
    assert "weak_leg" in bench["unsuited"] and "weak_leg" not in {e["name"] for e in bench["effects"]}
    assert cli.main(["effects", "--store", str(store)]) == 0
    assert "cable_spring" in capsys.readouterr().out


def test_an_effect_is_shown_with_physics_source_and_parameters(capsys):
    shown = answer(capsys, "effects", "show", "weak_leg")
    assert shown["sites"] == ["lf", "lm", "lr", "rf", "rm", "rr"] and shown["source"] and len(shown["physics"]) > 50
    (scale,) = shown["parameters"]
    assert {"name", "unit", "low", "high", "prior", "nominal", "null", "description"} == set(scale)
    assert cli.main(["effects", "show", "weak_leg"]) == 0
    assert "Source: " in capsys.readouterr().out
    assert cli.main(["effects", "show", "weak_lge"]) == 2
    assert "did you mean 'weak_leg'" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["show"], ["check"], ["list", "backlash"], ["shw", "backlash"]])
def test_a_half_call_is_wrong_usage(words, capsys):
    assert cli.main(["effects", *words]) == 2
    assert capsys.readouterr().err


def test_a_check_answers_with_lines_and_an_exit_status(tmp_path, capsys):
    good, bad = tmp_path / "good.py", tmp_path / "bad.py"
    good.write_text(OWN)
    bad.write_text(OWN.replace('"measured with a spring balance"', '""').replace('"N m/rad"', '""'))
    assert cli.main(["effects", "check", str(good), "--rig", "servo_bench"]) == 0
    assert "fit for use" in capsys.readouterr().out
    assert cli.main(["effects", "check", str(bad), "--rig", "servo_bench"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "source is empty" in line] and [line for line in lines if "no unit" in line]
    assert cli.main(["effects", "check", str(bad), "--rig", "servo_bench", "--json"]) == 1
    assert len(json.loads(capsys.readouterr().out)["faults"]) == 2


def test_a_check_tries_ones_own_rigs_too_and_passes_over_those_that_are_broken(tmp_path, monkeypatch, capsys):
    rigs = tmp_path / "rigs"
    rigs.mkdir()
    described = Path(tcbi_sim.__file__).parent / "rigs" / "described"
    for known, own in (("double_pendulum.xml",) * 2, ("double_pendulum.toml", "my_bench.toml")):
        shutil.copy(described / known, rigs / own)
    (rigs / "broken.toml").write_text("model = 3")
    monkeypatch.setenv("TCBI_RIGS", str(rigs))
    alone = tmp_path / "alone.py"
    only = "    requires=lambda rig: '' if rig.name == 'my_bench' else 'made for another',\n)\n"
    alone.write_text(OWN.removesuffix(")\n") + only)
    assert cli.main(["effects", "check", str(alone)]) == 0
    assert "on my_bench" in capsys.readouterr().out


def test_ones_own_effect_is_added_removed_and_compared_like_any_other(store, capsys):
    rig = ("--rig", "servo_bench", "--store", store)
    added = answer(capsys, "add", "cable_spring", "--prior", *rig)
    assert added["model"] == "servo_bench-v1"
    removed = answer(capsys, "remove", "cable_spring", *rig)
    assert (removed["model"], removed["parent"], removed["effects"]) == ("servo_bench-v2", "servo_bench-v1", [])
    assert "marginalised" in removed["statement"] and Path(removed["report"]).is_file()
    difference = answer(capsys, "diff", "servo_bench-v1", "latest", *rig)
    assert (difference["after"], difference["effects_removed"]) == ("servo_bench-v2", ["cable_spring"])
    assert all(p["overlap"] in (None, 1.0) for p in difference["parameters"])
    versions = answer(capsys, "history", *rig)["models"]
    assert [v["model"] for v in versions] == ["servo_bench-v0", "servo_bench-v1", "servo_bench-v2"]


def test_removing_what_is_not_there_is_one_line(tmp_path, capsys):
    assert cli.main(["remove", "backlash", "--store", str(tmp_path)]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tcbi:")]
    assert len(errors) == 1 and "backlash" in errors[0]
