"""ONNX models and TensorBoard events are what their formats say, byte by byte, and hold what they should."""

import dataclasses
import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tcbi_policy.artefact import Card
from tcbi_policy.mlp import Mlp
from tcbi_policy.onnx_file import to_onnx
from tcbi_policy.protobuf import double, number, single, text, varint
from tcbi_policy.tensorboard import EventFile, masked_crc


def network(sizes: tuple[int, ...] = (21, 256, 256, 18)) -> Mlp:
    rng = np.random.default_rng(0)
    weights = tuple(rng.normal(size=(b, a)) / np.sqrt(a) for a, b in pairwise(sizes))
    return Mlp(weights, tuple(rng.normal(size=b) * 0.1 for b in sizes[1:]), np.full(sizes[0], 2.0), 0.52)


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Decode a message: field numbers and values, bytes undecoded."""
    at = 0

    def read() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte, at = data[at], at + 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(data):
        key = read()
        if key & 7 == 0:
            yield key >> 3, read()
            continue
        size = read() if key & 7 == 2 else {1: 8, 5: 4}[key & 7]
        at += size
        yield key >> 3, data[at - size : at]


def test_numbers_are_written_as_the_specification_says() -> None:
    assert varint(150) == b"\x96\x01" and number(1, 150) == b"\x08\x96\x01"
    assert text(2, "testing") == b"\x12\x07testing"
    assert single(2, 1.0) == b"\x15\x00\x00\x80\x3f" and len(double(1, 1.0)) == 9


def test_an_onnx_model_holds_the_network_and_its_card() -> None:
    mlp, card = network(), Card("level", "balance")
    model = dict(fields(to_onnx(mlp, card)))
    graph = list(fields(model[7]))
    kinds = [dict(fields(value))[4].decode() for key, value in graph if key == 1]
    assert kinds == ["Mul", *["Gemm", "Tanh"] * 3, "Mul"]
    tensors = {t[8].decode(): np.frombuffer(t[9], "<f4") for t in (dict(fields(v)) for k, v in graph if k == 5)}
    np.testing.assert_array_equal(tensors["layer1.weight"].reshape(256, 256), mlp.weights[1].astype("f4"))
    assert tensors["limit"] == np.float32(0.52)
    assert Card.from_json(dict(fields(model[14]))[2].decode()) == card


def evaluated(model: bytes, observation: np.ndarray) -> np.ndarray:
    """The output of an ONNX model's graph, node by node in 64 bits; knows the operators that are written, no others."""
    graph = list(fields(dict(fields(model))[7]))
    values: dict[str, np.ndarray] = {"observation": observation}
    for tensor in (list(fields(value)) for key, value in graph if key == 5):
        facts, shape = dict(tensor), [size for key, size in tensor if key == 1]
        values[facts[8].decode()] = np.frombuffer(facts[9], "<f4").astype(float).reshape(shape)
    for node in (list(fields(value)) for key, value in graph if key == 1):
        a, *rest = (values[name.decode()] for key, name in node if key == 1)
        facts = dict(node)
        integers = {n[1].decode(): n[3] for n in (dict(fields(value)) for key, value in node if key == 5)}
        match facts[4].decode(), rest, integers:
            case "Mul", [b], {}:
                result = a * b
            case "Tanh", [], {}:
                result = np.tanh(a)
            case "Gemm", [b, c], {"transB": 1}:
                result = a @ b.T + c
            case other:
                raise NotImplementedError(other)
        values[facts[2].decode()] = result
    (output,) = (dict(fields(value))[1].decode() for key, value in graph if key == 12)
    return values[output]


@pytest.mark.parametrize("sizes", [(21, 256, 256, 18), (21, 18), (21, 16, 8, 4, 18)])
def test_the_nodes_of_an_onnx_model_calculate_what_the_policy_does(sizes: tuple[int, ...]) -> None:
    mlp = network(sizes)
    mlp = dataclasses.replace(mlp, observation_scale=np.linspace(0.5, 4.0, sizes[0]))
    observation = np.random.default_rng(1).normal(0, 0.3, (50, 21))
    found = evaluated(to_onnx(mlp, Card("level", "balance")), observation)
    np.testing.assert_allclose(found, mlp(observation), atol=1e-6)


def test_an_onnx_model_acts_as_the_policy() -> None:
    reference = pytest.importorskip("onnx.reference", reason="needs the onnx library, which tcbi itself does not")
    checker = pytest.importorskip("onnx.checker")
    data = to_onnx(network(), Card("level", "balance"))
    checker.check_model(data, full_check=True)
    observation = np.random.default_rng(1).normal(0, 0.3, (50, 21)).astype(np.float32)
    (action,) = reference.ReferenceEvaluator(data).run(None, {"observation": observation})
    np.testing.assert_allclose(action, network()(observation), atol=1e-6)


def test_event_files_hold_the_scalars_behind_checksums(tmp_path: Path) -> None:
    assert masked_crc(b"123456789") == ((0xE3069283 >> 15 | 0xE3069283 << 17) + 0xA282EAD8) & 0xFFFFFFFF
    events = EventFile(tmp_path / "logs")
    events.add(7, {"evaluation/mean_return": 512.5})
    events.write({"train/loss": 0.25, "train/approx_kl": np.float32(0.5), "time/name": "text"}, {}, 8)
    (file,) = (tmp_path / "logs").iterdir()
    data, found, steps = file.read_bytes(), {}, []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        record, rest = data[12 : 12 + length], data[12 + length :]
        assert struct.unpack("<I", data[8:12])[0] == masked_crc(data[:8])
        assert struct.unpack("<I", rest[:4])[0] == masked_crc(record)
        data, event = rest[4:], dict(fields(record))
        if 5 in event:
            steps.append(event[2])
            for _, each in fields(event[5]):
                value = dict(fields(each))
                found[value[1].decode()] = struct.unpack("<f", value[2])[0]
    assert found == {"evaluation/mean_return": 512.5, "train/loss": 0.25, "train/approx_kl": 0.5} and steps == [7, 8]
