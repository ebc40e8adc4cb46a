"""From rollouts to a posterior: recovery on a servo bench, same bits at any thread count, resuming, bad input named."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from tcbi_cases import BENCH_TRUTH, bench_rollouts

from tcbi_infer import posterior, statistics
from tcbi_infer.divergence import DIVERGENCES
from tcbi_infer.errors import InferError, SettingError
from tcbi_infer.statistics import Statistic
from tcbi_infer.tcbi import checkpoint, driver
from tcbi_infer.tcbi.channels import LEAST_SAMPLES
from tcbi_infer.tcbi.driver import BOUNDS, Interrupted, Progress, infer, settings_of
from tcbi_infer.tcbi.features import Features
from tcbi_infer.tcbi.method import METHODS
from tcbi_infer.tcbi.problem import LOOKED_AT, Problem
from tcbi_infer.tcbi.result import Result
from tcbi_infer.tcbi.run_name import run_name
from tcbi_sim.engine import Simulator
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.model import Model
from tcbi_sim.store import ModelStore

SMALL = {"particles": 20, "generations": 3}


@pytest.fixture(scope="module")
def bench():
    return bench_rollouts()


@pytest.fixture(scope="module")
def problem(bench) -> Problem:
    return Problem.of(*bench, timestep=0.01)


@pytest.fixture(scope="module")
def result(problem: Problem) -> Result:
    return infer(problem, "calibrated", seed=1, particles=30, generations=4)


def test_covers_known_parameters_and_finds_the_gain(result: Result) -> None:
    """All three within two standard deviations: false alarm 14 % over seeds; this seed is fixed."""
    weights = np.exp(result.log_weights)
    mean = weights @ result.unit
    sd = np.sqrt(weights @ (result.unit - mean) ** 2)
    assert np.all(np.abs(mean - BENCH_TRUTH) < 2 * sd)
    gain = result.estimates[0]
    assert gain.name == "gain" and gain.identified
    assert gain.low90 <= float(result.model.from_unit(np.array(BENCH_TRUTH))[0]) <= gain.high90
    assert sd[0] < 0.15


@pytest.mark.parametrize("delay", [0.04, 0.11])
def test_finds_the_size_of_an_effect_that_was_added(delay: float) -> None:
    """An exact 90 % interval misses the truth in one of ten, and on which seeds the processor's rounding decides."""
    model, measurements = bench_rollouts((*BENCH_TRUTH, delay / 0.15), count=12, effects=("command_latency",))
    found = infer(Problem.of(model, measurements, timestep=0.005), seed=0, particles=100, generations=8).estimates[-1]
    assert found.name == "command_latency.delay" and found.identified
    assert abs(found.mean - delay) < 2.5 * found.sd
    assert found.high90 - found.low90 < 0.4 * 0.15, "of its prior"


def test_statistics_that_the_rig_lacks_are_named(result: Result) -> None:
    text = " ".join(result.warnings)
    assert "statistic attitude left out" in text and "statistic contact_ratio left out" in text
    assert "body_motion left out" in text and result.statistics == ("joint_tracking", "early_response", "joint_motion")


def test_same_bits_for_any_number_of_threads_and_any_company(bench) -> None:
    unit = np.random.default_rng(0).random((LOOKED_AT + 3, 3))
    one, two = (Problem.of(*bench, timestep=0.01, threads=n) for n in (1, 2))
    a, b = one.simulate(unit), two.simulate(unit)
    assert all(
        np.array_equal(x, y, equal_nan=True)
        for x, y in zip((*a[:-1], *a.differences), (*b[:-1], *b.differences), strict=True)
    )
    alone = one.simulate(unit[-2:-1])
    assert np.array_equal(alone.counts[0], a.counts[-2])
    assert np.array_equal(alone.differences.sketch[0], a.differences.sketch[-2])


