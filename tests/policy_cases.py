"""What the tests of the policy node and of the retrain node share."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tcbi_bringup.launcher import NodeProcess
from tests.conftest import ros_in_process


def wait_until(holds: Callable[[], bool], meanwhile: Callable[[], object] = lambda: time.sleep(0.01)) -> None:
    deadline = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < deadline, "did not come to hold within 20 s"
        meanwhile()


def policy_node(**parameters: Any) -> NodeProcess:
    return NodeProcess("tcbi_policy", "policy_node", parameters=parameters)


@pytest.fixture
def own_process(domain: int, tmp_path: Any) -> Iterator[None]:
    """For a node in the process of the test, which replaces a part of it."""
    with ros_in_process(["--ros-args", "-p", f"store:={tmp_path / 'store'}"]):
        yield
