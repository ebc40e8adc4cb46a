"""A recording that was cut anywhere gives back every complete chunk."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from bag_cases import differences, rollout
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader

from tcbi_infer.bags import schemas
from tcbi_infer.bags.files import REPAIRED, bags_in, find_bags, left_out
from tcbi_infer.bags.folder import RecordingFolder
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.bags.recovery import recover
from tcbi_infer.bags.scan import MAGIC, Scan
from tcbi_infer.errors import BagError


@pytest.fixture(scope="module")
def intact(tmp_path_factory) -> bytes:
    bag = write_measurement(tmp_path_factory.mktemp("intact"), rollout(samples=400))
    return (bag / "walk_1_0.mcap").read_bytes()


@pytest.fixture(scope="module")
def chunk_ends(intact, tmp_path_factory) -> list[tuple[int, int]]:
    """(byte behind a chunk, messages up to it), by another reader of the format."""
    path = tmp_path_factory.mktemp("ends") / "x.mcap"
    path.write_bytes(intact)
    ends, at, count = [(0, 0)], len(MAGIC), 0
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            length = int.from_bytes(intact[at + 1 : at + 9], "little")
            at += 9 + length
            if type(record).__name__ == "Chunk":
                count += sum(type(r).__name__ == "Message" for r in breakup_chunk(record))
                ends.append((at, count))
    assert len(ends) > 8
    return ends


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1))
def test_a_cut_at_any_byte_keeps_every_message_of_every_complete_chunk(tmp_path_factory, intact, chunk_ends, share):
    cut = round(share * (len(intact) - 1))
    path = tmp_path_factory.mktemp("cut") / "cut.mcap"
    path.write_bytes(intact[:cut])
    complete = max(count for end, count in chunk_ends if end <= cut)
    scan = Scan(path)
    assert sum(1 for _ in scan.messages()) >= complete
    assert scan.damage
    if complete:
        recovery = recover(path)
        assert recovery.messages >= complete
        again = Scan(path)
        assert sum(1 for _ in again.messages()) == recovery.messages and again.finished and not again.damage
        assert recovery.original.read_bytes() == intact[:cut]
    else:
        with pytest.raises(BagError, match="not one message"):
            recover(path)
        assert path.read_bytes() == intact[:cut]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(100, 10**9), value=st.integers(0, 255))
def test_a_wrong_byte_never_crashes_the_scan(tmp_path_factory, intact, at, value):
    data = bytearray(intact)
    data[at % len(data)] = value
    path = tmp_path_factory.mktemp("flip") / "flip.mcap"
    path.write_bytes(data)
    total = sum(1 for _ in Scan(path).messages())
    assert total <= 400 * 4 + 42


def test_a_damaged_chunk_costs_that_chunk_alone(tmp_path, intact, chunk_ends):
    (start, before), (_, after) = chunk_ends[3], chunk_ends[4]
    data = bytearray(intact)
    data[start + 400] ^= 0xFF  # inside the index or the fourth chunk's compressed data
    data[chunk_ends[4][0] - 200] ^= 0xFF
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    scan = Scan(path)
    count = sum(1 for _ in scan.messages())
    assert count == chunk_ends[-1][1] - (after - before)
    assert len(scan.damage) == 1 and "damaged" in scan.damage[0]


def fourth_chunk(intact: bytes, chunk_ends: list[tuple[int, int]]) -> int:
    """Its first byte; behind the third one lies that one's index."""
    at = chunk_ends[3][0]
    while intact[at] != Opcode.CHUNK:
        at += 9 + int.from_bytes(intact[at + 1 : at + 9], "little")
    return at


@pytest.mark.parametrize(("byte", "value"), [(7, 0x80), (7, 0xFF), (7, 0x40), (4, 0x02)])
def test_a_wrong_size_in_a_chunks_header_costs_that_chunk_alone(tmp_path, intact, chunk_ends, byte, value):
    (_, before), (_, after) = chunk_ends[3], chunk_ends[4]
    data = bytearray(intact)
    data[fourth_chunk(intact, chunk_ends) + 9 + 16 + byte] = value  # of `uncompressed_size`
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    recovery = recover(path)
    assert recovery.messages == chunk_ends[-1][1] - (after - before)
    assert len(recovery.damage) == 1 and "at most 4294967296 are allowed" in recovery.damage[0]


