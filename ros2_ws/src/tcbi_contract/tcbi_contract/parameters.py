"""Node parameters from one frozen dataclass: described, typed, bounded, refused by name at the start; needs ROS."""

import dataclasses
import json
import math
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from tcbi_contract.errors import TcbiError

T = TypeVar("T")


class ParameterError(TcbiError):
    """A node parameter is unknown, of the wrong type, or out of its range."""


def parameter(default: Any, text: str, low: float | None = None, high: float | None = None, choices: tuple = ()) -> Any:
    """A dataclass field that is a node parameter, with its description, range or choices."""
    meta = {"text": text, "low": low, "high": high, "choices": choices}
    if isinstance(default, (list, tuple)):
        return dataclasses.field(default_factory=lambda: list(default), metadata=meta)
    return dataclasses.field(default=default, metadata=meta)


def declare(node: Node, cls: type[T]) -> T:
    """Declare every field of a frozen dataclass as a parameter of `node` and return the values.

    Raises:
      ParameterError: all faults at once: unknown names, wrong types, values out of range.
    """
    faults, values = [], {}
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    given = node._parameter_overrides  # rclpy offers no public view of what the command line gave
    own = ("use_sim_time", "qos_overrides", "start_type_description_service")  # of every node
    unknown = sorted(name for name in set(given) - set(fields) if not name.startswith(own))
    faults += [f"unknown parameter {name!r}; known are {', '.join(fields)}" for name in unknown]
    for name, field in fields.items():
        default = _default(field)
        try:
            values[name] = node.declare_parameter(name, default, _descriptor(field, default)).value
        except (InvalidParameterValueException, InvalidParameterTypeException) as e:
            seen = given[name].value if name in given else default
            faults.append(
                f"parameter {name!r}: got {seen!r}, allowed is {_allowed(field, default)} ({e.__class__.__name__})"
            )
            continue
        choices = field.metadata["choices"]
        if choices and values[name] not in choices:
            faults.append(f"parameter {name!r}: got {values[name]!r}, allowed is {_allowed(field, default)}")
    if faults:
        raise ParameterError("; ".join(faults))
    return cls(**values)


def read_parameter(cls: type, name: str, text: str) -> Any:
    """The value of a parameter from the text of a command line: JSON, but for a string, which is the text itself.

    Raises:
      ParameterError: the dataclass has no such parameter, or the parameter allows no such value.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}
    if name not in fields:
        raise ParameterError(f"unknown parameter {name!r}; known are {', '.join(fields)}")
    field = fields[name]
    default = _default(field)
    value = text if isinstance(default, str) else _from_json(text)
    if isinstance(default, float) and type(value) is int:
        value = float(value)
    if type(value) is not type(default) or not _fits(field, value):
        raise ParameterError(f"parameter {name!r}: got {text!r}, allowed is {_allowed(field, default)}")
    return value


def _from_json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _fits(field: dataclasses.Field, value: Any) -> bool:
    low, high, choices = (field.metadata[key] for key in ("low", "high", "choices"))
    faults = (
        isinstance(value, float) and not math.isfinite(value),
        choices and value not in choices,
        low is not None and value < low,
        high is not None and value > high,
    )
    return not any(faults)


def _default(field: dataclasses.Field) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _allowed(field: dataclasses.Field, default: Any) -> str:
    meta = field.metadata
    if meta["choices"]:
        return "one of " + ", ".join(map(str, meta["choices"]))
    kind = type(default).__name__
    if meta["low"] is None and meta["high"] is None:
        return kind
    low = "" if meta["low"] is None else f" from {meta['low']}"
    high = "" if meta["high"] is None else f" to {meta['high']}"
    return kind + low + high


def _descriptor(field: dataclasses.Field, default: Any) -> ParameterDescriptor:
    meta = field.metadata
    descriptor = ParameterDescriptor(description=meta["text"], read_only=True)
    if meta["low"] is not None or meta["high"] is not None:
        low, high = meta["low"], meta["high"]
        if isinstance(default, float):
            low = -1e308 if low is None else float(low)
            high = 1e308 if high is None else float(high)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            low = -(2**62) if low is None else int(low)
            high = 2**62 if high is None else int(high)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor


def parameter_table(cls: type) -> list[tuple[str, str, str, str]]:
    """(name, default, allowed, description) of each parameter, for the documentation."""
    rows = []
    for field in dataclasses.fields(cls):
        default = _default(field)
        rows.append((field.name, repr(default), _allowed(field, default), field.metadata["text"]))
    return rows
