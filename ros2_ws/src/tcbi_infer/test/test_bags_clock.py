"""Bags whose clock was set back: a rollout is used up to there, and everything else of the bag as it is."""

from pathlib import Path

import numpy as np
import pytest
from bag_cases import rollout

from tcbi_contract.names import IMU, JOINT_STATES, JOINTS, ROLLOUT_EVENT
from tcbi_infer.bags import encoding, schemas
from tcbi_infer.bags.reader import read_measurement, read_measurements
from tcbi_infer.bags.writer import BagWriter
from tcbi_infer.player import schedule

START = 20_000_000_000
Row = tuple[str, int, bytes]


def written(folder: Path, rows: list[Row]) -> Path:
    with BagWriter(folder, "lab") as bag:
        for topic, time, data in rows:
            bag.write("/" + topic, time, data)
    return bag.path


def rows(rollout_id: str = "walk_1", start: int = START) -> list[Row]:
    """A rollout of 4 s."""
    return list(encoding.messages(rollout(rollout_id, samples=201), start))


def set_back(found: list[Row], at: float, by: float) -> list[Row]:
    """The same from a machine whose clock was set back `by` seconds, `at` seconds after the first one's stamp."""
    shifted = []
    for topic, time, data in found:
        if time >= found[0][1] + round(at * 1e9):
            kind = schemas.MESSAGES[topic]
            message = schemas.typestore().deserialize_cdr(data, kind)
            time -= round(by * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time, 1_000_000_000)
            data = schemas.encode(message, kind)
        shifted.append((topic, time, data))
    return shifted


@pytest.mark.parametrize("at", [1.0, 3.0])
@pytest.mark.parametrize("by", [1.0, 3.0, 10.0])
def test_a_rollout_is_used_up_to_where_the_clock_was_set_back(tmp_path, at, by):
    whole = read_measurement(written(tmp_path / "a", rows()))
    back = read_measurement(written(tmp_path / "b", set_back(rows(), at, by)))
    count = round(at * 50)
    assert np.array_equal(back.time, whole.time[:count])
    assert np.array_equal(back.joint_position, whole.joint_position[:count])
    assert np.array_equal(back.attitude, whole.attitude[:count])
    early = whole.commands.time < at
    assert np.array_equal(back.commands.target, whole.commands.target[early])
    assert np.allclose(back.commands.time, whole.commands.time[early])
    assert back.scenario.initial_joint_position == whole.scenario.initial_joint_position
    assert back.notes == (
        f"time goes back once, by up to {by - 0.02:.3g} s (a clock was set); the rollout is used up to there",
    )


def test_what_was_set_before_the_rollout_does_not_matter(tmp_path):
    idle = [row for row in rows(start=START - 4_000_000_000) if row[0] in (JOINT_STATES, IMU)]
    bag = written(tmp_path, set_back(idle, 0.0, -9.0) + rows())
    whole = read_measurement(written(tmp_path / "a", rows()))
    back = read_measurement(bag)
    assert np.array_equal(back.time, whole.time) and np.array_equal(back.attitude, whole.attitude)
    assert back.notes == ()


def test_the_other_rollouts_of_a_bag_are_whole(tmp_path):
    second = rows("walk_2", START + 6_000_000_000)
    bag = written(tmp_path, rows("walk_1") + set_back(second, 2.0, 5.0) + rows("walk_3", START + 30_000_000_000))
    found = {m.rollout_id: m for m in read_measurements([bag])}
    assert [len(m.time) for m in found.values()] == [201, 100, 201]
    assert [bool(m.notes) for m in found.values()] == [False, True, False]


def test_without_events_the_longest_stretch_is_used(tmp_path):
    plain = [row for row in rows() if row[0] != ROLLOUT_EVENT]
    back = read_measurement(written(tmp_path, set_back(plain, 3.0, 2.0)))
    assert len(back.time) == 150 and back.joint_names == JOINTS
    (note,) = (n for n in back.notes if "clock" in n)
    assert note.startswith("time goes back once, by up to 1.98 s (a clock was set); only the longest stretch is used")
    assert "150 of 201 samples" in note


def test_a_replay_keeps_what_comes_long_after_the_last_sample_where_no_clock_was_set(tmp_path):
    late = [row for row in rows() if row[0] == ROLLOUT_EVENT or row[1] < START + 2_000_000_000]
    cues = schedule(written(tmp_path, late)).cues
    assert [cue.topic for cue in cues].count(ROLLOUT_EVENT) == 2