def test_the_same_seed_gives_the_same_posterior(problem: Problem) -> None:
    first, second = (infer(problem, "paper", seed=4, **SMALL) for _ in range(2))
    other = infer(problem, "paper", seed=5, **SMALL)
    assert np.array_equal(first.unit, second.unit) and np.array_equal(first.log_weights, second.log_weights)
    assert not np.array_equal(first.unit, other.unit)


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"prior"}))
def test_an_interrupted_inference_goes_on_to_the_same_result(problem: Problem, method: str, tmp_path: Path) -> None:
    if method == "bayesopt":
        pytest.importorskip("optuna")

    def interrupt(progress: Progress) -> None:
        if progress.generation == 3 and progress.share == 0:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="goes on from the last whole generation"):
        infer(problem, method, seed=2, folder=tmp_path, watch=interrupt, **SMALL)
    assert list(tmp_path.glob("*/state.npz"))
    resumed = infer(problem, method, seed=2, folder=tmp_path, **SMALL)
    through = infer(problem, method, seed=2, **SMALL)
    assert any("resumed" in line for line in resumed.warnings)
    assert np.array_equal(resumed.unit, through.unit) and np.array_equal(resumed.log_weights, through.log_weights)
    assert len(resumed.generations) == 3
    assert list(tmp_path.glob("*/state.npz")), "who is interrupted while it is saved loses nothing"
    posterior.save(ModelStore(tmp_path / "store"), resumed)
    assert not list(tmp_path.glob("*/state.npz"))


def test_a_resumed_inference_counts_the_seconds_of_all_its_generations(problem: Problem, tmp_path: Path) -> None:
    def interrupt(progress: Progress) -> None:
        if progress.generation == 3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted):
        infer(problem, "paper", seed=2, folder=tmp_path, watch=interrupt, **SMALL)
    (file,) = tmp_path.glob("*/generations.json")
    history = json.loads(file.read_text())
    history[0]["wall_s"] = 1000.0  # an earlier process that took long
    file.write_text(json.dumps([*history, history[-1]]))  # killed before the state that belongs to it was kept
    result = infer(problem, "paper", seed=2, folder=tmp_path, **SMALL)
    assert [g["generation"] for g in result.generations] == [1, 2, 3]
    assert result.seconds == sum(g["wall_s"] for g in result.generations) > 1000.0


def test_what_an_inference_goes_on_from_is_known_by_the_rollouts_content_and_ones_own_files(
    problem: Problem, bench, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv("TCBI_STATISTICS", str(tmp_path))
    method = METHODS["paper"]

    def name(p: Problem) -> str:
        return run_name(p, "paper", method.settings(), 0)

    before, (model, measurements) = name(problem), bench
    assert name(Problem.of(model, measurements, timestep=0.01)) == before
    repaired = measurements[0].joint_position.copy()
    repaired[5] += 1e-9
    other = [dataclasses.replace(measurements[0], joint_position=repaired), *measurements[1:]]
    assert name(Problem.of(model, other, timestep=0.01)) != before
    stiffer = dataclasses.replace(model, joint_gains=(1.1,))
    assert name(Problem.of(stiffer, measurements, timestep=0.01)) != before
    wider = dataclasses.replace(model.parameters[0], high=2 * model.parameters[0].high)
    widened = dataclasses.replace(model, parameters=(wider, *model.parameters[1:]))
    assert name(Problem.of(widened, measurements, timestep=0.01)) != before, "as a warning advises"
    (tmp_path / "mine.py").write_text("STATISTIC = 1")
    assert name(problem) != before


def test_two_processes_keep_the_same_inference_under_temporary_names_of_their_own(
    problem: Problem, tmp_path: Path, monkeypatch
) -> None:
    written: list[Path] = []
    replace = Path.replace
    monkeypatch.setattr(Path, "replace", lambda path, to: (written.append(path), replace(path, to))[1])
    infer(problem, "paper", folder=tmp_path, **SMALL)
    assert len(written) == len(set(written)) == 6


def test_an_inference_that_is_killed_within_a_generation_goes_on_to_the_same_bits(
    problem: Problem, tmp_path: Path
) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path; from tcbi_cases import bench_rollouts\n"
        "from tcbi_infer.tcbi.driver import infer; from tcbi_infer.tcbi.problem import Problem\n"
        "kill = lambda p: os.kill(os.getpid(), signal.SIGKILL) if p.generation == 3 and p.share > 0 else None\n"
        "infer(Problem.of(*bench_rollouts(), timestep=0.01), seed=2, folder=Path(sys.argv[1]), watch=kill, "
        "particles=20, generations=3)\n"
    )
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", script, tmp_path], env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    resumed = infer(problem, seed=2, folder=tmp_path, **SMALL)
    through = infer(problem, seed=2, **SMALL)
    assert any("resumed" in line for line in resumed.warnings)
    assert np.array_equal(resumed.unit, through.unit) and np.array_equal(resumed.log_weights, through.log_weights)


