"""The methods that TCBI is compared with: each is what its source says, where that can be computed another way."""

import dataclasses
import importlib

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts

from tcbi_infer.baselines import abc_smc, bayesopt, budget, npe, rejection, simopt
from tcbi_infer.baselines.trajectory import Trajectories, distance, observe, trajectories, weights
from tcbi_infer.errors import InferError, MissingExtraError
from tcbi_infer.tcbi import paper
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.features import Features, Observed
from tcbi_infer.tcbi.in_time import no_differences
from tcbi_infer.tcbi.method import METHODS, find_method
from tcbi_infer.tcbi.problem import Problem, Simulated
from tcbi_infer.tcbi.proposal import to_probit
from tcbi_infer.tcbi.weights import mean_and_variance, normalised

REAL = Trajectories(np.zeros((1, 1)), np.zeros((1, 1)), np.array([[0.8]]), np.ones(1, bool))
CENTER = 0.5  # of the simulator below, in probit space


def simulated(unit: np.ndarray) -> Trajectories:
    """Trajectories that lie |z - CENTER| off, and a summary that is z and noise of standard deviation 0.5."""
    z = to_probit(unit)
    off = np.abs(z[:, :1] - CENTER)
    noise = 0.5 * np.random.default_rng(len(z)).standard_normal((len(z), 1))
    return Trajectories(off, off**2, z[:, :1] + noise, np.ones(len(z), bool))


def silent(unit: np.ndarray) -> Trajectories:
    """Trajectories that say nothing about the parameters."""
    off = np.random.default_rng(int(1e6 * unit[0, 0])).random((len(unit), 1))
    return Trajectories(off, off**2, off, np.ones(len(unit), bool))


def diverged(unit: np.ndarray) -> Trajectories:
    return simulated(unit)._replace(valid=np.zeros(len(unit), bool))


def run(module, settings, simulate, state, generations: int, seed: int = 0):
    for t in range(generations):
        state = module.step(np.random.default_rng([seed, t]), state, simulate, settings)
    return state


def test_equation_8_is_the_literal_sum_over_time() -> None:
    model, measurements = bench_rollouts(count=3)
    problem = Problem.of(model, measurements, timestep=0.01)
    unit = np.array([BENCH_TRUTH, (0.9, *BENCH_TRUTH[1:])])
    seen = problem.simulate(unit, view=trajectories)
    keep: list = []

    def raw(problem, simulated):
        keep.append(simulated.readings)
        return trajectories(problem, simulated)

    problem.simulate(unit, view=raw)
    scale = np.array([3.0])
    for n in range(2):
        total = []
        for s in range(3):
            for t in range(len(problem.groups[0].time)):
                simulated_at = keep[0][0].joint_position[n, s, t]
                o = scale * (simulated_at - problem.groups[0].arrays.joint_position[0, s, t])
                total.append(0.5 * np.abs(o).sum() + 1.0 * np.sum(o**2))
        assert distance(seen, scale, 0.5, 1.0)[n] == pytest.approx(np.mean(total))
    assert np.all(observe(problem).absolute == 0)
    assert distance(seen, weights(seen), 0.0, 1.0)[0] < distance(seen, weights(seen), 0.0, 1.0)[1]


def test_rollouts_with_missing_samples_leave_the_summary_of_the_others() -> None:
    """The real rollouts among the simulated ones: their summaries must agree where samples are missing, too."""
    model, whole = bench_rollouts(count=4)
    gap = whole[0].joint_position.copy()
    gap[20:24] = np.nan
    problem, rest = (
        Problem.of(model, m, timestep=0.01)
        for m in ([dataclasses.replace(whole[0], joint_position=gap), *whole[1:]], whole[1:])
    )
    assert observe(problem).summary == pytest.approx(observe(rest).summary)
    measured = [group.arrays for group in Problem.of(model, whole, timestep=0.01).groups]
    assert trajectories(problem, Simulated(measured, measured, np.ones(1, bool))).summary == pytest.approx(
        observe(problem).summary
    )


def test_rejection_keeps_the_nearest_draws_of_the_prior() -> None:
    settings = rejection.RejectionSettings(particles=100, accepted=0.1)
    state = run(rejection, settings, simulated, budget.begin(1, REAL), 3)
    unit, log_weights = rejection.posterior(state, settings)
    kept = np.isfinite(log_weights)
    assert len(unit) == 300 and kept.sum() == 30
    far = np.abs(to_probit(unit)[:, 0] - CENTER)
    assert far[kept].max() <= far[~kept].min()


