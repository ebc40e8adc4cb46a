"""Chunks on a Ray cluster of this machine: the same bits, also when workers are killed; a clean end."""

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import psutil
import pytest

from tcbi_sim import ray_workers
from tcbi_sim.engine import simulate
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.sensing import Samples
from tcbi_sim.workers import Here, WorkersError, using, workers

if importlib.util.find_spec("ray") is None:
    pytest.skip("ray is not installed; requirements-ray.in installs this optional extra", allow_module_level=True)

SCENARIOS = [Scenario("balance", 1.0, 0.1 * s, -0.05 * s, seed=s) for s in range(3)]
COMMANDS = [Commands(np.arange(5) * 0.2, np.random.default_rng(s).uniform(-0.3, 0.3, (5, 18))) for s in range(3)]
OWN = """
from tcbi_sim.effect import Effect
from tcbi_sim.parameter import Parameter

def apply(fields, rig, site, p):
    fields.model["dof_damping"][:, fields.dofs()] += p["drag"][:, None]

EFFECT = Effect("tar", "Old grease that has become thick like tar and brakes every joint in proportion to its speed.",
                "a drawer", (Parameter("drag", "N m s/rad", 0.0, 0.5, 0.1, 0.0, description="torque by speed"),), apply)
"""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        home = tmp_path_factory.mktemp("home")
        patch.setenv("HOME", str(home))
        with ray_workers.cluster("") as them:
            assert not list(home.iterdir()), "nothing is left in the user's home"
            yield them


class Steady:
    """A closed loop; the first worker to reach half a second is killed, unless there is the file that says it was."""

    def __init__(self, killed: Path):
        self.killed = killed

    def reset(self, count, rng):
        self.dice = rng.normal(0.0, 0.05, (count, 18))

    def act(self, time, observation):
        if time >= 0.5 and not self.killed.exists():
            self.killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.dice - 0.3 * observation[:, :18]


def assert_the_same(a, b):
    for name in (*Samples.names(), "time", "command_time", "commands_given", "diverged", "duration"):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name == "commands_given"), name


@pytest.mark.parametrize("pairing", ["product", "zip"])
def test_a_cluster_gives_the_bits_of_this_process(cluster, pairing, monkeypatch):
    monkeypatch.setattr("tcbi_sim.workers.LEAST_STEPS", 1)
    model = base_model("hexapod")
    values, told = model.sample(np.random.default_rng(0), 3), []

    def go(progress=None):
        return simulate(
            model, values, SCENARIOS, commands=COMMANDS, pairing=pairing, timestep=0.01, progress=progress
        )  # fmt: skip

    here = go()
    with using(cluster):
        there = go(told.append)
    assert_the_same(here, there)
    assert told[-1] == 1.0 and len(told) > 2 and told == sorted(told)
    there.joint_position += 1.0  # its arrays are one's own


def test_a_killed_worker_costs_its_chunk_and_nothing_else(cluster, tmp_path):
    model, killed = base_model("hexapod"), tmp_path / "killed"
    values = model.sample(np.random.default_rng(0), 4)

    def go():
        return simulate(model, values, SCENARIOS, controller=Steady(killed), timestep=0.01, chunk=3)

    with using(cluster):
        there = go()
    assert killed.exists()
    assert_the_same(go(), there)


def test_an_effect_of_ones_own_reaches_the_workers(cluster, tmp_path, monkeypatch):
    monkeypatch.setenv("TCBI_EFFECTS", str(tmp_path))
    (tmp_path / "tar.py").write_text(OWN)
    model = base_model("hexapod").with_effect("tar")
    values = model.sample(np.random.default_rng(0), 2)
    here = simulate(model, values, SCENARIOS, commands=COMMANDS, timestep=0.01)
    with using(ray_workers.RayWorkers(cluster._ray)):
        there = simulate(model, values, SCENARIOS, commands=COMMANDS, timestep=0.01)
    assert_the_same(here, there)


def test_what_cannot_be_simulated_is_said_as_without_a_cluster(cluster):
    model = base_model("hexapod")
    for them in (Here(), cluster):
        with using(them), pytest.raises(SimError, match=r"expected .* friction, mass, gain"):
            simulate(model, model.mean()[None, :2], SCENARIOS, commands=COMMANDS)


def test_an_address_where_nobody_answers_is_said_at_once():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(WorkersError, match=f"nobody answers at {where}.*ray start --head"), workers(f"ray:{where}"):
            pass


def test_an_interrupt_leaves_no_process_behind():
    script = """
        import numpy as np
        from tcbi_sim.engine import simulate
        from tcbi_sim.measurement import Commands, Scenario
        from tcbi_sim.model import base_model
        from tcbi_sim.workers import workers
        model, still = base_model("hexapod"), [Commands(np.zeros(1), np.zeros((1, 18)))]
        with workers("ray"):
            print("ready", flush=True)
            simulate(model, model.sample(np.random.default_rng(0), 4000), [Scenario("balance", 30.0)], commands=still)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        started = psutil.Process(process.pid).children(recursive=True)
        assert started
        os.killpg(process.pid, signal.SIGINT)  # as a terminal's Ctrl-C does
        _, said = process.communicate(timeout=60)
        assert said.rstrip().endswith("KeyboardInterrupt")
        _, alive = psutil.wait_procs(started, timeout=30)
        assert not alive
    finally:
        process.kill()