def test_a_damaged_state_is_not_used_and_that_is_told(problem: Problem, tmp_path: Path) -> None:
    infer(problem, "paper", folder=tmp_path, **SMALL)
    (state,) = tmp_path.rglob("state.npz")
    state.write_bytes(b"PK\x03\x04 cut off")
    assert checkpoint.load(state, METHODS["paper"].state_type) is None
    again = infer(problem, "paper", folder=tmp_path, **SMALL)
    assert any("cannot be read: the inference started over" in line for line in again.warnings)


def test_the_posterior_opens_in_arviz_and_becomes_a_model_version(result: Result, tmp_path: Path) -> None:
    store = ModelStore(tmp_path)
    saved = posterior.save(store, result)
    path = store.models / saved.version / "posterior.nc"
    assert saved.parent == "servo_bench-v0"
    again = store.load(saved.version)
    assert np.allclose(again.particles, result.particles)
    assert again.evidence["inference"]["rollouts"] == list(result.rollouts)
    assert again.evidence["inference"]["prior"] == "flat"
    import arviz

    data = arviz.from_netcdf(path)
    assert set(arviz.summary(data, kind="stats").index) == {"gain", "damping", "friction"}
    arviz.plot_pair(data, var_names=["gain", "friction"])
    plt.close("all")
    assert set(data["posterior"].data_vars) == {"gain", "damping", "friction"}
    mean = float(np.exp(result.log_weights) @ result.particles[:, 0])
    assert float(data["posterior"]["gain"].mean()) == pytest.approx(mean, rel=0.05)
    with xr.open_dataset(path, group="generations") as rows:
        assert rows.sizes == {"generation": len(result.generations), "parameter": 3, "statistic": 3}


@pytest.fixture(scope="module")
def excluding(bench) -> Problem:
    """A prior without the gain of the rollouts."""
    model, measurements = bench
    low, high = model.parameters[0].low, model.parameters[0].high
    middle = low * (high / low) ** 0.3  # the truth lies at 0.45
    narrowed = dataclasses.replace(model.parameters[0], high=middle, nominal=low * 1.01)
    particles = model.particles.copy()
    particles[:, 0] = np.clip(particles[:, 0], low, middle)
    wrong = dataclasses.replace(model, parameters=(narrowed, *model.parameters[1:]), particles=particles)
    return Problem.of(wrong, measurements, timestep=0.01)


def test_a_prior_that_excludes_the_data_is_named_and_the_model_believed_less(excluding: Problem, monkeypatch) -> None:
    found = infer(excluding, seed=0, particles=60, generations=5)
    assert any("prior of gain seems to exclude the data" in line for line in found.warnings)
    assert not found.fits and not any(e.identified for e in found.estimates)
    judged = driver.goodness_of_fit
    monkeypatch.setattr(driver, "goodness_of_fit", lambda *args: judged(*args)._replace(distrust=1.0))
    believed = infer(excluding, seed=0, particles=60, generations=5)
    spreads = [np.exp(r.log_weights) @ (r.unit - np.exp(r.log_weights) @ r.unit) ** 2 for r in (found, believed)]
    assert np.all(spreads[0] > spreads[1])
    for result in (found, believed):
        mean = np.exp(result.log_weights) @ result.particles
        np.testing.assert_allclose(result.generations[-1]["mean"], mean, err_msg="the curves end at the posterior")


