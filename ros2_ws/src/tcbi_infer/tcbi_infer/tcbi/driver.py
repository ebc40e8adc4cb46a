"""The loop around a method: seeds, progress, checkpoints, the result.

    problem = Problem.of(model, measurements)
    result = infer(problem, "calibrated", seed=0, folder=store.folder("runs"))

Generation t draws from a generator seeded by (seed, t), so an inference that was killed and resumed ends with the same
bits as one that ran through.
"""

import contextlib
import functools
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tcbi_contract.errors import describe
from tcbi_contract.files import replace_file
from tcbi_infer.errors import InferError, SettingError
from tcbi_infer.tcbi import checkpoint, modes
from tcbi_infer.tcbi.goodness import allowing, goodness_of_fit, in_doubt, piled, strays, unfinished
from tcbi_infer.tcbi.method import Generation, Method, find_method
from tcbi_infer.tcbi.mixed import mixed
from tcbi_infer.tcbi.pooled import JS
from tcbi_infer.tcbi.predictive import Departures, departures, usual_simulations
from tcbi_infer.tcbi.prior import doubtful
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.result import Result, estimates, prior_variances
from tcbi_infer.tcbi.run_name import run_name
from tcbi_infer.tcbi.servos import scattered
from tcbi_infer.tcbi.weights import effective_sample_size, mean_and_variance, normalised
from tcbi_sim.engine import SimError
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.ray_workers import versions

FINER = "simulating the nearest particles with short time steps"
CHECKING = "checking the posterior's predictions"
LEAST_PARTICLES = 10  # a generation; from fewer no spread can be told
RESUMED = "resumed from a state that an earlier run left"
UNREADABLE = "what an earlier run left cannot be read: the inference started over"
BOUNDS: dict[str, tuple[float, float]] = {  # of a method's settings; of others: 0 or more, of whole numbers 1 or more
    "particles": (LEAST_PARTICLES, math.inf),
    "least_temperature": (1e-6, math.inf),
    **dict.fromkeys(("prior_share", "least_ess", "tau", "kept", "least_accepted", "accepted"), (0, 1)),
}


class Progress(NamedTuple):
    """What a watcher is told, within generations too."""

    generation: int  # the one at work, from 1
    generations: int  # at most
    share: float  # of this generation's simulations
    remaining_s: float  # estimate, nan before there is one
    ess: float  # after the last whole generation
    mean: np.ndarray  # (P,) physical, after the last whole generation
    sd: np.ndarray  # (P,)
    stage: str = ""  # what is at work beside the generations' own simulations: `FINER` or `CHECKING`


class Interrupted(InferError):
    """The user stopped an inference; its state is kept."""


def infer(
    problem: Problem,
    method: str = "calibrated",
    *,
    seed: int = 0,
    folder: Path | None = None,
    watch: Callable[[Progress], None] | None = None,
    **settings: Any,
) -> Result:
    """Run a method to its end.

    Args:
      problem: rollouts and model.
      method: by name.
      seed: of all randomness.
      folder: where the state is kept between generations (a folder of its own is made in it); an inference of the same
        rollouts, model and settings that was stopped goes on from there. None keeps nothing.
      watch: told of progress.
      **settings: of the method, such as `particles` and `generations`.

    Raises:
      Interrupted: on Ctrl-C, after the state of the last whole generation was kept.
      UnknownNameError: there is no such method.
      SettingError: it cannot have these settings, or this divergence.
      InferError: every simulation diverged.
    """
    chosen = find_method(method)
    given = settings_of(chosen, settings)
    if problem.divergence_name != JS and not chosen.any_divergence:
        raise SettingError(f"method {method} looks at no divergence; leave it out, or take method calibrated or paper")
    place = None if folder is None else folder / run_name(problem, method, given, seed)
    loop = _Loop(problem, chosen, given, seed, place, watch)
    with _stopping(place):
        loop.run()
        return loop.result()


def settings_of(method: Method, given: Mapping[str, Any]) -> Any:
    """The method's settings with those given.

    Raises:
      UnknownNameError: the method does not have such a setting.
      SettingError: it does not take this value.
    """
    defaults = method.settings()
    for name in given:
        if name not in defaults._fields:
            raise UnknownNameError(f"setting of method {method.name}", name, defaults._fields)
    return defaults._replace(**{name: _checked(name, given[name], getattr(defaults, name)) for name in given})


def _checked(name: str, value: float, default: float) -> float:
    """The value of a setting, of its default's kind: 5.0 particles are 5."""
    kind = type(default)
    least, most = BOUNDS.get(name, (1 if kind is int else 0, math.inf))
    if not (math.isfinite(value) and least <= value <= most and kind(value) == value):
        allowed = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise SettingError(describe(name, value, f"a whole number, {allowed}" if kind is int else allowed))
    return kind(value)


@contextlib.contextmanager
def _stopping(place: Path | None) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as e:
        kept = "; the same command goes on from the last whole generation" if place is not None else ""
        raise Interrupted(f"inference stopped{kept}") from e


