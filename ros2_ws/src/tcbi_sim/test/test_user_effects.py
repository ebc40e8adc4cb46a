"""A user's own effect is found, checked in plain lines, and never breaks the rest of the library."""

import logging
import re
from pathlib import Path

import numpy as np
import pytest

from tcbi_sim.effect_check import check_file, check_file_apart
from tcbi_sim.effects import built_in, candidates, file_of, find_use, left_out, library
from tcbi_sim.errors import EffectError, SimError
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig
from tcbi_sim.simulator import Simulator
from tcbi_sim.user_file import UserFileError, apart

GOOD = '''"""Cables that pull a joint back."""

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
'''
LINE = next(line for line in GOOD.splitlines() if line.startswith("    fields"))
BENCH = ("servo_bench",)
FAULTS = {  # what a user may get wrong: (the text of a good file, its replacement, words that the fault must have)
    "no such module": ("from tcbi_sim.effect ", "import nosuch\nfrom tcbi_sim.effect ", "line 3: ModuleNotFoundError"),
    "syntax": ("def apply(", "def apply(:", "line 7: "),
    "no EFFECT": ("EFFECT =", "EFECT =", "EFFECT must be an Effect.*seen nothing"),
    "no source": ('    source="measured with a spring balance",\n', "", "line 11: Effect lacks 'source'"),
    "empty source": ('"measured with a spring balance"', '""', "source is empty"),
    "short physics": (" back to where they were laid, the more it turns.", ".", "physics has .* words"),
    "no unit": ('"N m/rad"', '""', "'stiffness' has no unit"),
    "no null": ("null=0.0, ", "", "no parameter has a null value"),
    "null outside": ("null=0.0", "null=2.0", "null 2.0 lies outside 0.0 to 1.0"),
    "no comma": (",),\n    apply", "),\n    apply", "tuple of Parameter"),
    "bad name": ("cable_spring", "Cable spring", "small letters"),
    "name taken": ("cable_spring", "backlash", "'backlash' is taken by a built-in effect"),
    "no such field": ("jnt_stiffness", "jnt_stifness", r"apply\(\), line 8: .*did you mean 'jnt_stiffness'"),
    "not in place": (LINE, '    fields.model["jnt_stiffness"] = values["stiffness"]', "line 8: TypeError"),
    "field that does nothing": (
        LINE,
        '    fields.command.delay = values["stiffness"]',
        "command.delay, which does nothing",
    ),
    "wrong shape": (LINE, '    fields.command.latency = values["stiffness"]', "command.latency with shape"),
    "shared model": (LINE, "    fields.mj.dof_damping[:] = 1", "fields.mj, which all simulations share"),
    "values changed": (LINE, '    values["stiffness"] *= 0.5', "changes the values that it is given"),
    "NaN": (LINE, '    fields.model["jnt_stiffness"][:] = float("nan")', "NaN or infinity into fields.model"),
    "nothing happens": (LINE, "    pass", "changes nothing at its nominal value"),
    "wrong null": ("null=0.0", "null=0.5", r"at its null value \(stiffness = 0.5\).*null must be where the effect"),
    "includes nothing": ("    apply=apply,", '    apply=apply,\n    includes=("nope",),', "includes 'nope', allowed"),
    "acts at null": ('+= values["stiffness"][:, None]', "+= 1.0", "changes something at its null value"),
    "overwrites": (
        '+= values["stiffness"][:, None]',
        '= values["stiffness"][:, None]',
        r"\(stiffness = 0\): fields.model",
    ),
    "random": (
        'values["stiffness"][:, None]',
        'values["stiffness"][:, None] * __import__("numpy").random.rand()',
        "something else each time",
    ),
    "idle parameter": (
        '"of each joint\'s cables"),)',
        '"of each joint\'s cables"), Parameter("idle", "1", 0.0, 1.0, 0.5, description="nothing at all"))',
        "'idle' changes nothing from 0 to 1",
    ),
    "endless range": ("0.0, 1.0, 0.2", "0.0, float('inf'), 0.2", "allowed are finite ones"),
    "reaches over": (
        'values["stiffness"][:, None]',
        'values["stiffness"].mean()',
        "reaches over from one simulation to another",
    ),
    "diverges": (
        LINE,
        '    fields.model["dof_damping"][:] -= 100 * values["stiffness"][:, None]',
        "simulation diverges at",
    ),
    "no such site": (
        "    apply=apply,",
        '    apply=apply,\n    sites=lambda rig: ("left_wheel",),',
        "'left_wheel' does not exist",
    ),
    "no sites": ("    apply=apply,", "    apply=apply,\n    sites=lambda rig: (),", "sites gives"),
    "requires fails": (
        "    apply=apply,",
        "    apply=apply,\n    requires=lambda rig: rig.wheels,",
        "line 17: AttributeError",
    ),
    "fits no rig": (
        "    apply=apply,",
        '    apply=apply,\n    requires=lambda rig: "it has no wheels",',
        "no rig can have it",
    ),
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty folder of own effects; the library is read anew in the test and after it."""
    own = tmp_path / "own"
    own.mkdir()
    monkeypatch.setenv("TCBI_EFFECTS", str(own))
    library.cache_clear()
    yield own
    monkeypatch.undo()
    library.cache_clear()
    library()


def write(folder: Path, text: str, name: str = "mine.py") -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_a_good_file_has_no_fault(tmp_path):
    check = check_file(write(tmp_path, GOOD), BENCH)
    assert check.faults == () and check.trials[0].change["joint_position"] > 1e-3
    assert "cable_spring" not in library(), "a check leaves the library as it was"


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_told_in_a_plain_line(tmp_path, fault):
    old, new, words = FAULTS[fault]
    assert GOOD.count(old) >= 1
    faults = check_file(write(tmp_path, GOOD.replace(old, new)), BENCH).faults
    assert any(re.search(words, line) for line in faults), faults
    assert all("\n" not in line for line in faults)


def test_several_faults_are_told_at_once(tmp_path):
    text = GOOD.replace('"measured with a spring balance"', '""').replace('"N m/rad"', '""')
    assert len(check_file(write(tmp_path, text), BENCH).faults) == 2


def test_a_check_in_a_process_of_its_own_finds_the_same(tmp_path):
    file = write(tmp_path, GOOD)
    assert check_file_apart(file, BENCH) == check_file(file, BENCH)


def test_code_that_ends_its_process_or_never_ends_is_a_fault_like_any(tmp_path):
    ends = write(tmp_path, "import os\nos._exit(3)\n")
    (fault,) = check_file_apart(ends, BENCH).faults
    assert "ends the process" in fault and "status 3" in fault
    endless = write(tmp_path, GOOD.replace(LINE, "    while True:\n        pass"))
    with pytest.raises(UserFileError, match="does not end within 1 s"):
        apart(check_file, endless, BENCH, limit_s=1)


def test_an_effect_in_the_users_folder_is_a_candidate_like_any_other(folder):
    write(folder, GOOD)
    assert "cable_spring" in {u.effect.name for u in candidates(load_rig("servo_bench"))}
    assert file_of("cable_spring") == folder / "mine.py" and left_out() == {}


def test_without_a_variable_the_folder_is_that_of_the_store(folder, tmp_path, monkeypatch):
    monkeypatch.delenv("TCBI_EFFECTS")
    monkeypatch.setenv("TCBI_STORE", str(tmp_path / "store"))
    (tmp_path / "store" / "effects").mkdir(parents=True)
    write(tmp_path / "store" / "effects", GOOD)
    assert "cable_spring" in library()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def f(:", "line 1"),
        ("\0", "cannot be imported: source code"),
        ("import sys; sys.exit(3)", "SystemExit"),
        (GOOD.replace("cable_spring", "backlash"), "taken already"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_and_the_rest_of_the_library_stays(folder, caplog, text, words):
    write(folder, GOOD, "a.py")
    bad = write(folder, text, "b.py")
    with caplog.at_level(logging.WARNING):
        assert set(library()) == {*built_in(), "cable_spring"}
    assert library()["backlash"] is built_in()["backlash"]
    (line,) = [r.getMessage() for r in caplog.records]
    assert str(bad) in line and words in line and "\n" not in line
    with pytest.raises(SimError, match=r"b\.py"):
        find_use("what_b_holds", load_rig("hexapod"))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (LINE, "    raise RuntimeError('worn out')"),
        ("    apply=apply,", "    apply=apply,\n    requires=lambda rig: rig.wheels,"),
    ],
)
def test_an_effect_that_fails_on_a_rig_is_no_candidate_there_and_the_others_are(folder, caplog, old, new):
    write(folder, GOOD.replace(old, new))
    with caplog.at_level(logging.WARNING):
        names = {u.effect.name for u in candidates(load_rig("servo_bench"))}
        candidates(load_rig("servo_bench"))
    assert "cable_spring" not in names and "backlash" in names
    assert len(caplog.records) == 1 and "does not run on servo_bench" in caplog.text


def test_a_model_with_an_effect_that_fails_says_which_and_where(folder):
    write(folder, GOOD.replace(LINE, "    raise RuntimeError('worn out')"))
    model = base_model("servo_bench").with_effect("cable_spring")
    with pytest.raises(EffectError, match=r"'cable_spring': apply\(\) raised RuntimeError in line 8 of .*worn out"):
        Simulator(model, model.mean()[None], [Scenario("bench", 1.0)], threads=1)


def test_what_mujoco_refuses_in_an_edit_is_told_as_the_effects_fault(folder):
    edit = "\n\ndef edit(spec, rig, site):\n    spec.worldbody.add_geom(size=[-1, 0, 0])\n\n\nEFFECT ="
    write(folder, GOOD.replace("\n\nEFFECT =", edit).replace("    apply=apply,", "    apply=apply,\n    edit=edit,"))
    model = base_model("servo_bench").with_effect("cable_spring")
    with pytest.raises(SimError, match=r"edit\(\) of cable_spring"):
        Simulator(model, np.array([model.mean()]), [Scenario("bench", 1.0)], threads=1)
