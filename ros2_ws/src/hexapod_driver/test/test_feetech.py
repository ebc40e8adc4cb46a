"""Servo packets against the maker's frames, and the stream parser against rubbish."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hexapod_driver import feetech
from hexapod_driver.feetech import Instruction, Packet, PacketStream, TimedMove

packets = st.builds(Packet, st.integers(0, feetech.MAX_ID), st.integers(0, 255), st.binary(max_size=40))


def _bytes(text: str) -> bytes:
    return bytes.fromhex(text)


def test_encodes_the_makers_frames():
    assert feetech.encode(1, Instruction.PING) == _bytes("FF FF 01 02 01 FB")
    assert feetech.encode(1, 0) == _bytes("FF FF 01 02 00 FC")
    assert feetech.read(1, feetech.PRESENT_POSITION, 2) == _bytes("FF FF 01 04 02 38 02 BE")
    assert feetech.encode(1, 0, _bytes("18 05")) == _bytes("FF FF 01 04 00 18 05 DD")


def test_a_timed_move_lays_out_acceleration_goal_time_and_speed():
    data = feetech.timed_moves({1: TimedMove(0x0812, 200, 0x0123), 2: TimedMove(0x0800, 200, 1)})
    assert data == _bytes("FF FF FE 14 83 29 07 01 00 12 08 C8 00 23 01 02 00 00 08 C8 00 01 00 60")


def test_parses_the_makers_answer():
    assert PacketStream().feed(_bytes("FF FF 01 04 00 18 05 DD")) == [Packet(1, 0, _bytes("18 05"))]


@pytest.mark.parametrize("servo", [-1, 253, 255, 300])
def test_refuses_ids_that_no_servo_can_have(servo: int):
    with pytest.raises(ValueError, match=str(servo)):
        feetech.encode(servo, Instruction.PING)


def test_refuses_a_sync_write_of_unequal_lengths():
    with pytest.raises(ValueError, match="one length"):
        feetech.sync_write(40, {1: b"\0", 2: b"\0\0"})


@given(st.integers(-32767, 32767))
def test_sign_magnitude_is_undone(value: int):
    assert feetech.from_sign_magnitude(feetech.to_sign_magnitude(value, 15), 15) == value


def test_sign_magnitude_is_not_twos_complement():
    assert feetech.to_sign_magnitude(-1, 15) == 0x8001
    assert feetech.from_sign_magnitude(0x0401, 10) == -1
    with pytest.raises(ValueError, match="1024"):
        feetech.to_sign_magnitude(1024, 10)


@given(st.lists(packets, max_size=8))
def test_every_packet_in_a_clean_stream_is_found(sent: list[Packet]):
    data = b"".join(feetech.encode(p.id, p.code, p.params) for p in sent)
    stream = PacketStream()
    assert stream.feed(data) == sent
    assert stream.rubbish == stream.bad_checksums == 0


@given(st.binary(max_size=300), st.lists(packets, max_size=3), st.data())
def test_what_is_found_does_not_depend_on_the_cuts(rubbish: bytes, sent: list[Packet], data: st.DataObject):
    whole = rubbish + b"".join(feetech.encode(p.id, p.code, p.params) for p in sent) + rubbish
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=10)))
    stream, pieces = PacketStream(), PacketStream()
    expected = stream.feed(whole)
    found = [p for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True) for p in pieces.feed(whole[a:b])]
    assert found == expected
    assert (pieces.rubbish, pieces.bad_checksums) == (stream.rubbish, stream.bad_checksums)
    assert pieces.expire() == stream.expire()


@given(st.binary(max_size=200).map(lambda b: b.replace(b"\xff", b"\xfe")), packets)
def test_rubbish_without_a_header_hides_nothing(rubbish: bytes, packet: Packet):
    stream = PacketStream()
    assert stream.feed(rubbish + feetech.encode(packet.id, packet.code, packet.params)) == [packet]
    assert stream.rubbish == len(rubbish)


@given(st.binary(max_size=200), packets)
def test_after_any_rubbish_and_a_quiet_line_the_next_packet_is_found(rubbish: bytes, packet: Packet):
    stream = PacketStream()
    stream.feed(rubbish)
    stream.expire()
    assert stream.feed(feetech.encode(packet.id, packet.code, packet.params)) == [packet]


@given(packets, st.data())
def test_a_cut_packet_does_not_swallow_the_next(packet: Packet, data: st.DataObject):
    whole = feetech.encode(packet.id, packet.code, packet.params)
    cut = data.draw(st.integers(1, len(whole) - 1))
    stream = PacketStream(longest=64)
    found = stream.feed(whole[:cut] + feetech.encode(7, 0, b"\x01\x08")) + stream.expire()
    assert found  # the next one, or the cut one where the first byte of the next happens to complete it


@given(packets, st.data())
def test_a_flipped_bit_never_gives_the_same_servo_another_value(packet: Packet, data: st.DataObject):
    whole = bytearray(feetech.encode(packet.id, packet.code, packet.params))
    at = data.draw(st.integers(2, len(whole) - 1))
    whole[at] ^= 1 << data.draw(st.integers(0, 7))
    assert not any(p.id == packet.id and len(p.params) == len(packet.params) for p in PacketStream().feed(bytes(whole)))


def test_a_header_with_three_ff_is_read_from_its_last_two():
    assert PacketStream().feed(b"\xff" + _bytes("FF FF 01 02 00 FC")) == [Packet(1, 0)]


def test_a_length_that_no_answer_has_costs_one_byte():
    stream = PacketStream(longest=32)
    assert stream.feed(_bytes("FF FF 01 F0") + _bytes("FF FF 01 02 00 FC")) == [Packet(1, 0)]
    assert stream.rubbish == 4


def test_errors_are_named():
    assert feetech.error_names(0b100101) == ("voltage", "overheated", "overload")
    assert feetech.error_names(0) == ()