def test_sequential_abc_keeps_the_prior_where_nothing_is_learnt() -> None:
    """Weights undo the kernel: variance 1 and mean 0 in probit space. Over ten seeds, four standard errors."""
    settings = abc_smc.AbcSmcSettings(particles=400, kept=0.5, least_accepted=0.0)
    moments = []
    for seed in range(10):
        state = run(abc_smc, settings, silent, abc_smc.begin(1, REAL), 5, seed)
        mean, variance = mean_and_variance(state.z, normalised(state.log_weights))
        moments.append((mean[0], variance[0]))
    error = np.std(moments, axis=0, ddof=1) / np.sqrt(10)
    assert np.all(np.abs(np.mean(moments, axis=0) - (0, 1)) < 4 * error)
    assert np.all(error < 0.15)


def test_sequential_abc_lowers_its_tolerance_around_the_truth_and_stops() -> None:
    settings = abc_smc.AbcSmcSettings(particles=100)
    state, tolerances = abc_smc.begin(1, REAL), []
    for t in range(6):
        state = abc_smc.step(np.random.default_rng(t), state, simulated, settings)
        tolerances.append(state.tolerance)
    assert np.all(np.diff(tolerances) <= 0) and tolerances[-1] < 0.02 * tolerances[0]
    mean, _ = mean_and_variance(state.z, normalised(state.log_weights))
    assert mean[0] == pytest.approx(CENTER, abs=0.05)
    far_away = abc_smc.step(np.random.default_rng(9), state, lambda u: simulated(u * 1e-9), settings)
    assert far_away.converged and np.array_equal(far_away.z, state.z)


def test_simopts_temperature_spends_the_bound_on_the_divergence_exactly() -> None:
    """At the dual's optimum the weights' divergence from equal ones is the bound."""
    cost = np.random.default_rng(0).gamma(2.0, size=500)
    for bound in (0.06, 0.5, 1.0):
        share = normalised(-cost / simopt.solved_temperature(cost, bound, 1e-3))
        assert np.sum(share * np.log(share * 500 + 1e-300)) == pytest.approx(bound, rel=0.02)
    assert simopt.solved_temperature(cost, 50.0, 0.04) == pytest.approx(0.04, rel=0.01)


def test_simopt_is_weighted_maximum_likelihood_and_descends() -> None:
    settings = simopt.SimOptSettings(particles=200, threshold=0.0)
    state = simopt.begin(1, REAL)
    costs = []
    for t in range(5):
        state = simopt.step(np.random.default_rng(t), state, simulated, settings)
        costs.append(state.discrepancy)
    assert np.all(np.diff(costs) < 0)
    assert state.mean[0] == pytest.approx(CENTER, abs=0.05)
    assert state.covariance[0, 0] < 0.05
    unit, log_weights = simopt.posterior(state)
    assert to_probit(unit).var() == pytest.approx(state.covariance[0, 0], rel=0.15)
    assert np.all(log_weights == 0)


def test_simopt_ends_at_table_2s_threshold() -> None:
    state = simopt.begin(1, REAL)
    for t in range(20):
        state = simopt.step(np.random.default_rng(t), state, simulated, simopt.SimOptSettings())
        if state.converged:
            break
    assert state.converged and state.discrepancy < 0.06


@pytest.mark.parametrize(("left", "narrows"), [(2, False), (50, True)])
def test_simopts_gaussian_keeps_its_width_where_nearly_all_diverged(left: int, narrows: bool) -> None:
    def few(unit: np.ndarray) -> Trajectories:
        return simulated(unit)._replace(valid=np.arange(len(unit)) < left)

    state = simopt.step(np.random.default_rng(0), simopt.begin(1, REAL), few, simopt.SimOptSettings())
    assert (state.covariance[0, 0] < 0.9) == narrows


@pytest.mark.slow
def test_the_neural_posterior_is_the_exact_one_of_a_normal_problem() -> None:
    """z ~ N(0, 1), summary = z + 0.5 noise, 0.8 observed: mean 0.64, variance 0.2."""
    settings = npe.NpeSettings(particles=600, generations=1)
    state = npe.step(np.random.default_rng(0), npe.init(1, REAL), simulated, settings)
    assert state.draws.mean() == pytest.approx(0.64, abs=0.15)
    assert state.draws.var() == pytest.approx(0.2, rel=0.4)


