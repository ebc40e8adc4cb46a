"""What to record next: the page's recording does what the command says."""

import csv
import io

import pytest

from tcbi_dashboard import next_motions
from tcbi_infer.diagnose import excitation
from tcbi_infer.diagnose.evidence import NextMotion
from tcbi_infer.diagnose.motions import gait_motion


def advised(name: str, nats: float | None, command: str = "") -> dict:
    """A motion as a diagnosis keeps it in JSON."""
    return {"motion": name, "description": "in words", "between": ["backlash", ""], "nats": nats, "duration_s": 4.0,
            "command": command, "table": [] if command else [[0.0, 0.1], [0.1, 0.2]]}  # fmt: skip


def test_what_a_diagnosis_advises_survives_its_file_and_the_best_comes_first():
    found = next_motions.motions({"next_motions": [advised("sweep", 90.0), advised("hold", 20.0), advised("x", None)]})
    assert [m.motion for m in found] == ["sweep", "hold"]
    assert [m.motion for m in excitation.best(found)] == ["sweep"]
    assert "record sweep" in excitation.advice(found)[0]


def test_a_diagnosis_without_advice_has_none():
    assert next_motions.motions({}) == []


@pytest.mark.parametrize("gait", ["twist", "steps:7"])
def test_the_page_records_what_the_command_would(gait):
    command = gait_motion(gait, 0.12, -0.05, 4.0, seed=3).command
    wish = next_motions.collection(NextMotion(f"gait:{gait}", "", ("backlash", ""), 90.0, 4.0, command))
    assert wish == {
        "task": "balance", "policy": f"gait:{gait}", "number": 1, "times": 2, "seed": 3, "duration_s": 4.0,
        "slope_roll": 0.12, "slope_pitch": -0.05,
    }  # fmt: skip


def test_commands_for_another_rig_are_a_table():
    (motion,) = next_motions.motions({"next_motions": [advised("sweep", 90.0)]})
    rows = list(csv.reader(io.StringIO(next_motions.as_csv(motion).decode())))
    assert rows == [["time_s", "target_0"], ["0.0", "0.1"], ["0.1", "0.2"]]
