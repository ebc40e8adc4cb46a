"""The demo's story on an emulated robot, every step of it real and short: what it tells, writes and leaves behind."""

import dataclasses
import json
from types import SimpleNamespace

import pytest

from tcbi_bringup.commands import console
from tcbi_bringup.commands.demo import as_json
from tcbi_bringup.demo import page, story
from tcbi_bringup.demo.plan import QUICK
from tcbi_bringup.demo.robot import Robot, running
from tcbi_bringup.demo.story import Outcome, Story
from tcbi_bringup.emulated_robot.physics import Specimen
from tcbi_infer.diagnose.evidence import CANNOT_TELL, EFFECT, NOTHING_MISSING, OUTSIDE_LIBRARY

SHORT = dataclasses.replace(
    QUICK,
    motions=("steps", "sinus"),
    repeated=1,
    motion_s=1.2,
    deployments=2,
    deployment_s=1.2,
    effects=("backlash", "payload"),
    particles=16,
    generations=1,
    training_s=2.0,
)
STEPS = ["record", "compare", "locate", "diagnose", "add", "run", "infer", "retrain", "measure"]
KEYS = {"hidden", "verdict", "effects", "steps", "models", "return_before", "return_after", "report"}


@pytest.mark.graph
@pytest.mark.slow
def test_the_story_is_told_to_its_end_and_leaves_a_report_and_no_process(tmp_path, capsys):
    robot = Robot(seed=3, hidden="none")
    drawn = []
    with running(robot, tmp_path, tmp_path / "store") as (lab, graph):
        lab.wait(graph.check)
        outcome = Story(robot, SHORT, tmp_path, lab).tell(lambda out: drawn.extend(page.findings(out)))
    assert {(status.state, status.exit_code) for status in graph.status()} == {("ended", 0)}
    truth = Specimen.of(robot.seed, robot.hidden, robot.strength).truth()
    report = page.write(outcome, drawn, truth, tmp_path / "report.html")
    console.emit(as_json(outcome, truth, report))
    told = json.loads(capsys.readouterr().out)
    assert set(told) >= KEYS and told["hidden"] == "none"
    assert [step["name"] for step in told["steps"] if step["name"] in STEPS] == STEPS
    assert [m["model"] for m in told["models"]] == ["hexapod-v0", "hexapod-v1", "hexapod-v2"]
    assert all(m["error_over_floor"] > 0 for m in told["models"])
    assert len(outcome.motions) == 3 and len(outcome.unseen) == 2 and len(outcome.after) == 2
    seen = {m.rollout_id for m in (*outcome.motions, *outcome.before)}
    assert not seen & {m.rollout_id for m in outcome.unseen}
    text = report.read_text()
    assert f"Verdict: {outcome.diagnoses[0].headline}." in text
    assert all(version in text for version in ("hexapod-v0", "hexapod-v1", "hexapod-v2")) and len(text) > 100_000


@pytest.mark.parametrize(
    ("hidden", "verdict", "effects", "right"),
    [
        (("payload",), EFFECT, ["payload"], True),
        (("weak_leg",), EFFECT, ["weak_leg:lf"], True),
        (("payload",), EFFECT, ["backlash"], False),
        (("payload",), CANNOT_TELL, [], False),
        ((), NOTHING_MISSING, [], True),
        ((), OUTSIDE_LIBRARY, [], False),
        ((), CANNOT_TELL, [], False),
    ],
)
def test_right_is_what_is_hidden_and_with_nothing_hidden_only_that_nothing_is_missing(
    hidden, verdict, effects, right, monkeypatch
):
    monkeypatch.setattr(Outcome, "verdict", verdict)
    monkeypatch.setattr(Outcome, "effects", effects)
    assert Outcome(Robot(1), SHORT, None).right(hidden) == right


def test_a_deployment_that_the_diagnosis_spoilt_is_recorded_again_before_the_inference(monkeypatch):
    def spoilt(m, time):
        return SimpleNamespace(sentences=("No samples from 0.6 to 0.8 s",) if m.rollout_id == "spoilt" else ())

    monkeypatch.setattr(story, "unusable", spoilt)
    whole, bad, again = (SimpleNamespace(rollout_id=name, time=()) for name in ("whole", "spoilt", "again"))
    asked, said = [], []
    told = SimpleNamespace(
        out=SimpleNamespace(before=[whole, bad]),
        say=said.append,
        _deployed=lambda policy, name, number: asked.append((name, number)) or again,
    )
    Story._mend_deployments(told)
    assert told.out.before == [whole, again] and asked == [("before", 1)] and "spoilt" in said[0]
