"""What a comparison's report shows: the robot, maps, the plot of each finding, the worst moments."""

import dataclasses
import re

import numpy as np
import pytest
from legged_cases import walk
from pendulum_cases import MODEL as SWING
from pendulum_cases import swing

from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.guards import unchecked
from tcbi_infer.compare.ladder import ladder
from tcbi_infer.compare.maps import heat
from tcbi_infer.report import Report, add_comparison
from tcbi_infer.report.drawing import Scale, robot
from tcbi_infer.report.maps import heat_map
from tcbi_infer.report.plots import ladder as ladder_plot
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

MODEL = base_model("hexapod")


@pytest.fixture(scope="module")
def late_femur():
    """Rollouts in which one femur sits 3 deg off and lags."""
    rollouts = []
    for m in walk():
        joints = m.joint_position.copy()
        joints[5:, 4] = joints[:-5, 4] + np.radians(3.0)
        rollouts.append(dataclasses.replace(m, joint_position=joints))
    return rollouts


@pytest.fixture(scope="module")
def comparison(late_femur):
    return compare(MODEL, late_femur, particles=0)


@pytest.fixture(scope="module")
def page(comparison, late_femur):
    report = Report("x")
    add_comparison(report, comparison, rungs=ladder(comparison, [MODEL], late_femur))
    return report.html()


def fills(svg):
    return re.findall(r"fill: (#[0-9a-f]{6})", svg)


def test_the_worst_joint_leads_the_sentences_and_has_its_plot(comparison, page):
    first = comparison.where[0]
    assert first.channels == ("lm_femur",) and first.statement in page.replace("&#39;", "'")
    assert "1. lm_femur in motion" in page


def test_the_worst_moments_the_maps_and_the_ladder_are_on_the_page(page):
    for words in ("The ten worst moments", "What the error grows with", "the robot against itself", "from above"):
        assert words in page
    assert page.count("<figure") >= 7
    assert (
        page.index("Error over noise floor, joints and attitude.")
        < page.index("Where the error lives")
        < page.index("Every signal")
    )


def test_guards_come_before_any_figure(comparison):
    report = Report("x")
    add_comparison(report, dataclasses.replace(comparison, guards=("Something is wrong.",)))
    assert report.html().index("Something is wrong.") < report.html().index("times the noise floor")


def text(comparison) -> list[str]:
    """The paragraphs before any figure."""
    report = Report("x")
    add_comparison(report, comparison)
    (section,) = (s for s in report.sections if s.title == "Prediction against measurement")
    return section.text[1:]


def test_a_version_that_was_added_though_its_motions_disagree_says_so():
    told = "the motions disagree on weak_leg:lm.scale, 0.5 to 0.9"
    doubtful = dataclasses.replace(SWING, evidence={"disagreements": [told]})
    assert f"In the fit behind {SWING.version}: {told}" in compare(doubtful, swing(), particles=0).guards


@pytest.mark.parametrize(("guards", "sound"), [((), True), (("Something is wrong.",), False)])
def test_what_could_not_be_checked_of_a_recording_is_said(comparison, guards, sound):
    some, none = comparison.rollouts[:1], comparison.rollouts
    words = "of the recording were checked: nothing was found."
    every = [f"Clocks, rates, wiring and units {words}"] * sound
    assert text(dataclasses.replace(comparison, guards=guards)) == every
    told = text(dataclasses.replace(comparison, guards=guards, unchecked=some))
    assert told[:-1] == every
    assert told[-1].startswith("Clocks, wiring and units in 1 of 4 rollouts (motion0_0) could not be checked: ")
    told = text(dataclasses.replace(comparison, guards=guards, unchecked=none))
    assert told[:-1] == [f"Stamps and rates {words}"] * sound
    assert told[-1].startswith("Clocks, wiring and units could not be checked: the commands are torques, ")


def test_no_clock_or_wiring_is_checked_of_torques_and_of_joints_that_stand_still(late_femur):
    swings, m = swing(kinds=1), late_femur[0]
    still = dataclasses.replace(m, rollout_id="still", joint_position=np.zeros_like(m.joint_position))
    assert unchecked([m, *swings, still]) == (*(s.rollout_id for s in swings), "still")
    compared = compare(SWING, swings, particles=0)
    assert compared.unchecked == ("swing0_0", "swing0_1")
    assert any("A lag that all signals share cannot be told" in line for line in compared.not_checked), "it has no body"


def test_where_every_prediction_diverged_no_place_is_told(comparison):
    lost = dataclasses.replace(comparison, predicted=np.full_like(comparison.predicted, np.nan), where=())
    for found, words in ((lost, "Not told: the prediction diverged in every rollout."),
                         (dataclasses.replace(comparison, where=()), "Nowhere more than elsewhere.")):  # fmt: skip
        report = Report("x")
        add_comparison(report, found)
        (section,) = (s for s in report.sections if s.title == "Where the error lives")
        assert list(section.notes) == [words]


def test_a_part_is_drawn_in_the_colour_of_its_joint():
    rig = load_rig("hexapod")
    errors = dict.fromkeys(rig.joint_names, 1.0)
    even = fills(robot(rig, errors, 1.0))
    one = fills(robot(rig, errors | {"lf_femur": 40.0}, 1.0))
    assert len(set(one)) == len(set(even)) + 1
    assert len(one) == len(even) > 3 * 18


@pytest.mark.parametrize("name", ["servo_bench", "motor_bench"])
def test_a_rig_without_legs_is_drawn_too(name):
    rig = load_rig(name)
    assert "front" in robot(rig, {rig.joint_names[0]: 3.0})


def test_the_heat_map_shows_the_figure_of_every_cell(comparison):
    found = heat(comparison)
    svg = heat_map(found, Scale.of(found.values.ravel()))
    worst = float(np.nanmax(found.values))
    assert f">{worst:.0f}<" in svg or f">{worst:.1f}<" in svg
    assert found.joints[int(np.nanargmax(np.nanmax(found.values, axis=0)))] == "lm_femur"


def test_the_ladder_ends_with_what_is_left():
    svg = ladder_plot([("v0", 5.0), ("v1", float(np.sqrt(10.0)))], True)
    assert "left unexplained" in svg and ">3<" in svg
    assert "noise floor, estimated" in ladder_plot([("v0", 5.0)], False)
    assert "diverged" in ladder_plot([("v0", float("nan"))], None)