def test_of_a_model_that_is_called_wrong_no_more_generations_are_asked_for(
    excluding: Problem, problem: Problem, monkeypatch
) -> None:
    monkeypatch.setattr(driver, "unfinished", lambda last: ["more generations narrow it"])
    for given, fits in ((excluding, False), (problem, True)):
        found = infer(given, seed=0, particles=40, generations=2)
        assert found.fits is fits and not found.converged
        assert ("more generations narrow it" in found.warnings) == fits


def test_channels_with_too_few_samples_to_tell_anything_are_named_and_left_out(bench, monkeypatch) -> None:
    def sparse(known: int) -> Statistic:
        """One sample in each of so many rollouts."""

        def compute(arrays: Any) -> np.ndarray:
            values = np.full((*arrays.count, 1, 9), np.nan)
            values[:, :known, 0, 0] = arrays.joint_position[:, :known, -1, 0]
            return values

        return Statistic(f"last_of_{known}", "rad", "the last position", (), lambda a: ("x",), compute)

    few, enough = sparse(LEAST_SAMPLES - 1), sparse(LEAST_SAMPLES)
    known = {**statistics.library(), few.name: few, enough.name: enough}
    monkeypatch.setattr(statistics, "library", lambda: known)
    with pytest.raises(InferError, match=rf"no statistic has {LEAST_SAMPLES} finite samples .*tried: {few.name}"):
        Problem.of(*bench, statistics=(few.name,), timestep=0.01)
    problem = Problem.of(*bench, statistics=("joint_tracking", few.name, enough.name), timestep=0.01)
    (line,) = (line for line in problem.warnings if f"with fewer than {LEAST_SAMPLES} samples, left out" in line)
    assert line.endswith(f": {few.name}/x ({LEAST_SAMPLES - 1} samples)") and "longer rollouts" in line
    assert f"{enough.name}/x" in problem.observed.channels


def test_unknown_names_are_refused(problem: Problem, bench) -> None:
    with pytest.raises(UnknownNameError, match="unknown method 'abc'"):
        infer(problem, "abc")
    with pytest.raises(UnknownNameError, match="unknown statistic"):
        Problem.of(*bench, statistics=("speed",))
    with pytest.raises(UnknownNameError, match="unknown divergence"):
        Problem.of(*bench, divergence_name="kl")
    with pytest.raises(UnknownNameError, match="unknown setting of method paper 'alhpa'; did you mean 'alpha'"):
        infer(problem, "paper", alhpa=5.0)


@pytest.mark.parametrize("value", [-1.0, 0.0, 2.5, math.nan, math.inf])
@pytest.mark.parametrize("name", ["particles", "generations"])
def test_a_budget_that_is_no_number_of_simulations_is_refused(name: str, value: float) -> None:
    with pytest.raises(SettingError, match=f"{name}: got {value}, allowed is a whole number"):
        settings_of(METHODS["paper"], {name: value})


def test_settings_are_of_their_defaults_kind_and_within_their_bounds() -> None:
    assert settings_of(METHODS["paper"], {"particles": 20.0, "alpha": 5.0})[:3] == (20, 15, 5.0)
    assert {name for method in METHODS.values() for name in method.settings._fields} >= set(BOUNDS)
    for method, name, value in (("calibrated", "prior_share", 1.1), ("simopt", "least_temperature", 0.0)):
        with pytest.raises(SettingError, match=name):
            settings_of(METHODS[method], {name: value})


def test_every_divergence_ranks_the_truth_before_a_wrong_gain(bench) -> None:
    unit = np.array([BENCH_TRUTH, (0.9, *BENCH_TRUTH[1:])])
    for name in ("js", "js_nearest", "wasserstein"):
        problem = Problem.of(*bench, divergence_name=name, timestep=0.01)
        right, wrong = problem.observed.by_statistic(problem.simulate(unit).divergence).sum(axis=1)
        assert right < wrong


