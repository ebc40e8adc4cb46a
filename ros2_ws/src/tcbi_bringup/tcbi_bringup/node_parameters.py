"""What `./tcbi up --set NODE.PARAMETER=VALUE` gives nodes, held against what they declare before anything starts.

given = given_parameters([Setting("inference_node", "posterior_moved", "1")], processes)
given["inference_node"]["posterior_moved"]  # 1.0
"""

import dataclasses
import importlib
from collections.abc import Iterable
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from tcbi_bringup.errors import WrongCallError
from tcbi_bringup.launcher import NodeProcess
from tcbi_contract.parameters import ParameterError, read_parameter


class Setting(NamedTuple):
    """One parameter of one node, as a command line gives it."""

    node: str
    parameter: str
    text: str


def given_parameters(settings: Iterable[Setting], processes: Iterable[NodeProcess]) -> dict[str, dict[str, Any]]:
    """Values by node and parameter; of two for the same one, the later.

    Raises:
      WrongCallError: no such node is started, it has no such parameter, or the parameter allows no such value.
    """
    nodes = {process.key: process for process in processes if process.ros}
    values: dict[str, dict[str, Any]] = {}
    for setting in settings:
        if setting.node not in nodes:
            raise WrongCallError(f"--set: got node {setting.node!r}, allowed are those that start: {', '.join(nodes)}")
        try:
            value = read_parameter(parameter_class(nodes[setting.node]), setting.parameter, setting.text)
        except ParameterError as error:
            raise WrongCallError(f"--set: {setting.node}: {error}; docs/parameters.md explains them") from error
        values.setdefault(setting.node, {})[setting.parameter] = value
    return values


def parameter_class(process: NodeProcess) -> type:
    """The dataclass of parameters in the module that a process runs."""
    entry = next(e for e in entry_points(group="console_scripts", name=process.executable))
    classes = [c for c in vars(importlib.import_module(entry.module)).values() if isinstance(c, type)]
    return next(c for c in classes if dataclasses.is_dataclass(c) and _declares(c))


def _declares(cls: Any) -> bool:
    fields = dataclasses.fields(cls)
    return bool(fields) and all("text" in field.metadata for field in fields)
