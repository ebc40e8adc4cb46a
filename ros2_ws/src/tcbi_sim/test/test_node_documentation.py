"""docs/sim_node.md lists the nodes' parameters as they are."""

from pathlib import Path

import pytest

from tcbi_contract.parameters import parameter_table
from tcbi_sim.description_node import DescriptionParameters
from tcbi_sim.sim_node import SimParameters

DOCUMENT = Path(__file__).resolve().parents[4] / "docs" / "sim_node.md"


def rows(parameters: type) -> list[str]:
    """The lines of the table of a node's parameters."""
    return [
        f"| `{name}` | `{default}` | {allowed} | {text} |"
        for name, default, allowed, text in parameter_table(parameters)
    ]


@pytest.mark.parametrize("parameters", [SimParameters, DescriptionParameters])
def test_the_table_of_parameters_is_the_nodes_own(parameters):
    assert "\n".join(rows(parameters)) in DOCUMENT.read_text(), "\n".join(rows(parameters))