@pytest.mark.parametrize("divergence", sorted(DIVERGENCES))
def test_a_statistic_that_is_the_same_in_every_sample_is_named(divergence: str, bench, monkeypatch) -> None:
    frozen = Statistic("frozen", "1", "a dead sensor", (), lambda a: ("x",), lambda a: np.full((*a.count, 1, 9), 3.0))
    known = {**statistics.library(), "frozen": frozen}
    monkeypatch.setattr(statistics, "library", lambda: known)
    problem = Problem.of(*bench, statistics=("joint_tracking", "frozen"), divergence_name=divergence, timestep=0.01)
    assert (
        "the same in every sample, so it tells little (a dead sensor, or a joint that never moved): frozen/x (3)"
        in problem.warnings
    )
    result = infer(problem, seed=0, particles=20, generations=2)
    assert np.isfinite(result.unit).all() and result.ess > 1
    assert np.isfinite(list(result.generations[-1]["misfit"].values())).all()


def test_a_statistic_of_which_nearly_all_samples_lie_in_one_bin_is_named(bench, monkeypatch) -> None:
    def rare(arrays: Any) -> np.ndarray:
        return np.where(np.arange(100) < 5, 0.0, np.full((*arrays.count, 1, 100), 1.0))

    crowded = Statistic("crowded", "1", "nearly constant", (), lambda a: ("x",), rare)
    monkeypatch.setattr(statistics, "library", lambda: {"crowded": crowded})
    problem = Problem.of(*bench, statistics=("crowded",), timestep=0.01)
    assert "nearly all samples lie in one of 20 bins, so it tells little: crowded/x (95.0%)" in problem.warnings


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"prior", "bayesopt", "npe"}))
def test_simulations_that_diverge_leave_every_method_a_finite_posterior(problem: Problem, method: str) -> None:
    """A third of the particles, those of the highest gain, diverge."""

    class Unstable:
        def __getattr__(self, name):
            return getattr(problem, name)

        def simulate(self, cube, progress=None, view=None):
            seen, lost = problem.simulate(cube, progress, view), cube[:, 0] >= 0.67
            if isinstance(seen, Features):
                for part in (seen.divergence, *seen.differences):
                    part[lost] = np.nan
            return seen._replace(valid=seen.valid & ~lost)

    result = infer(Unstable(), method, seed=0, particles=20, generations=2)  # type: ignore[arg-type]
    weights = np.exp(result.log_weights)
    assert np.isfinite(weights @ result.unit).all() and np.isfinite(result.generations[-1]["divergence"]).all()
    if method != "simopt":  # whose posterior is a Gaussian fitted to the others
        assert weights[result.unit[:, 0] >= 0.67].sum() < 1e-6


def test_physics_that_ends_in_no_number_costs_those_particles_alone(bench, monkeypatch) -> None:
    """Of stiff servos what is not finite comes out of MuJoCo itself."""
    model, measurements = bench
    begin, limit = Simulator.__init__, float(model.parameters[0].from_unit(0.67))

    def spoilt(simulator: Simulator, model: Model, values: np.ndarray, *args: Any, **more: Any) -> None:
        begin(simulator, model, values, *args, **more)
        simulator._batch.bind("qvel")[values[:, 0] > limit] = 1e12

    monkeypatch.setattr(Simulator, "__init__", spoilt)
    result = infer(Problem.of(model, measurements, timestep=0.01), particles=30, generations=3)
    lost = result.particles[:, 0] > limit
    assert sum(g["diverged"] for g in result.generations) >= 3
    assert any("diverged in a rollout" in line for line in result.warnings)
    assert not lost.any() and np.isfinite(np.exp(result.log_weights) @ result.unit).all()


def test_how_many_particles_diverged_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    simulate = Problem.simulate

    def every_fourth_lost(self: Problem, *args, **more):
        seen = simulate(self, *args, **more)
        seen.valid[::4] = False
        return seen

    monkeypatch.setattr(Problem, "simulate", every_fourth_lost)
    result = infer(Problem.of(*bench_rollouts(count=4), timestep=0.01), "calibrated", particles=16, generations=2)
    assert any("particles diverged in a rollout and weigh nothing" in line for line in result.warnings)
    assert sum("8 of 32 particles" in line for line in result.warnings) == 1
