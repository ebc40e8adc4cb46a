"""Problems whose answer is known: a normal simulator, and a servo test bench with known parameters."""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.stats import binom, kstest

from tcbi_infer.divergence import Binning
from tcbi_infer.tcbi import calibrated
from tcbi_infer.tcbi.features import Features, Observed, divergences
from tcbi_infer.tcbi.in_time import no_differences
from tcbi_infer.tcbi.pooled import pooled_divergence
from tcbi_infer.tcbi.weights import mean_and_variance, normalised
from tcbi_policy.artefact import find_policy
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model, base_model
from tcbi_sim.rigs import load_rig

BENCH_TRUTH = (0.45, 0.6, 0.5)  # gain, damping, friction in the unit cube


def normal_problem(
    truth: float,
    seed: int,
    rollouts: int = 20,
    samples: int = 40,
    between: float = 0.1,
    within: float = 0.3,
    simulated_within: float | None = None,
    divergence: str = "js",
) -> tuple[Observed, Callable[[np.ndarray], Features], float]:
    """x = first parameter + rollout's offset + noise, both normal; `simulated_within` makes the simulator a wrong one.

    Returns:
      The observed rollouts, the simulator, and the exact posterior standard deviation of theta under a flat prior.
    """
    rng = np.random.default_rng(seed)

    def draw(theta: np.ndarray, spread: float) -> np.ndarray:
        offset = between * rng.standard_normal((len(theta), rollouts, 1))
        return theta[:, None, None] + offset + spread * rng.standard_normal((len(theta), rollouts, samples))

    real = draw(np.array([truth]), within)
    binning = Binning.of(real)

    def counted(x: np.ndarray) -> np.ndarray:
        return binning.counts(x)[:, :, None].astype(np.float32)

    observed = Observed(
        counted(real)[0], np.array([0]), ("x",), ("x/x",), pooled_divergence(divergence, [binning], counted(real)[0])
    )

    def run(unit: np.ndarray) -> Features:
        counts = counted(draw(unit[:, 0], within if simulated_within is None else simulated_within))
        return seen(counts, divergences(observed, counts))

    return observed, run, float(np.sqrt((between**2 + within**2 / samples) / rollouts))


def seen(counts: np.ndarray, divergence: np.ndarray) -> Features:
    """Features of M simulations that all ended well, of which nothing is compared in time."""
    m = len(counts)
    return Features(counts, divergence, np.full(m, np.nan), np.ones(m, bool), no_differences(m))


def judged(
    truths: int, divergence: str = "js", particles: int = 40, generations: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Inferences of normal problems whose truths are drawn from 0.2 to 0.8.

    Returns:
      (truths,) share of each posterior below its truth, and its standard deviation over the exact one.
    """
    ranks, widths = [], []
    settings = calibrated.CalibratedSettings(particles, generations)
    for seed in range(truths):
        truth = float(np.random.default_rng([seed, 1]).uniform(0.2, 0.8))
        observed, simulate, exact = normal_problem(truth, seed, divergence=divergence)
        state = calibrated.init(1)
        while not calibrated.finished(state, settings):
            rng = np.random.default_rng([seed, state.generation])
            state, _ = calibrated.step(rng, state, simulate, observed, settings)
        unit, log_weights = calibrated.posterior(state)
        weights = normalised(log_weights)
        ranks.append(weights @ (unit[:, 0] < truth))
        widths.append(np.sqrt(mean_and_variance(unit, weights)[1][0]) / exact)
    return np.array(ranks), np.array(widths)


def assert_ranks_of_truths(ranks: np.ndarray) -> None:
    """Of exact posteriors: as many 90 % intervals hold the truth as may be, and ranks are uniform; fails in 0.3 %."""
    low, high = binom.interval(0.998, len(ranks), 0.9)
    assert low <= np.sum(np.abs(ranks - 0.5) <= 0.45) <= high
    assert kstest(ranks, "uniform").pvalue > 1e-3


def bench_rollouts(
    unit: tuple[float, ...] = BENCH_TRUTH,
    count: int = 8,
    seed: int = 0,
    duration: float = 3.0,
    timestep: float = 0.005,
    effects: tuple[str, ...] = (),
) -> tuple[Model, list[Measurement]]:
    """Random steps of a servo bench with known parameters, noise, and another time step than inference uses.

    The parameters of `effects` stand behind the bench's own.
    """
    model = base_model("servo_bench")
    for effect in effects:
        model = model.with_effect(effect)
    rig, rng = load_rig("servo_bench"), np.random.default_rng(seed)
    times = np.arange(0.0, duration, 0.4)
    scenarios = [Scenario("steps", duration, seed=i) for i in range(count)]
    commands = [Commands(times, rng.uniform(-1, 1, (len(times), 1))) for _ in scenarios]
    truth = model.from_unit(np.array([unit]))
    rollouts = simulate(model, truth, scenarios, commands=commands, timestep=timestep)
    rollouts.joint_position += rig.noise.joint_position * rng.standard_normal(rollouts.joint_position.shape)
    found = [rollouts.measurement(0, i, f"steps_{seed}_{i}", "steps") for i in range(count)]
    return model, [dataclasses.replace(m, commands=c) for m, c in zip(found, commands, strict=True)]


def hexapod_rollouts(*policies: str, count: int = 2, tilt: float = 0.08, duration: float = 1.0) -> list[Measurement]:
    """Noiseless rollouts of each policy on its own slopes, begun a few milliseconds late, as on a busy machine."""
    model, found = base_model("hexapod"), []
    for name in policies:
        policy = find_policy(name)
        scenarios = [Scenario("balance", duration, tilt * (s + 1), -tilt, seed=s) for s in range(count)]
        out = simulate(model, model.mean()[None], scenarios, controller=policy, timestep=0.01)
        for s in range(count):
            m = out.measurement(0, s, f"{name}_{s}", policy.policy_id)
            late = dataclasses.replace(m.commands, time=m.commands.time + 0.004 * (s + 1))
            found.append(dataclasses.replace(m, commands=late))
    return found
