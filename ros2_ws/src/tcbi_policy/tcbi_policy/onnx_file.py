"""A policy as an ONNX model (opset 17): `observation` (batch, n) rad -> `action` (batch, J) rad, joint targets.

    path.write_bytes(to_onnx(policy.mlp, policy.card))

Scaling and limit are in the graph, so that whoever runs it needs nothing else; the card travels in the metadata, under
the key `card`. Written as bytes after onnx.proto, without the onnx library.
"""

import numpy as np

from tcbi_policy.artefact import Card
from tcbi_policy.mlp import Mlp
from tcbi_policy.protobuf import nested, number, text

IR_VERSION, OPSET = 8, 17
FLOAT, INT = 1, 2  # TensorProto.FLOAT; AttributeProto.INT


def to_onnx(mlp: Mlp, card: Card) -> bytes:
    """The model as the bytes of an .onnx file."""
    graph = b"".join(nested(1, node) for node in _nodes(len(mlp.weights)))
    graph += text(2, card.name) + b"".join(nested(5, tensor) for tensor in _tensors(mlp))
    graph += nested(11, _value("observation", len(mlp.observation_scale)))
    graph += nested(12, _value("action", len(mlp.biases[-1])))
    model = number(1, IR_VERSION) + text(2, "tcbi") + text(6, f"policy {card.name} for the task {card.task}")
    model += nested(7, graph) + nested(8, number(2, OPSET))
    return model + nested(14, text(1, "card") + text(2, card.to_json()))


def _nodes(layers: int) -> list[bytes]:
    nodes = [_node("Mul", ("observation", "observation_scale"), "hidden0")]
    for k in range(layers):
        nodes.append(_node("Gemm", (f"hidden{k}", f"layer{k}.weight", f"layer{k}.bias"), f"sum{k}", transB=1))
        nodes.append(_node("Tanh", (f"sum{k}",), f"hidden{k + 1}"))
    return [*nodes, _node("Mul", (f"hidden{layers}", "limit"), "action")]


def _node(kind: str, inputs: tuple[str, ...], output: str, **integers: int) -> bytes:
    attributes = (text(1, name) + number(3, value) + number(20, INT) for name, value in integers.items())
    parts = [*(text(1, name) for name in inputs), text(2, output), text(4, kind)]
    return b"".join(parts) + b"".join(nested(5, a) for a in attributes)


def _tensors(mlp: Mlp) -> list[bytes]:
    arrays = {**mlp.tensors(), "limit": np.array(mlp.limit, np.float32)}
    return [
        b"".join(number(1, size) for size in array.shape)
        + number(2, FLOAT)
        + text(8, name)
        + nested(9, np.ascontiguousarray(array, "<f4").tobytes())
        for name, array in arrays.items()
    ]


def _value(name: str, width: int) -> bytes:
    """Name and type of the input or output: float32 of any number of rows."""
    shape = nested(1, text(2, "batch")) + nested(1, number(1, width))
    return text(1, name) + nested(2, nested(1, number(1, FLOAT) + nested(2, shape)))
