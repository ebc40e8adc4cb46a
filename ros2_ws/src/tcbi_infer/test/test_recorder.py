"""What is recorded is what bears a stamp between BEGIN and END; a full disk costs the last moments of one rollout."""

import contextlib
import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bag_cases import differences, rollout
from test_bags_from_elsewhere import START

from tcbi_contract import names
from tcbi_infer.bags import schemas, writer
from tcbi_infer.bags.encoding import joint_command, messages
from tcbi_infer.bags.files import find_bags, is_recording, left_out
from tcbi_infer.bags.folder import RecordingFolder
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.bags.recovery import recover
from tcbi_infer.bags.scan import Scan
from tcbi_infer.bags.writer import WholeFile
from tcbi_infer.errors import BagError, RecordingError
from tcbi_infer.recorder import BEFORE_S, SETTLE_S, Recorder


@pytest.fixture
def folder(tmp_path):
    with RecordingFolder(tmp_path / "rollouts") as made:
        yield made


@pytest.fixture
def recorder():
    made = Recorder()
    yield made
    if made.rollout is not None:  # as the kernel does when the process dies
        made.rollout.bag._file.close(to_disk=False)


class Feed:
    """A rollout's messages, and its events apart."""

    def __init__(self, case=None) -> None:
        self.case = case or rollout()
        everything = list(messages(self.case, START))
        events = [row for row in everything if row[0] == names.ROLLOUT_EVENT]
        (_, self.begin, self.first), (_, self.end, self.last) = events
        self.rows = [row for row in everything if row[0] != names.ROLLOUT_EVENT]

    def into(self, recorder: Recorder, rows=None) -> None:
        for topic, stamp, data in self.rows if rows is None else rows:
            recorder.add("/" + topic, stamp, stamp, data)

    def record(self, recorder: Recorder, folder: RecordingFolder) -> Path:
        recorder.begin(folder, self.case.rollout_id, self.begin, self.first, self.end)
        self.into(recorder)
        recorder.end(self.end, 0.0)
        assert recorder.settled(0.0)
        return recorder.close(self.last)


def test_a_rollout_is_recorded_bit_for_bit(folder):
    feed = Feed()
    bag = feed.record(Recorder(), folder)
    assert bag == folder.path / "walk_1"
    assert differences(feed.case, read_measurement(bag)) == []


def test_samples_that_come_before_their_begin_event_are_in_the_bag(folder):
    feed, recorder = Feed(), Recorder()
    feed.into(recorder, feed.rows[:60])
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    feed.into(recorder, feed.rows[60:])
    recorder.end(feed.end, 0.0)
    assert differences(feed.case, read_measurement(recorder.close(feed.last))) == []


def test_what_was_measured_before_begin_or_after_end_is_not(folder):
    feed, recorder = Feed(), Recorder()
    before = [(t, s - 500_000_000, _restamped(d, s - 500_000_000)) for t, s, d in feed.rows[:40]]
    after = [(t, s + 3_000_000_000, _restamped(d, s + 3_000_000_000)) for t, s, d in feed.rows[:40]]
    feed.into(recorder, [row for row in before if row[1] < feed.begin])
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    feed.into(recorder, feed.rows + after)
    recorder.end(feed.end, 0.0)
    assert differences(feed.case, read_measurement(recorder.close(feed.last))) == []


def test_a_command_at_the_very_end_is_left_out_whenever_it_comes(folder):
    feed = Feed()
    target = np.zeros(18)
    late = joint_command(feed.end, feed.case.joint_names, target, 0.2, True, False)
    feed.rows.append((names.JOINT_COMMANDS, feed.end, schemas.encode(late, schemas.MESSAGES[names.JOINT_COMMANDS])))
    bag = feed.record(Recorder(), folder)
    assert differences(feed.case, read_measurement(bag)) == []
    recorded = [m.publish_time for m in Scan(bag / "walk_1_0.mcap").messages() if m.channel.topic == "/joint_commands"]
    assert len(recorded) == len(feed.case.commands.time) and max(recorded) < feed.end


