"""Pieces of a long recording begin at the state that was measured, and together are that recording."""

import dataclasses

import numpy as np
import pytest
from bag_cases import differences

from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.compare.replicates import find_replicates
from tcbi_infer.errors import MappingError
from tcbi_infer.importer import read_rollouts
from tcbi_infer.mapping import load_mapping
from tcbi_infer.pieces import pieces
from tcbi_sim.measurement import Commands, Measurement, Scenario


def recording(name="swing", duration=3.2, size=1.0, torque_on=None) -> Measurement:
    time = np.arange(0.0, duration + 1e-9, 0.005)
    given = np.array([0.0, 0.3, 1.4, 2.6])
    return Measurement(
        name,
        "servo_bench",
        Scenario("log", duration, settle=0.0),
        "",
        "log",
        Commands(given, size * np.array([[0.1], [0.2], [0.3], [0.4]]), 0.0, torque_on),
        ("servo",),
        (),
        time,
        0.5 * np.sin(2 * np.pi * time)[:, None],
    )


def test_pieces_cover_the_recording_and_leave_out_a_short_rest():
    whole = recording()
    parts = pieces(whole, 1.0)
    assert [p.rollout_id for p in parts] == ["swing-01", "swing-02", "swing-03"]
    for k, p in enumerate(parts):
        inside = (whole.time >= k - 1e-9) & (whole.time <= k + 1 + 1e-9)
        np.testing.assert_array_equal(p.joint_position, whole.joint_position[inside])
        assert p.time[0] == 0.0 and p.scenario.duration == pytest.approx(1.0)
    assert len(pieces(whole, 1.2)) == 3 and len(pieces(whole, 10.0)) == 1


def test_a_piece_begins_with_the_position_speed_and_command_of_its_moment():
    whole = recording(torque_on=np.array([True, False, True, True]))
    for k, p in enumerate(pieces(whole, 0.7)):
        at = k * 0.7
        assert p.scenario.initial_joint_position[0] == pytest.approx(0.5 * np.sin(2 * np.pi * at), abs=1e-3)
        assert p.scenario.initial_joint_velocity[0] == pytest.approx(np.pi * np.cos(2 * np.pi * at), abs=0.01)
        assert p.commands.time[0] == 0.0 and (np.diff(p.commands.time) > 0).all()
        in_force = int(np.searchsorted(whole.commands.time, at, side="right")) - 1
        assert p.commands.target[0, 0] == whole.commands.target[in_force, 0]
        assert p.commands.torque_on[0] == whole.commands.torque_on[in_force]
        assert p.commands.time[-1] < p.scenario.duration


def test_of_commands_within_a_millisecond_the_last_one_counts():
    whole = recording()
    fast = Commands(np.arange(0.0, 3.0, 0.0002), np.arange(15000.0)[:, None], 0.0)
    part = pieces(dataclasses.replace(whole, commands=fast), 1.0)[1]
    assert len(part.commands.time) == 1001 and (np.diff(part.commands.time) > 0).all()
    assert np.abs(part.commands.target[:, 0] * 0.0002 - 1.0 - part.commands.time).max() < 0.001


def test_a_window_in_a_gap_is_left_out_and_said():
    whole = recording()
    there = (whole.time < 1.0) | (whole.time > 2.0)
    gap = dataclasses.replace(whole, time=whole.time[there], joint_position=whole.joint_position[there])
    parts = pieces(gap, 0.8)
    assert [p.rollout_id for p in parts] == ["swing-01", "swing-02", "swing-03", "swing-04"]
    parts = pieces(gap, 0.4)
    assert [p.rollout_id[-2:] for p in parts] == ["01", "02", "03", "06", "07", "08"]
    assert all(p.notes == ("2 windows of 0.4 s with fewer than two samples left out",) for p in parts)


@pytest.mark.parametrize("window", [0.001, 5e-324])
def test_windows_shorter_than_the_samples_period_are_refused(window):
    with pytest.raises(MappingError, match=r"swing: no window of .* s holds two samples; make it longer"):
        pieces(recording(), window)


def test_a_piece_before_the_first_command_has_none(tmp_path):
    whole = recording(torque_on=np.array([True, False, True, True]))
    late = dataclasses.replace(whole.commands, time=whole.commands.time + 1.0)
    parts = pieces(dataclasses.replace(whole, commands=late), 1.0)
    assert [len(p.commands.time) for p in parts] == [0, 2, 2]
    assert not len(read_measurement(write_measurement(tmp_path, parts[0])).commands.time)
    none = dataclasses.replace(whole, commands=Commands(np.empty(0), np.empty((0, 1))))
    assert not len(pieces(none, 1.0)[1].commands.time)


def test_a_piece_survives_its_bag(tmp_path):
    part = pieces(recording(), 1.0)[1]
    part = dataclasses.replace(part, notes=())
    assert part.scenario.initial_joint_velocity is not None
    assert differences(part, read_measurement(write_measurement(tmp_path, part))) == []


def test_pieces_of_one_recording_are_one_kind_of_motion():
    names = [f"motion{k}" for k in range(3)]
    parts = [p for k, name in enumerate(names) for p in pieces(recording(name, size=1.0 + k), 1.0)]
    kinds = {p.rollout_id: g.kind for g in find_replicates(parts) for p in (parts[i] for i in g.members)}
    assert len(set(kinds.values())) == 3
    assert all(kind == kinds[f"{name.partition('-')[0]}-01"] for name, kind in kinds.items())


def test_a_mapping_with_a_window_gives_pieces(tmp_path):
    log = tmp_path / "log.csv"
    rows = [f"{t:.3f},{np.sin(t):.6f},{np.sin(t):.6f}" for t in np.arange(0.0, 2.5, 0.01)]
    log.write_text("\n".join(["time,angle,goal", *rows]))
    text = 'rig = "servo_bench"\njoints = ["servo"]\nwindow = 1\n'
    text += '[position]\ncolumn = "angle"\n[command]\ncolumn = "goal"\n'
    (tmp_path / "m.toml").write_text(text)
    assert len(read_rollouts(load_mapping(tmp_path / "m.toml"), log)) == 2
    assert len(read_rollouts(dataclasses.replace(load_mapping(tmp_path / "m.toml"), window=0.0), log)) == 1
