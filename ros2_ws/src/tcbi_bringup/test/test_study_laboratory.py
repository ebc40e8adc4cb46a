"""What a study works with: processes that die or are interrupted, and a folder that it cannot have."""

import os
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from tcbi_bringup.errors import BringupError
from tcbi_bringup.study.notebook import hold
from tcbi_bringup.study.robots import Laboratory, Order


def test_a_laboratory_whose_process_died_has_new_ones() -> None:
    with Laboratory(2) as laboratory:
        with pytest.raises(BrokenProcessPool):
            laboratory.run([DeadlyOrder()])
        assert laboratory.run([]) == []
        assert laboratory._pool.submit(abs, -1).result(60) == 1


class DeadlyOrder(Order):
    """Ends the process that unpickles it."""

    def __init__(self) -> None:
        pass

    def __reduce__(self):
        return os._exit, (1,)


def test_an_interrupt_does_not_wait_for_the_rollouts_at_work() -> None:
    with pytest.raises(KeyboardInterrupt), Laboratory(2) as laboratory:
        assert laboratory._pool.submit(abs, -1).result(60) == 1
        laboratory._pool.submit(time.sleep, 200.0)
        began = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - began < 60.0


def test_a_folder_that_cannot_be_made_is_refused_with_a_remedy() -> None:
    with (
        pytest.raises(BringupError, match="no study can be kept there"),
        hold(Path("/proc/study")),
    ):
        pass