def test_a_chunk_that_asks_for_more_than_the_memory_costs_that_chunk_alone(tmp_path, intact, chunk_ends):
    (end, count), start = chunk_ends[4], fourth_chunk(intact, chunk_ends)
    frame = struct.pack("<IBQ", 0xFD2FB528, 0b1110_0000, 1 << 62)  # zstd, the size of its content in eight bytes
    head = intact[start + 9 : start + 9 + 32] + b"zstd" + struct.pack("<Q", len(frame))
    chunk = struct.pack("<BQ", Opcode.CHUNK, len(head) + len(frame)) + head + frame
    path = tmp_path / "x.mcap"
    path.write_bytes(intact[:start] + chunk + intact[end:])
    scan = Scan(path)
    assert sum(1 for _ in scan.messages()) == chunk_ends[-1][1] - (count - chunk_ends[3][1])
    assert scan.damage == [f"a record of {len(head) + len(frame)} bytes at byte {start} is damaged (MemoryError)"]


def test_a_tail_of_zeros_as_a_power_failure_leaves_it_is_no_data(tmp_path, intact, chunk_ends):
    end, count = chunk_ends[5]
    path = tmp_path / "x.mcap"
    path.write_bytes(intact[:end] + bytes(5000))
    scan = Scan(path)
    assert sum(1 for _ in scan.messages()) == count
    assert "no record begins" in scan.damage[0]