@pytest.mark.parametrize("slow", [names.IMU, names.TRACKER_POSE])
def test_the_end_waits_for_every_sensor_but_not_for_ever(folder, recorder, slow):
    feed = Feed()
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    feed.into(recorder, [row for row in feed.rows if row[0] != slow or row[1] < feed.end])
    recorder.end(feed.end, 100.0)
    assert not recorder.settled(100.0)
    assert recorder.settled(100.0 + SETTLE_S + 0.01)
    feed.into(recorder, [row for row in feed.rows if row[0] == slow and row[1] == feed.end])
    assert recorder.settled(100.0)


def test_memory_before_a_rollout_is_bounded():
    recorder = Recorder()
    for k in range(20_000):
        recorder.add("/joint_states", k * 1_000_000, k * 1_000_000, b"")
    kept = recorder._before
    assert len(kept) <= BEFORE_S * 1000 + 1 and kept[-1].stamp == 19_999_000_000


def test_a_second_recorder_on_the_folder_is_refused_by_name(folder):
    with pytest.raises(RecordingError, match=rf"another recorder \(process {os.getpid()}\)"):
        RecordingFolder(folder.path)
    folder.close()
    RecordingFolder(folder.path).close()


def test_a_rollout_that_is_being_recorded_is_no_part_of_its_folder_yet(folder, recorder):
    feed = Feed()
    done = Feed(rollout("walk_0")).record(Recorder(), folder)
    recorder.begin(folder, "walk_1", feed.begin, feed.first)
    feed.into(recorder)
    recorder.flush()
    assert is_recording(folder.path)
    unfinished = folder.path / "walk_1.recording"
    assert find_bags([folder.path]) == find_bags([done, unfinished]) == [done]
    assert left_out([done, unfinished]) == {unfinished: "it is being recorded right now"}
    assert find_bags([unfinished]) == [unfinished] and read_measurement(unfinished).rollout_id == "walk_1"
    folder.close()
    assert find_bags([done, unfinished]) == [done, unfinished], "what a killed recorder left is a rollout"


def test_a_full_disk_keeps_what_was_written_and_frees_the_recorder(folder, monkeypatch):
    first = Feed(rollout("walk_0")).record(Recorder(), folder)
    feed, recorder = Feed(rollout(samples=400)), Recorder()
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    feed.into(recorder, feed.rows[:900])
    recorder.flush()
    monkeypatch.setattr(WholeFile, "write", _full)
    with pytest.raises(RecordingError, match=r"No space left on device.*make room"):
        feed.into(recorder, feed.rows[900:])
    assert recorder.rollout is None
    monkeypatch.undo()
    saved = read_measurement(folder.path / "walk_1")
    assert len(saved.time) > 150 and any("never closed" in note for note in saved.notes)
    assert read_measurement(first).rollout_id == "walk_0"
    Feed(rollout("walk_2")).record(recorder, folder)


