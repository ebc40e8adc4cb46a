"""The errors of the versions come from one source, and every version without a figure is told why."""

import dataclasses

from tcbi_dashboard.error_line import error_line, made_before
from tcbi_sim.model import base_model

V0, V1, V2, V3 = (f"servo_bench-v{n}" for n in range(4))
ERRORS = {"unfitted": 14.0, "base": 3.0}


def version(name, parent, **evidence):
    """A saved version, without its fit's particles."""
    return dataclasses.replace(base_model("servo_bench"), version=name, parent=parent, evidence=evidence)


def diagnosed(name, parent, rollouts, error, **more):
    """A version that a diagnosis made."""
    errors = {**ERRORS, "backlash": error}
    return version(
        name, parent, kind="diagnosis", use="backlash", rollouts=rollouts, sealed=[], errors=errors,
        error_over_floor=error, floor_from_replicates=True, **more,
    )  # fmt: skip


def record(errors, used, given, repeated=False):
    """A measurement as the page keeps it: version -> (parent, error)."""
    lines = [
        {"model": m, "parent": p, "error_over_floor": e, "rollouts": used, "floor_from_replicates": repeated}
        for m, (p, e) in errors.items()
    ]
    return {"given": given, "lines": lines}


BASE = version(V0, None)
FITTED = diagnosed(V1, V0, ["a", "b"], 1.5)
INFERRED = version(V2, V1, inference={"rollouts": ["c"]})
MEASURED = record({V0: (None, 17.0), V1: (V0, 3.1), V2: (V1, 3.2)}, ["u", "v"], 14)


def test_a_version_made_after_the_measurement_has_no_figure_beside_the_measured_ones():
    line = error_line([BASE, FITTED, INFERRED, diagnosed(V3, V0, ["a", "d"], 2.1)], MEASURED)
    assert [p.error for p in line.points] == [17.0, 3.1, 3.2, None]
    assert any(note.startswith(f"{V3}: not measured on these rollouts; ") for note in line.notes)


def test_a_version_whose_fit_has_seen_the_rollouts_is_not_judged_on_them():
    late = diagnosed(V3, V0, ["a", "u"], 2.1)
    line = error_line([BASE, FITTED, INFERRED, late], record({V0: (None, 17.0), V3: (V0, 1.1)}, ["u", "v"], 2))
    assert [p.error for p in line.points] == [17.0, None, None, None]
    assert "that no fit has seen" not in line.source
    assert any(f"{V3}: its fit has seen 1 of these rollouts" in note for note in line.notes)


def test_a_child_of_a_version_that_has_seen_the_rollouts_is_not_judged_on_them_either():
    child = version(V3, V1, kind="remove")
    line = error_line([BASE, FITTED, child], record({V0: (None, 9.0), V3: (V1, 1.0)}, ["b"], 1))
    assert line.points[-1].error is None


def test_rollouts_that_do_not_count_are_told_and_those_used_are_named():
    line = error_line([BASE, FITTED, INFERRED], MEASURED)
    assert line.source.startswith("Measured on 2 rollouts that no fit has seen")
    assert "12 of the 14 chosen were seen by a fit and do not count." in line.notes and line.used == ("u", "v")


def test_an_estimated_floor_is_never_called_the_robot_against_itself():
    models = [BASE, FITTED, INFERRED]
    assert "estimated noise" in error_line(models, MEASURED).source
    repeated = record({V0: (None, 2.0)}, ["u"], 1, repeated=True)
    assert "the robot against itself" in error_line(models, repeated).source


def test_a_version_that_is_worse_than_its_parent_is_named_and_a_better_one_is_not():
    notes = error_line([BASE, FITTED, INFERRED], MEASURED).notes
    assert [n for n in notes if "errs more" in n] == [f"{V2} errs more than its parent {V1} here: 3.2 against 3.1."]


def test_without_a_measurement_the_figures_are_those_of_one_diagnosis_only():
    other = diagnosed(V2, V0, ["e", "f"], 2.1)
    line = error_line([BASE, FITTED, other], None)
    assert [p.error for p in line.points] == [14.0, None, 2.1]
    assert line.source.startswith(f"From the diagnosis that made {V2}, on motions that its fits had not seen")


def test_an_error_on_the_motion_of_the_fit_is_called_so():
    line = error_line([BASE, diagnosed(V1, V0, ["a"], 1.5, nothing_held_out=True)], None)
    assert "on the motion of the fit itself" in line.source


def test_a_measurement_without_an_unseen_rollout_is_none():
    nothing = record({V0: (None, 1.0), V1: (V0, 1.0)}, [], 5)
    assert error_line([BASE, FITTED], nothing) == error_line([BASE, FITTED], None)


def test_versions_of_which_nothing_is_known_have_no_source():
    assert error_line([BASE], None).source == ""


def test_the_same_effect_from_the_same_diagnosis_is_told_from_that_of_another_one():
    diagnosis = {"model": V0, "rollouts": ["a", "b"], "sealed": [], "errors": ERRORS}
    models = [BASE, FITTED, diagnosed(V3, V0, ["e"], 1.5), diagnosed("servo_bench-v4", V1, ["a", "b"], 1.2)]
    assert made_before(models, diagnosis, "backlash") == ([V1], [V3])
    assert made_before(models, diagnosis, "payload") == ([], [])
