"""The list of rollouts."""

from pathlib import Path

import pytest
from cases import recording

from tcbi_dashboard.catalogue import Catalogue
from tcbi_infer.bags import glance as glance_module
from tcbi_infer.bags.glance import glance
from tcbi_infer.bags.measurement_writer import write_measurement


def test_a_glance_tells_what_the_whole_bag_would(tmp_path):
    m = recording("a", slope_roll=0.1)
    seen = glance(write_measurement(tmp_path, m))
    assert (seen.rollout_id, seen.task, seen.policy_id, seen.rig) == ("a", "balance", m.policy_id, "servo_bench")
    assert seen.slope_roll == pytest.approx(0.1) and seen.seconds == pytest.approx(m.scenario.duration)
    assert not seen.problem


def test_a_glance_reads_only_the_beginning(tmp_path, monkeypatch):
    bag = write_measurement(tmp_path, recording("long", seconds=60.0))
    counted = []
    whole = glance_module.Scan.messages

    def counting(self):
        for message in whole(self):
            counted.append(message)
            yield message

    monkeypatch.setattr(glance_module.Scan, "messages", counting)
    assert glance(bag).rollout_id == "long"
    assert len(counted) <= 3


def test_what_is_no_bag_is_listed_with_its_problem(tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "broken_0.mcap").write_bytes(b"no bag at all")
    assert "another format" in glance(broken).problem
    assert glance(tmp_path / "nowhere").problem


def test_bags_of_a_folder_and_of_the_folders_in_it_are_found_newest_first(tmp_path):
    write_measurement(tmp_path, recording("first"), start_ns=1_000_000_000)
    write_measurement(tmp_path / "later", recording("second"), start_ns=2_000_000_000_000)
    catalogue = Catalogue([tmp_path, tmp_path / "not_there"])
    assert catalogue.look() and catalogue.revision == 1
    assert [e.rollout_id for e in catalogue.entries] == ["second", "first"]


def test_only_what_is_new_is_read_again(tmp_path, monkeypatch):
    write_measurement(tmp_path, recording("a"))
    catalogue = Catalogue([tmp_path])
    catalogue.look()
    read: list[Path] = []

    def noted(bag):
        read.append(bag)
        return glance(bag)

    monkeypatch.setattr("tcbi_dashboard.catalogue.glance", noted)
    assert not catalogue.look() and read == []
    write_measurement(tmp_path, recording("b"))
    assert catalogue.look() and [p.name for p in read] == ["b"]


def test_the_folder_of_a_recording_is_offered_unless_it_was_already(tmp_path):
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own / "inside", other):
        (folder / "bag").mkdir(parents=True)
    catalogue = Catalogue([own])
    catalogue.include([own / "bag", own / "inside" / "bag", tmp_path / "gone" / "bag"])
    assert catalogue.added == ()
    catalogue.include([other / "bag"])
    catalogue.include([other / "bag"])
    assert catalogue.added == (other,)
