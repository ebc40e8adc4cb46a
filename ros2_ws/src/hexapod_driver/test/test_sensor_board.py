"""The board's frames against golden vectors, two independent libraries, and rubbish.

The golden vectors were made with the packages cobs and crcmod-plus, and stand in docs/protocol.md too.
"""

import math

import crcmod.predefined
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from hexapod_driver import sensor_board
from hexapod_driver.sensor_board import Feature, Frame, FrameError, FrameStream, Identity, Kind, Sample, ServoReply

PING = bytes.fromhex("FFFF010201FB")
PONG = bytes.fromhex("FFFF010200FC")
SAMPLE = Sample(
    2_000_000, (0.0, 0.0, 0.0, 1.0), (0.5, -0.25, 0.0), (0.0, 0.0, 9.75), (True, False, False, True, False, True)
)
GOLDEN = {
    "03 01 01 01 03 44 C5 00": Frame(Kind.IDENTIFY, 0),
    "04 01 02 01 02 32 05 90 01 E5 9A 00": Frame(Kind.STREAM, 1, sensor_board.stream_payload(50, 400)),
    "04 01 03 02 02 07 0A 01 FF FF 01 02 01 FB 08 BA 00": Frame(Kind.SERVO, 2, sensor_board.servo_payload(7, 1, PING)),
    "04 01 81 01 04 01 07 03 04 60 E3 16 01 01 01 01 07 68 65 78 61 37 38 00": Frame(
        Kind.IDENTITY, 1, sensor_board.identity_payload(Identity(1, Feature(7), 3, 1_500_000, "hexa"))
    ),
    "04 01 82 02 04 80 84 1E 01 01 01 01 03 0F 29 01 01 01 01 01 01 01 01 01 01 01 01 01 03 80 3F 01 01 02 3F 01 03 "
    "80 BE 01 01 01 01 01 01 01 01 01 01 01 01 01 05 1C 41 1A 9A 00": Frame(
        Kind.SAMPLE, 2, sensor_board.sample_payload(SAMPLE)
    ),
    "04 01 83 03 02 07 04 E4 84 1E 01 01 01 01 06 01 FF FF 01 02 04 FC 7A 16 00": Frame(
        Kind.SERVO_REPLY, 3, sensor_board.servo_reply_payload(ServoReply(7, 2_000_100, True, PONG))
    ),
}
frames = st.builds(Frame, st.integers(0, 255), st.integers(0, 65535), st.binary(max_size=590))


@pytest.mark.parametrize("text", GOLDEN, ids=lambda text: GOLDEN[text].kind.name)
def test_frames_are_the_golden_vectors_both_ways(text: str):
    frame = GOLDEN[text]
    assert sensor_board.encode(frame) == bytes.fromhex(text)
    assert FrameStream().feed(bytes.fromhex(text)) == [frame]


@given(st.binary(max_size=700))
def test_stuffing_and_checksum_agree_with_independent_libraries(data: bytes):
    assert sensor_board.cobs_encode(data) == cobs.encode(data)
    assert sensor_board.cobs_decode(cobs.encode(data)) == data
    assert sensor_board.crc16(data) == crcmod.predefined.mkCrcFun("crc-ccitt-false")(data)


@given(st.binary(max_size=300))
def test_unstuffing_accepts_only_what_the_independent_library_accepts(data: bytes):
    try:
        expected = cobs.decode(data)
    except cobs.DecodeError:
        with pytest.raises(FrameError):
            sensor_board.cobs_decode(data)
    else:
        assert sensor_board.cobs_decode(data) == expected


@given(st.lists(frames, max_size=5), st.data())
def test_what_is_found_does_not_depend_on_the_cuts(sent: list[Frame], data: st.DataObject):
    rubbish = data.draw(st.binary(max_size=900))
    whole = b"".join(map(sensor_board.encode, sent)) + rubbish + b"\0" + b"".join(map(sensor_board.encode, sent))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=10)))
    stream, pieces = FrameStream(), FrameStream()
    expected = stream.feed(whole)
    found = [f for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True) for f in pieces.feed(whole[a:b])]
    assert found == expected
    assert expected[: len(sent)] == sent
    assert len(sent) == 0 or expected[-len(sent) :] == sent
    assert pieces.bad == stream.bad


@given(frames, st.data())
def test_a_cut_frame_costs_itself_and_nothing_else(frame: Frame, data: st.DataObject):
    whole = sensor_board.encode(frame)
    cut = data.draw(st.integers(1, len(whole) - 2))
    stream = FrameStream()
    assert stream.feed(whole[:cut] + b"\0" + whole) == [frame]
    assert stream.bad == 1


@given(st.data())
def test_a_flipped_bit_never_gives_another_sample(data: st.DataObject):
    whole = bytearray(sensor_board.encode(Frame(Kind.SAMPLE, 9, sensor_board.sample_payload(SAMPLE))))
    at = data.draw(st.integers(0, len(whole) - 2))
    whole[at] ^= 1 << data.draw(st.integers(0, 7))
    assert FrameStream().feed(bytes(whole)) == []


def test_an_endless_line_of_rubbish_takes_no_memory():
    stream = FrameStream()
    for _ in range(100):
        assert stream.feed(b"\x55" * 10_000) == []
    assert len(stream._buffer) <= 10_000
    assert stream.feed(b"\0" + sensor_board.encode(Frame(1, 2))) == [Frame(1, 2)]
    assert stream.bad == 1


def test_another_version_is_noticed_and_not_understood():
    body = bytes((2, Kind.SAMPLE, 0, 0))
    stream = FrameStream()
    assert stream.feed(cobs.encode(body + sensor_board.crc16(body).to_bytes(2, "little")) + b"\0") == []
    assert stream.foreign_versions == {2}


def test_a_sample_says_what_was_not_measured():
    blind = Sample(5, None, None, (0.0, 0.0, 9.75), None, watchdog_tripped=True)
    assert sensor_board.parse_sample(sensor_board.sample_payload(blind)) == blind
    assert sensor_board.parse_sample(sensor_board.sample_payload(SAMPLE)) == SAMPLE


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_sample_with_an_impossible_number_is_refused(value: float):
    wrong = Sample(5, None, (0.0, value, 0.0), None, None)
    with pytest.raises(FrameError, match="finite"):
        sensor_board.parse_sample(sensor_board.sample_payload(wrong))


def test_a_sample_whose_orientation_is_no_rotation_is_refused():
    with pytest.raises(FrameError, match="unit quaternion"):
        sensor_board.parse_sample(sensor_board.sample_payload(Sample(5, (0.0, 0.0, 0.0, 0.0), None, None, None)))


def test_a_payload_of_the_wrong_length_is_refused():
    for parse in (sensor_board.parse_sample, sensor_board.parse_stream, sensor_board.parse_servo_reply):
        with pytest.raises(FrameError, match="got 3 bytes"):
            parse(b"\1\2\3")


def test_identity_and_servo_reply_are_undone():
    identity = Identity(1, Feature.IMU, 12, 99, "board")
    assert sensor_board.parse_identity(sensor_board.identity_payload(identity)) == identity
    reply = ServoReply(65_535, 1, False, PONG)
    assert sensor_board.parse_servo_reply(sensor_board.servo_reply_payload(reply)) == reply
    assert sensor_board.parse_servo(sensor_board.servo_payload(3, 18, PING)) == (3, 18, PING)
