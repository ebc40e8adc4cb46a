"""A task of one's own is one file: drawn, rewarded, checked, and trained like the built-in ones."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tcbi_policy.configuration import preset
from tcbi_policy.environment import TIMESTEP_S, HexapodVectorEnv
from tcbi_policy.errors import RewardError
from tcbi_policy.gaits import Gait
from tcbi_policy.reward import episode_reward, formula, has_reward, needs_position, step_rewards
from tcbi_policy.task_check import check_file
from tcbi_sim.engine import simulate
from tcbi_sim.model import base_model
from tcbi_sim.tasks import find_task, tasks

TURN = """
import numpy as np
from tcbi_policy.reward import Term, action_term
from tcbi_sim.measurement import Scenario, roll_pitch_yaw
from tcbi_sim.tasks import Task


def draw(rng, seed=0):
    return Scenario("turn", 6.0, initial_yaw=float(rng.uniform(-3, 3)), seed=seed)


def turned(steps):
    return np.diff(np.unwrap(roll_pitch_yaw(steps.attitude)[..., 2], axis=-1), axis=-1)


TASK = Task("turn", 6.0, "turn to the left on level ground", 0, draw,
            reward=(Term("turn", 5000.0, "rad", "yaw' - yaw", turned), action_term(-600.0)))
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TCBI_TASKS", str(tmp_path))
    (tmp_path / "turn.py").write_text(TURN)
    return tmp_path


def test_a_file_in_the_folder_is_a_task_with_a_reward_like_any_other(folder: Path) -> None:
    assert list(tasks()) == ["balance", "forward", "turn"] and has_reward("turn")
    assert formula("turn") == "r = 5000 /rad * (yaw' - yaw) - 600 /rad^2 * (mean_j (a_j - a_j_before)^2)"
    environment = HexapodVectorEnv(base_model("hexapod"), "turn", 2)
    environment.reset()
    assert environment.steps == 30
    assert np.isfinite(environment.step(np.full((2, 18), 0.3))[1]).all()
    config = preset("fast", "turn")
    assert config.reward_scale == 0.0 and config.steps == round(preset("fast", "balance").steps * 6 / 8)


def test_the_check_finds_nothing_wrong_with_a_good_one(folder: Path) -> None:
    assert check_file(folder / "turn.py") == ("turn", [])


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("TASK =", "OTHER =", "TASK must be a Task"),
        ("import numpy", "import numpyy", "line 2"),
        ('"turn", 6.0, "turn', '"turn", 6.1, "turn', "multiples of the control period"),
        ("initial_yaw=", "slope_roll=1.0, initial_yaw=", "slope"),
        ('Scenario("turn"', 'Scenario("spin"', "task 'spin'"),
        ("rng.uniform(-3, 3)", "np.random.uniform(-3, 3)", "same generator"),
        ('"rad", "yaw', '"", "yaw', "no unit"),
        ('Term("turn", 5000.0', 'Term("distance", 5000.0', "give another name"),
        ('Term("turn", 5000.0', 'Term("action", 5000.0', "term 'action' is there twice"),
        ('Term("turn", 5000.0', 'Term("turn", "5000"', "reward[0].weight is '5000', allowed is a number"),
        ("action_term(-600.0))", '("action", -600.0))', "reward[1] is a tuple"),
        ("return np.diff", "return 1 / 0 * np.diff", "ZeroDivisionError"),
        ("return np.diff(", "steps.attitude[:] = 1.0; return np.diff(", "read-only"),
        ("return np.diff(", "return np.nan * np.diff(", "not finite"),
        ("return np.diff(", "return np.cumsum(steps.action.mean(axis=-1)) + np.diff(", "more than one step"),
        ("return np.diff(", "return np.mean(", "one a step"),
    ],
)
def test_each_fault_is_named(folder: Path, before: str, after: str, says: str) -> None:
    file = folder / "turn.py"
    file.write_text(TURN.replace(before, after))
    _, faults = check_file(file)
    assert any(says in fault for fault in faults), faults


def test_a_broken_file_is_left_out_with_a_line_and_the_others_stay(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "broken.py").write_text("TASK = 1")
    (folder / "second.py").write_text(TURN)
    assert list(tasks()) == ["balance", "forward", "turn"]
    assert "broken.py" in caplog.text and "is taken already, by second.py" in caplog.text
    assert find_task("turn").duration == 6.0


APPROACH = TURN.replace("steps.attitude)[..., 2]", "steps.attitude)[..., 2] + 0.1 * steps.progress")


@pytest.mark.parametrize(("text", "known"), [(TURN, True), (APPROACH, False)])
def test_a_term_that_needs_the_position_leaves_a_rollout_without_a_tracker_without_a_return(
    folder: Path, text: str, known: bool
) -> None:
    (folder / "turn.py").write_text(text)
    assert check_file(folder / "turn.py") == ("turn", [])
    model = base_model("hexapod")
    scenario = find_task("turn").draw(np.random.default_rng(0), 0)
    scenario = dataclasses.replace(scenario, duration=2.0)
    out = simulate(model, model.mean()[None], [scenario], controller=Gait("tripod"), timestep=TIMESTEP_S)
    tracked = out.measurement(0)
    assert np.isfinite(episode_reward(tracked).total)
    reward = episode_reward(dataclasses.replace(tracked, position=None))
    assert len(reward.steps) == 10
    assert np.isfinite(reward.steps).all() == np.isfinite(reward.total) == known
    assert [needs_position(term) for term in find_task("turn").reward] == [not known, False]
    if not known:
        with pytest.raises(RewardError, match="term 'turn' of the reward needs the position"):
            step_rewards("turn", np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), None, np.zeros((1, 18)))