def test_a_disk_that_takes_half_a_write_leaves_whole_records(tmp_path):
    """A real limit of the kernel (RLIMIT_FSIZE), in a process of its own: part of a write reaches the file."""
    script = f"""
import resource, signal, sys
from pathlib import Path
sys.path[:0] = {sys.path!r}
from test_recorder import Feed, rollout, Recorder, RecordingFolder, RecordingError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))
try:
    Feed(rollout(samples=3000)).record(Recorder(), RecordingFolder(Path({str(tmp_path)!r})))
except RecordingError as error:
    print(error)
    sys.exit(7)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 7, done.stderr
    assert "File too large" in done.stdout
    file = tmp_path / "walk_1" / "walk_1_0.mcap"
    assert file.stat().st_size <= 150_000
    scan = Scan(file)
    assert sum(1 for _ in scan.messages()) > 500
    assert scan.damage == ["the recording was never closed"] and scan.lost_bytes == 0


def test_a_disk_that_is_full_at_the_very_end_frees_the_recorder(folder, recorder, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    feed = Feed()
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    feed.into(recorder)
    monkeypatch.setattr(writer, "write_metadata", full)
    with pytest.raises(RecordingError, match=r"metadata cannot be written .*make room .*\./tcbi recover"):
        recorder.close(feed.last, feed.end)
    monkeypatch.undo()
    assert recorder.rollout is None
    assert len(read_measurement(folder.path / "walk_1").time) == len(feed.case.time)
    Feed(rollout("walk_2")).record(recorder, folder)


def test_a_disk_that_fails_altogether_is_one_line_and_frees_the_recorder(folder, recorder, monkeypatch):
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    feed = Feed(rollout(samples=400))
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    whole = recorder.rollout.bag._file
    broken = SimpleNamespace(write=fail, truncate=fail, close=fail)
    with contextlib.closing(whole._file):
        monkeypatch.setattr(whole, "_file", broken)
        monkeypatch.setattr(Path, "rename", fail)
        with pytest.raises(RecordingError, match=r"Input/output error.*make room"):
            feed.into(recorder)
    assert recorder.rollout is None
    assert (folder.path / "walk_1.recording" / "walk_1_0.mcap").is_file()


def test_too_little_room_is_said_before_a_rollout_is_wasted(folder):
    feed, recorder = Feed(), Recorder()
    with pytest.raises(RecordingError, match=r"MB are free, at least .* make room"):
        recorder.begin(folder, "walk_1", feed.begin, feed.first, min_free_mb=1e12)
    assert recorder.rollout is None and list(folder.path.glob("walk*")) == []


def test_a_folder_that_was_removed_is_said_in_one_line(folder):
    feed, recorder = Feed(), Recorder()
    recorder.begin(folder, "walk_1", feed.begin, feed.first)
    shutil.rmtree(folder.path)
    recorder.discard()
    with pytest.raises(RecordingError, match=r"rollouts: cannot be used .* \(No such file or directory\); start") as e:
        recorder.begin(folder, "walk_2", feed.begin, feed.first)
    assert recorder.rollout is None and "\n" not in str(e.value)


def test_a_killed_recorders_rollout_is_repaired_by_the_next_one(folder, recorder):
    feed = Feed()
    recorder.begin(folder, "walk_1", feed.begin, feed.first, feed.end)
    feed.into(recorder)
    recorder.flush()
    folder.close()  # what the kernel does when the process dies
    with RecordingFolder(folder.path) as again:
        assert len(again.repaired) == 1 and "416" not in again.repaired[0] and "in walk_1" in again.repaired[0]
    assert len(read_measurement(folder.path / "walk_1").time) == len(feed.case.time)


def test_a_rollout_that_is_being_recorded_cannot_be_repaired(folder, recorder):
    feed = Feed()
    recorder.begin(folder, "walk_1", feed.begin, feed.first)
    feed.into(recorder)
    recorder.flush()
    with pytest.raises(BagError, match="is being recorded right now"):
        recover(folder.path / "walk_1.recording")


def test_what_a_killed_recorder_left_empty_is_kept_aside(folder):
    (folder.path / "walk_1.recording").mkdir()
    (folder.path / "walk_1.recording" / "walk_1_0.mcap").write_bytes(b"\x89MCAP0\r\n")
    folder.close()
    with RecordingFolder(folder.path) as again:
        assert "is kept as walk_1.damaged" in again.repaired[0]
        assert [p.name for p in folder.path.glob("walk*")] == ["walk_1.damaged"]


def _full(self, data: bytes) -> int:
    raise RecordingError(
        f"{self.path}: cannot be written any more ({os.strerror(errno.ENOSPC)}); make room on the disk"
    )


def _restamped(data: bytes, stamp: int) -> bytes:
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return data[:4] + sec.to_bytes(4, "little", signed=True) + nanosec.to_bytes(4, "little") + data[12:]
