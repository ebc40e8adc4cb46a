"""Wherever chunks are worked on: the same bits, plain faults. What needs Ray is in test_ray_workers.py."""

import dataclasses
import sys

import numpy as np
import pytest

from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Block, Commands, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.ray_workers import OWN_FILES, _apart, versions
from tcbi_sim.sensing import Samples
from tcbi_sim.workers import MOST_STEPS, Here, WorkersError, address_of, chunk_size, present, using, workers

NEAR = (Block((0.12, 0.0, 0.01), (0.4, 0.5, 0.02), 0.3), Block((0.6, 0.2, 0.01), (0.2, 0.2, 0.02), 0.0))


class Several(Here):
    """As many at a time as a cluster, but here."""

    def __init__(self, processors: int):
        super().__init__(1, processors)


class Dither:
    """A closed loop with dice of its own."""

    def reset(self, count, rng):
        self.dice = rng.normal(0.0, 0.05, (count, 18))

    def act(self, time, observation):
        return self.dice + 0.2 * np.sin(3 * time + np.arange(18)) - 0.3 * observation[:, :18]


def commands(seed: int, ramp: float = 0.2) -> Commands:
    rng = np.random.default_rng(seed)
    return Commands(np.arange(5) * 0.2 + 0.03 * seed, rng.uniform(-0.3, 0.3, (5, 18)), ramp)


def arrays(out) -> dict[str, np.ndarray]:
    names = (*Samples.names(), "time", "command_time", "commands_given", "diverged", "duration")
    return {name: np.asarray(getattr(out, name)) for name in names}


def the_same(a, b) -> bool:
    mine, other = arrays(a), arrays(b)
    return all(np.array_equal(mine[name], other[name], equal_nan=mine[name].dtype == float) for name in mine)


TILTED = [Scenario("balance", 1.0, 0.1 * s, -0.05 * s, seed=s) for s in range(3)]
BLOCKS = [dataclasses.replace(s, blocks=NEAR[:k]) for k, s in enumerate(TILTED)]
LENGTHS = [dataclasses.replace(s, duration=1.0 + 0.2 * k, settle=0.5 * k) for k, s in enumerate(TILTED)]
RAMPS = [commands(s, 0.1 * s) for s in range(3)]
STREAMS = [commands(s) for s in range(3)]


@pytest.mark.parametrize("case", ["tilted", "blocks", "lengths", "ramps", "zip", "closed"])
def test_however_many_work_the_bits_are_those_of_one(case, monkeypatch):
    monkeypatch.setattr("tcbi_sim.workers.LEAST_STEPS", 1)
    model = base_model("hexapod").with_effect("backlash")
    values = model.sample(np.random.default_rng(0), 3)
    scenarios = {"blocks": BLOCKS, "lengths": LENGTHS}.get(case, TILTED)
    given = {"commands": RAMPS if case == "ramps" else STREAMS} if case != "closed" else {"controller": Dither()}
    pairing = "zip" if case == "zip" else "product"

    def go():
        return simulate(model, values, scenarios, **given, pairing=pairing, timestep=0.01)

    alone = go()
    with using(Several(4)):
        assert the_same(go(), alone)


def test_chunks_suit_the_workers_and_are_never_larger_than_one_process_would_take():
    assert chunk_size(1000, 300, 512) == 512, "this process: what memory holds"
    with using(Several(2)):
        assert chunk_size(1000, 300, 512) == 125, "four for each processor"
        assert chunk_size(70, 300, 512) == 35, "no crumbs"
        assert chunk_size(3, 300, 512) == 3, "too little to share"
        assert chunk_size(10**6, 300, 512) == 512
        assert chunk_size(10**6, 3100, 512) * 3100 <= MOST_STEPS
        assert chunk_size(10, 10**6, 512) == 1


def test_chunks_come_back_in_order_with_their_progress():
    told = []
    assert Here().map(str, [3, 1, 2], told.append) == ["3", "1", "2"]
    assert told == [1 / 3, 2 / 3, 1.0]


@pytest.mark.parametrize("where", ["rubbish", "ray:", "ray:host", "ray:host:port", "ray://host:1", "Ray"])
def test_workers_that_are_none_are_named_with_what_is_allowed(where):
    with pytest.raises(WorkersError, match="allowed is ray"), workers(where):
        pass


def test_addresses_are_understood():
    assert [address_of(w) for w in ("ray", "ray:auto", "ray:head:6379")] == ["", "auto", "head:6379"]


def test_without_ray_the_command_that_installs_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(WorkersError, match=r"optional extra.*requirements-ray\.in"), workers("ray"):
        pass
    assert present() == Here()


def test_a_machine_with_other_files_says_what_differs():
    own = versions()
    assert _apart(tuple(own.items())) == ""
    said = _apart(tuple({**own, "numpy": "0.1"}.items()))
    assert f"differs in numpy ({np.__version__} there, 0.1 here)" in said and "docs/scale.md" in said


@pytest.mark.parametrize("kind", ["effects", "rigs", "tasks", "statistics", "divergences"])
@pytest.mark.parametrize("named", [True, False])
def test_the_users_own_files_are_among_what_must_be_the_same(tmp_path, monkeypatch, kind, named):
    monkeypatch.setenv("TCBI_STORE", str(tmp_path))
    folder = tmp_path / ("mine" if named else kind)
    folder.mkdir()
    if named:
        monkeypatch.setenv(f"TCBI_{kind.upper()}", str(folder))
    before = versions()
    (folder / "mine.py").write_text("EFFECT = 1")
    after = versions()
    assert {name for name in after if after[name] != before[name]} == {OWN_FILES}
    assert kind in OWN_FILES