@contextlib.contextmanager
def _simulating() -> Iterator[None]:
    try:
        yield
    except SimError as e:
        raise InferError(f"the simulation cannot run these rollouts: {e}") from e


class _Loop:
    """One inference at work."""

    def __init__(
        self,
        problem: Problem,
        method: Method,
        settings: Any,
        seed: int,
        place: Path | None,
        watch: Callable[[Progress], None] | None,
    ):
        self.problem, self.method, self.settings, self.seed, self.place = problem, method, settings, seed, place
        self.watch = watch
        self.real, self.statistics = method.observe(problem), method.labels(problem)
        self.dimensions = len(problem.model.names)
        self.known = None if problem.prior is None else problem.prior.draws()
        self.state, self.history, self.began_with = self._begin()
        self.last = Generation(np.nan, np.nan, np.zeros(len(self.statistics)), {})
        self.begun = time.monotonic()
        self.here = 0  # generations run by this process
        self.simulated = self.diverged = 0  # particles of this generation
        self.check = usual_simulations(self.dimensions) / settings.particles if method.judges else 0.0  # in generations

    def _begin(self) -> tuple[Any, list[dict[str, Any]], str]:
        """The state, the generations before it, and a sentence on what an earlier run left; "" if that was nothing."""
        left = ""
        if self.place is not None:
            self.place.mkdir(parents=True, exist_ok=True)
            state = checkpoint.load(self.place / "state.npz", self.method.state_type)
            history = self._read_history()
            if state is not None and len(history) >= state.generation:  # killed between the two files: one longer
                return state, history[: state.generation], RESUMED if state.generation > 0 else ""
            left = UNREADABLE if (self.place / "state.npz").exists() else ""
        rng = np.random.default_rng([self.seed, 0])
        return self.method.init(rng, self.dimensions, self.real, self.settings), [], left

    def _read_history(self) -> list[dict[str, Any]]:
        assert self.place is not None
        try:
            return json.loads((self.place / "generations.json").read_text())
        except (OSError, ValueError):
            return []

    def run(self) -> None:
        """Until the method says it is finished."""
        while not self.method.finished(self.state, self.settings):
            rng, began = np.random.default_rng([self.seed, self.state.generation + 1]), time.monotonic()
            self._tell(0.0)
            self.simulated = self.diverged = 0
            state, found = self.method.step(rng, self.state, self._simulate, self.real, self.settings)
            if self.method.finely and (finer := self.problem.finer):
                simulate = functools.partial(self._simulate_finely, finer)
                state, anew = self.method.finely(rng, state, simulate, self.real, self.settings)
                found = anew or found
            self.state, self.last = state, self._told(found)
            self.here += 1
            self._record(time.monotonic() - began)
            if self.place is not None:
                replace_file(self.place / "generations.json", json.dumps(self.history))
                checkpoint.save(self.place / "state.npz", self.state)
        self._tell(1.0)

    def _simulate(self, unit: np.ndarray) -> Any:
        with _simulating():
            seen = self.problem.simulate(unit, self._tell, self.method.view)
        self.simulated += len(seen.valid)
        self.diverged += int(np.sum(~seen.valid))
        return seen

    def _simulate_finely(self, finer: Problem, unit: np.ndarray) -> Any:
        self._tell(1.0, FINER)
        with _simulating():
            return finer.simulate(unit, None, self.method.view)

    def _told(self, found: Generation) -> Generation:
        """A generation with its best particles where the posterior's are: in the parameters' unit cube."""
        if "best" not in found.notes:
            return found
        return found._replace(notes={**found.notes, "best": self.problem.unit(np.array(found.notes["best"])).tolist()})

    def _posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """Particles (M, P) in the parameters' unit cube, and their log-weights (M,)."""
        cube, log_weights = self.method.posterior(self.state, self.settings)
        return self.problem.unit(cube), log_weights

    def _record(self, wall_s: float) -> None:
        self.history.append(
            {
                "generation": self.state.generation,
                "ess": self.last.ess,
                "alpha": self.last.alpha,
                **self._moments(*self._posterior()),
                "divergence": self.last.divergence.tolist(),
                "wall_s": wall_s,
                "particles": self.simulated,
                "diverged": self.diverged,
                **self.last.notes,
            }
        )

    def _moments(self, unit: np.ndarray, log_weights: np.ndarray) -> dict[str, list[float]]:
        """Of weighted particles, as an entry of the history has them."""
        weights = normalised(log_weights)
        mean, variance = mean_and_variance(self.problem.model.from_unit(unit), weights)
        unit_mean, unit_variance = mean_and_variance(unit, weights)
        ratio = unit_variance / prior_variances(self.dimensions, self.known)
        found = {"mean": mean, "variance": variance, "unit_mean": unit_mean, "variance_ratio": ratio}
        return {name: values.tolist() for name, values in found.items()}

    def _tell(self, share: float, stage: str = "") -> None:
        if self.watch is None:
            return
        nan = np.full(self.dimensions, np.nan)
        last: dict[str, Any] = self.history[-1] if self.history else {"ess": np.nan, "mean": nan, "variance": nan}
        over = self.method.finished(self.state, self.settings)
        done = self.here + (0.0 if over else share)
        left = self.check + (0.0 if over else self.settings.generations - self.state.generation - share)
        elapsed = time.monotonic() - self.begun
        remaining = elapsed / done * max(left, 0.0) if done > 0 else np.nan
        self.watch(
            Progress(
                min(self.state.generation + 1, self.settings.generations),
                self.settings.generations,
                share,
                remaining,
                last["ess"],
                np.asarray(last["mean"]),
                np.sqrt(last["variance"]),
                stage,
            )
        )

    def result(self) -> Result:
        """The outcome, with its warnings."""
        problem, model = self.problem, self.problem.model
        unit, log_weights = self._posterior()
        kept = np.isfinite(log_weights)
        if not kept.any():
            raise InferError("no particle has any weight: every simulation diverged")
        unit, log_weights = unit[kept], _log_shares(log_weights[kept])
        last = self._last_generation()
        before = self._generation_before()
        if self.method.judges:
            self._tell(1.0, CHECKING)
        with _simulating():
            seen = departures(problem, unit, log_weights) if self.method.judges else Departures({}, 0)
        checked = seen.particles
        if self.method.judges and in_doubt(self.statistics, last):
            with _simulating():
                servos = scattered(problem, np.asarray(last.notes["best"])[0])
            checked += servos.particles
            last, before = allowing(last, servos), before and allowing(before, servos)
        wrong, fits, distrust = goodness_of_fit(
            model.parameters, unit, log_weights, self.statistics, last, before, self.known, seen
        )
        history = list(self.history)
        if distrust > 1 and self.method.distrusted is not None:
            log_weights = _log_shares(self.method.distrusted(self.state, distrust)[kept])
            history[-1] = {**history[-1], "alpha": last.alpha / distrust, **self._moments(unit, log_weights)}
        apart = mixed(model.parameters, seen.each, problem.rollout_ids)
        lines = [*strays(seen, problem.rollout_ids), *apart, *wrong]
        judged = self.method.judges and fits is True and not (self.known is not None and doubtful(model))
        found = estimates(model.parameters, unit, log_weights, self.known, judged)
        lines += piled(model.parameters, unit, log_weights, last, {e.name for e in found if e.identified})
        lines += [] if self.state.converged or fits is False else unfinished(last)
        copies = 2 * len(np.unique(unit, axis=0)) < len(unit)  # of few particles, after a resampling
        if not copies and (several := modes.told(model.parameters, unit, np.exp(log_weights))):
            lines.append(f"the posterior has {several}; a mean and an interval do not show that, the report does")
        particles, diverged = (sum(entry.get(name, 0) for entry in history) for name in ("particles", "diverged"))
        if diverged:
            lines.append(
                f"{diverged} of {particles} particles diverged in a rollout and weigh nothing: the model is "
                "unstable there, or the time step too long (--timestep)"
            )
        begun = [self.began_with] if self.began_with else []
        simulated = (self.method.simulations(self.state, self.settings) + checked) * len(problem.rollout_ids)
        seconds = sum(entry.get("wall_s", 0.0) for entry in self.history)
        return Result(
            model, self.method.name, problem.task, self.statistics, problem.rollout_ids, unit, log_weights,
            found, _distinct(unit, np.exp(log_weights)),
            simulated, seconds, tuple(history), bool(self.state.converged), problem.closed_loop,
            (*problem.warnings, *begun, *lines), self.known, fits,
            None if self.place is None else self.place / "state.npz", self._how(),
        )  # fmt: skip

    def _how(self) -> dict[str, Any]:
        """What another run needs beside the bags to come to the same bits."""
        problem = self.problem
        divergence = {"divergence": problem.divergence_name} if self.method.any_divergence else {}
        run = {"seed": self.seed, "timestep": problem.timestep, "short_step": problem.short_step, **divergence}
        return {**run, **self.settings._asdict(), "versions": versions()}

    def _last_generation(self) -> Generation:
        return self.last if self.here or not self.history else _generation(self.history[-1])

    def _generation_before(self) -> Generation | None:
        return _generation(self.history[-2]) if len(self.history) > 1 else None


def _distinct(unit: np.ndarray, weights: np.ndarray) -> float:
    """Effective sample size of particles (M, P), of which equal ones are one, with weights (M,) that add up to one."""
    _, which = np.unique(unit, axis=0, return_inverse=True)
    return effective_sample_size(np.bincount(which.ravel(), weights))


def _log_shares(log_weights: np.ndarray) -> np.ndarray:
    """(M,) log-weights whose weights add up to one."""
    return np.log(np.maximum(normalised(log_weights), 1e-300))


def _generation(entry: Mapping[str, Any]) -> Generation:
    """As the history tells it."""
    notes = {k: entry[k] for k in ("alpha_supported", "floor_noise", "floor_misfit", "misfit", "best") if k in entry}
    return Generation(entry["ess"], entry["alpha"], np.asarray(entry["divergence"]), notes)