def test_a_reader_recovers_by_itself_and_says_so(tmp_path, intact):
    whole = rollout(samples=400)
    path = tmp_path / "walk_1.mcap"
    path.write_bytes(intact[: len(intact) // 2])
    back = read_measurement(path)
    assert 100 < len(back.time) < 300
    assert np.array_equal(back.joint_position, whole.joint_position[: len(back.time)])
    assert any("is damaged" in note and "recover" in note for note in back.notes)
    assert any("no END event" in note for note in back.notes)
    assert back.scenario.duration == pytest.approx(back.time[-1])


def test_a_repaired_bag_is_a_bag_for_other_readers_and_the_original_is_kept(tmp_path):
    bag = write_measurement(tmp_path, rollout(samples=400))
    (bag / "metadata.yaml").unlink()
    file = bag / "walk_1_0.mcap"
    cut = file.read_bytes()[: file.stat().st_size // 2]
    file.write_bytes(cut)
    recovery = recover(bag)
    assert recovery.bag == bag and recovery.repaired and recovery.lost_bytes > 0 and 2 < recovery.seconds < 6
    assert (recovery.original / "walk_1_0.mcap").read_bytes() == cut
    with Reader(bag) as reader:
        assert reader.message_count == recovery.messages == sum(recovery.topics.values())
        assert all(c.digest == schemas.type_hash(c.msgtype) for c in reader.connections)
    assert [note[:6] for note in read_measurement(bag).notes] == ["no END"]
    assert find_bags([tmp_path]) == [bag], "the damaged original must not be read with the others"


@pytest.mark.parametrize("bare", [False, True])
def test_a_damaged_original_is_read_only_where_it_is_named_alone(tmp_path, bare):
    bag = write_measurement(tmp_path, rollout(samples=400))
    file = bag / "walk_1_0.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    repaired = recover(file.rename(tmp_path / "walk.mcap") if bare else bag)
    original = repaired.original
    inside = [] if bare else [original / "walk_1_0.mcap"]
    assert find_bags([repaired.bag, original, *inside]) == [repaired.bag]
    assert left_out([repaired.bag, original, *inside]).keys() == {original, *inside}
    assert find_bags([original]) == [original] and left_out([original]) == {}
    for path in (original, *(original / file.name for file in inside)):
        with pytest.raises(BagError, match="is the damaged original that a repair kept"):
            recover(path)
    assert any("is damaged" in note for note in read_measurement(original).notes)


def test_a_bare_file_beside_bags_hides_none_of_them(tmp_path):
    folder = tmp_path / "lab"
    for name in ("walk_1", "walk_2"):
        (folder / name).mkdir(parents=True)
        (folder / name / f"{name}_0.mcap").touch()
        (folder / name / "metadata.yaml").touch()
    (folder / "walk_3.mcap").touch()
    assert [bag.name for bag in find_bags([folder])] == ["walk_1", "walk_2", "walk_3.mcap"]
    assert find_bags([folder / "walk_1"]) == [folder / "walk_1"]


def test_an_unfinished_recording_gets_its_final_name(tmp_path):
    bag = write_measurement(tmp_path, rollout())
    bag.rename(tmp_path / "walk_1.recording")
    (tmp_path / "walk_1.recording" / "metadata.yaml").unlink()
    recovery = recover(tmp_path / "walk_1.recording")
    assert recovery.bag == tmp_path / "walk_1"
    assert differences(rollout(), read_measurement(recovery.bag)) == []


def test_an_unfinished_recording_is_found_under_the_name_that_it_would_have_got(tmp_path):
    bag = write_measurement(tmp_path, rollout())
    left = bag.rename(tmp_path / "walk_1.recording")
    (left / "metadata.yaml").unlink()
    assert find_bags([bag]) == find_bags([bag, left]) == [left]
    assert read_measurement(bag).rollout_id == "walk_1"
    assert recover(bag).bag == bag and bag.is_dir() and not left.exists()
    with pytest.raises(BagError, match="walk_2: there is no such bag"):
        recover(tmp_path / "walk_2")


class Killed(BaseException):
    """Stands for the end of the process."""


def killed_at_its_last_step(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repair whose process ends between its two renames."""
    rename = Path.rename

    def until(path: Path, target: Path) -> Path:
        if path.name.endswith(REPAIRED):
            raise Killed
        return rename(path, target)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Path, "rename", until)
        recover(bag)
    assert not bag.exists()


def cut_in_half(bag: Path, bare: bool) -> Path:
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    if not bare:
        return bag
    file = file.rename(bag.parent / "lab.walk.mcap")
    shutil.rmtree(bag)
    return file


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize("look", ["folder", "name", "recorder", "recover"])
def test_a_repair_that_was_killed_at_its_last_step_is_finished_at_the_next_look(tmp_path, monkeypatch, bare, look):
    bag = cut_in_half(write_measurement(tmp_path, rollout(samples=400)), bare)
    killed_at_its_last_step(bag, monkeypatch)
    if look == "recorder":
        with RecordingFolder(tmp_path) as folder:
            assert folder.repaired == [f"the repair of {bag.name} was interrupted; it is whole now"]
    elif look == "recover":
        assert not recover(bag).repaired
    else:
        assert (bags_in(tmp_path) if look == "folder" else find_bags([bag])) == [bag]
    assert bags_in(tmp_path) == [bag] and not list(tmp_path.glob(f".*{REPAIRED}"))
    assert [note[:6] for note in read_measurement(bag).notes] == ["no END"]


def test_a_bag_that_was_removed_is_not_brought_back_by_a_repair_that_did_not_touch_it(tmp_path, monkeypatch):
    bag = cut_in_half(write_measurement(tmp_path, rollout(samples=400)), bare=False)
    killed_at_its_last_step(bag, monkeypatch)
    shutil.rmtree(tmp_path / "walk_1.damaged")  # as if the process had ended before its first rename
    with pytest.raises(BagError, match="holds no bag"):
        find_bags([tmp_path])


def test_a_sound_bag_is_left_alone(tmp_path):
    bag = write_measurement(tmp_path, rollout())
    before = (bag / "walk_1_0.mcap").stat().st_mtime_ns
    recovery = recover(bag)
    assert not recovery.repaired and recovery.messages == 416
    assert (bag / "walk_1_0.mcap").stat().st_mtime_ns == before


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_the_readable_part_of_a_large_unfinished_chunk_is_saved(tmp_path, compression):
    path = tmp_path / "lab.mcap"
    rng = np.random.default_rng(0)
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=4 << 20, compression=compression)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/text", "cdr", schema)
        for i in range(1000):
            writer.add_message(channel, i, rng.bytes(1000), i)
        writer.finish()
    path.write_bytes(path.read_bytes()[:700_000])
    scan = Scan(path)
    saved = list(scan.messages())
    assert len(saved) > 400
    assert [m.log_time for m in saved] == list(range(len(saved)))
    assert scan.damage == ["the file ends inside a record"]


def test_every_channel_keeps_its_own_encoding_and_type(tmp_path):
    path = tmp_path / "lab.mcap"
    channels = (  # two types on one topic, bytes that are no text, no schema at all
        ("/text", "cdr", ("std_msgs/msg/String", "ros2msg", b"string data # \xb0C")),
        ("/text", "cdr", ("std_msgs/msg/Bool", "ros2msg", b"bool data")),
        ("/scene", "protobuf", ("foxglove.Scene", "protobuf", b"\x0a\xff\x00scene")),
        ("/note", "json", None),
        ("/other", "cdr", ("lab_msgs/msg/Own", "", b"")),
    )
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2")
        ids = [
            writer.register_channel(topic, encoding, writer.register_schema(*schema) if schema else 0)
            for topic, encoding, schema in channels
        ]
        for i in range(10):
            writer.add_message(ids[i % 5], i, bytes([i]), i)
        writer.finish()
    path.write_bytes(path.read_bytes()[:-3])
    assert recover(path).messages == 10
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages())
    assert [
        (c.topic, c.message_encoding, (s.name, s.encoding, s.data) if s else None) for s, c, _ in found
    ] == 2 * list(channels)
    assert [message.data for _, _, message in found] == [bytes([i]) for i in range(10)]


def test_another_format_is_named(tmp_path):
    path = tmp_path / "not.mcap"
    path.write_bytes(b"SQLite format 3\0" + bytes(100))
    with pytest.raises(BagError, match="another format"):
        list(Scan(path).messages())