def test_the_network_is_trained_once_after_the_last_generation(monkeypatch) -> None:
    taught: list[int] = []

    def asked(summary: np.ndarray, z: np.ndarray, real: np.ndarray, count: int, **_) -> np.ndarray:
        taught.append(len(z))
        return np.ones((count, z.shape[1]))

    monkeypatch.setattr("tcbi_infer.baselines.mixture_network.posterior_draws", asked)
    settings = npe.NpeSettings(particles=20, generations=3)
    before = run(npe, settings, simulated, npe.init(1, REAL), 2)
    assert before.draws.mean() == pytest.approx(0.0, abs=0.1) and before.draws.std() == pytest.approx(1.0, abs=0.1)
    after = npe.step(np.random.default_rng(2), before, simulated, settings)
    assert taught == [60] and np.all(after.draws == 1)


@pytest.mark.parametrize("left", [1, 4])
def test_a_network_that_nearly_nothing_is_left_for_says_so(left: int) -> None:
    def few(unit: np.ndarray) -> Trajectories:
        return simulated(unit)._replace(valid=np.arange(len(unit)) < left)

    with pytest.raises(InferError, match=f"simulations of 50 .*: got {left}, allowed is 5 or more; .* time step"):
        npe.step(np.random.default_rng(0), npe.init(1, REAL), few, npe.NpeSettings(generations=1))


def test_bayesian_optimisation_finds_the_minimum_better_than_chance() -> None:
    pytest.importorskip("optuna")
    settings = bayesopt.BayesOptSettings(particles=20)
    state = run(bayesopt, settings, simulated, budget.begin(2, REAL), 4)
    unit, log_weights = bayesopt.posterior(state)
    assert np.isfinite(log_weights).sum() == 1
    far = np.abs(to_probit(unit)[:, 0] - CENTER)
    assert np.median(far[60:]) < 0.5 * np.median(far[:20])


def test_a_missing_extra_is_one_line_with_the_command_that_installs_it(monkeypatch) -> None:
    def missing(name: str):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"needs optuna.*uv pip install .* requirements-baselines\.in"):
        find_method("bayesopt")


@pytest.mark.parametrize("module", [rejection, abc_smc, simopt, bayesopt, paper])
def test_all_simulations_diverged_is_an_error(module) -> None:
    settings = METHODS[module.__name__.rpartition(".")[2]].settings(particles=20)
    if module is bayesopt:
        pytest.importorskip("optuna")

    one = Observed(np.zeros((1, 1, 1)), np.zeros(1, int), ("x",), ("x/x",))

    def simulate(unit: np.ndarray) -> Features:
        return Features(
            np.zeros(0),
            np.full((len(unit), 1), 0.5),
            np.zeros(len(unit)),
            np.zeros(len(unit), bool),
            no_differences(len(unit)),
        )

    with pytest.raises(InferError, match="all 20 simulations diverged"):
        if module is paper:
            state = paper.init(np.random.default_rng(0), 1, settings)
            paper.step(np.random.default_rng(0), state, simulate, one, settings)
        else:
            begin = getattr(module, "begin", budget.begin)
            module.step(np.random.default_rng(0), begin(1, REAL), diverged, settings)


@pytest.mark.parametrize("method", ["rejection", "abc_smc", "simopt", "bayesopt", "npe"])
def test_every_method_brings_the_gain_of_a_servo_nearer_than_the_prior(method: str) -> None:
    """Root mean squared distance of the posterior from the truth, 0.8; the prior's is 0.42."""
    if method == "bayesopt":
        pytest.importorskip("optuna")
    model, measurements = bench_rollouts((0.8, 0.6, 0.5))
    result = infer(Problem.of(model, measurements, timestep=0.01), method, seed=0, particles=20, generations=3)
    weights = np.exp(result.log_weights)
    error = np.sqrt(weights @ (result.unit[:, 0] - 0.8) ** 2)
    assert error < (0.33 if method == "npe" else 0.2)  # sixty simulations are few for a network
    assert result.simulations == 20 * 3 * len(measurements) or result.converged
    assert result.statistics == ("trajectory",)


def test_domain_randomisation_is_the_prior_and_simulates_nothing() -> None:
    result = infer(Problem.of(*bench_rollouts(), timestep=0.01), "prior")
    assert result.simulations == 0
    assert result.unit.mean(axis=0) == pytest.approx(np.full(3, 0.5), abs=0.01)
    assert all(e.variance_ratio == pytest.approx(1.0, abs=0.02) and not e.identified for e in result.estimates)
