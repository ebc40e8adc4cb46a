"""The experiment, piece by piece: collect, diagnose, infer, retrain, deploy, deploy under sensor noise.

    with hold(folder):
        experiment = Experiment(plan, folder, laboratory, threads=2)
        for piece in plan.pieces():
            experiment.do(piece)

Each piece is kept in the notebook when it is finished; rollouts and models lie in the study's folder. Everything is
seeded by the piece, so that a study that was stopped and went on has the results of one that ran through. A piece that
fails is left out with its reason, as are those that need it; the others are done, and the next call tries it again.
"""

import dataclasses
import json
import shutil
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_bringup.demo.plan import recordings, slope_of
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot
from tcbi_bringup.errors import BringupError, WrongCallError
from tcbi_bringup.study.notebook import Notebook, Result
from tcbi_bringup.study.plan import CONTESTANTS, FIRST, WINNER, Key, Plan
from tcbi_bringup.study.robots import Laboratory, Order
from tcbi_contract.files import replace_file
from tcbi_infer import posterior
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurements
from tcbi_infer.collection import Request, scenario_of
from tcbi_infer.diagnose.adopt import adopt
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import EFFECT as EFFECT_FOUND
from tcbi_infer.divergence import js_nearest
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.driver import Interrupted, infer
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.rollouts import sensor_noise
from tcbi_policy.artefact import Policy, find_policy, save_policy
from tcbi_policy.configuration import TrainingConfig, preset
from tcbi_policy.environment import TIMESTEP_S
from tcbi_policy.retraining import fine_tuning
from tcbi_policy.reward import episode_reward, inclination, simulated_rewards
from tcbi_policy.runs import Run
from tcbi_policy.training import Training
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement, Scenario
from tcbi_sim.model import Model, base_model
from tcbi_sim.rigs import load_rig
from tcbi_sim.sensing import add_noise
from tcbi_sim.store import ModelStore

PLAN = "plan.json"  # in the study's folder
ASKED, ASKED_FOR = "asked", ("robots", "tasks", "contestants")  # what the newest call is to work on
COLLECTING, DEPLOYING, MOTIONS = 1, 2, 3  # seeds of the scenarios
DRAWS = 4  # simulations of each deployed scenario, each with parameters of its own, for the divergence
EVALUATE_EVERY = 3  # sets of episodes: a short training has few of them, and the best moment is kept


class _NotThere(Exception):
    """A piece has nothing to work on; carries what there is instead of the result that it needs."""

    def __init__(self, instead: Result):
        super().__init__(instead)
        self.instead = instead


class Experiment:
    """A study at work in its folder, which the caller holds (`notebook.hold`)."""

    def __init__(self, plan: Plan, folder: Path, laboratory: Laboratory, threads: int = 0):
        folder.mkdir(parents=True, exist_ok=True)
        self.plan, self.folder, self.laboratory, self.threads = plan, folder, laboratory, threads
        self.notebook = Notebook(folder / "study.jsonl")  # a folder of something else is refused before it is changed
        kept = _sizes_with(plan, folder) | {ASKED: dict(zip(ASKED_FOR, plan.names(), strict=True))}
        replace_file(folder / PLAN, json.dumps(kept, indent=1).encode())
        self.store = ModelStore(folder / "store")
        self.strength = dict(plan.robots)

    def do(self, piece: Key) -> Result:
        """Do a piece, unless it is done."""
        return self.notebook.once(piece, lambda: self._tried(*piece))

    def _tried(self, stage: str, *rest: Any) -> Result:
        """A piece's result; where it fails, why, with the mark that it is not done."""
        work: Callable[..., Result] = getattr(self, f"_{stage}")
        try:
            return work(*rest)
        except Interrupted:
            raise
        except _NotThere as e:
            return e.instead
        except Exception as e:  # noqa: BLE001 - the other robots and methods go on; the report says it
            why = f"{stage} failed: {type(e).__name__}: {' '.join(str(e).split())}"
            return {"left_out": why, "not_yet": True, "traceback": traceback.format_exc()}

    # -- the pieces -------------------------------------------------------------------------------------------------

    def _collect(self, task: str, robot: int) -> Result:
        plan = self.plan.tasks[task]
        request = Request(task, plan.rollouts, seed=1000 * robot + COLLECTING)
        orders = self._orders(robot, [scenario_of(request, i) for i in range(plan.rollouts)], plan.first_policy, 0)
        rollouts = self.laboratory.run(orders)
        self._write(self._rollouts_of(task, robot), rollouts)
        return {
            "returns": [episode_reward(m).total for m in rollouts],
            "truth": EmulatedRobot(robot, None, self.strength[robot]).specimen.truth(),
        }

    def _diagnose(self, robot: int) -> Result:
        """Motions for a diagnosis, as the demo records them, and the model that follows from it."""
        plan, orders = self.plan.diagnosis, []
        for i, gait, trial in recordings(plan.motions, plan.repeated):
            roll, pitch = slope_of(i)
            request = Request(
                "balance",
                1,
                1000 * robot + MOTIONS + i,
                slope_roll=(roll,),
                slope_pitch=(pitch,),
                duration_s=plan.motion_s,
            )
            orders.append(Order(robot, self.strength[robot], scenario_of(request, 0), f"gait:{gait}", 2 * i + trial))
        rollouts = self.laboratory.run(orders)
        model = base_model("hexapod")
        try:
            found = diagnose(model, rollouts, uses=plan.effects, settings=plan.settings)
        except InferError as e:
            return {"verdict": "", "effects": [], "statement": f"no diagnosis: {e}", "model": ""}
        facts: Result = {
            "verdict": found.verdict,
            "effects": list(found.uses),
            "statement": found.statement,
            "model": "",
        }
        if found.verdict == EFFECT_FOUND:
            facts["model"] = self.store.save(adopt(model, found.uses[0], found.to_json())).version
        return facts

    def _infer(self, task: str, robot: int, name: str) -> Result:
        plan, contestant = self.plan.tasks[task], CONTESTANTS[name]
        model = self._structure(robot, name)
        if model is None:
            return {"same_as": WINNER}
        try:
            method = find_method(contestant.method)
        except InferError as e:
            return {"left_out": str(e), "not_yet": True}
        self._needed("truth", "collect", task, robot)
        rollouts = read_measurements([self._rollouts_of(task, robot)])
        problem = Problem.of(
            model, rollouts, statistics=contestant.statistics or method.statistics, loop=method.loop,
            policies=self.store.root, timestep=TIMESTEP_S, threads=self.threads, seed=robot,
        )  # fmt: skip
        runs = self.store.folder("runs")
        try:
            result = infer(problem, method.name, seed=robot, folder=runs, **plan.budget(method.name))
        except Interrupted:
            raise
        except InferError as e:
            return {"left_out": str(e)}
        saved = posterior.save(self.store, result)
        return {
            "model": saved.version, "seconds": result.seconds, "simulations": result.simulations, "ess": result.ess,
            "closed_loop": result.closed_loop, "generations": [_moments(g) for g in result.generations],
            "estimates": [e.as_json() for e in result.estimates], "warnings": list(result.warnings),
        }  # fmt: skip

    def _train(self, task: str, robot: int, name: str) -> Result:
        found = self._inferred(task, robot, name)
        plan = self.plan.tasks[task]
        start = find_policy(plan.first_policy, self.store.root)
        assert isinstance(start, Policy)
        config = dataclasses.replace(
            fine_tuning(preset("fast", task)),
            steps=plan.steps,
            seed=robot,
            threads=self.threads,
            evaluate_every=EVALUATE_EVERY,
        )
        model = self.store.load(found["model"])
        folder = self._run_folder(f"study-{robot}-{name}", config, model, plan.first_policy)
        training = Training(folder, config, model, start)
        trained = training.run()
        stem = self.store.root / "policies" / f"{task}-{robot}-{name}"
        policy = save_policy(stem, trained.mlp, dataclasses.replace(trained.card, name=stem.name))
        shutil.rmtree(folder)
        same = [np.array_equal(a, b) for a, b in zip(policy.mlp.weights, start.mlp.weights, strict=True)]
        where = str(stem.with_suffix(".safetensors").relative_to(self.folder))
        return {"policy": where, "unchanged": all(same), "curve": training.state.curve}

    def _deploy(self, task: str, robot: int, name: str) -> Result:
        plan = self.plan.tasks[task]
        reference, model = self._policy(task, robot, name)
        scenarios = self._deployed(task, robot)
        rollouts = self.laboratory.run(self._orders(robot, scenarios, reference, 100))
        ends = [float(np.degrees(inclination(_attitude(m)[-1]))) for m in rollouts]
        policy = find_policy(reference, self.store.root)
        assert isinstance(policy, Policy) and len(rollouts) == plan.deployments
        return {
            "returns": [episode_reward(m).total for m in rollouts],
            "final_inclination_deg": ends,
            "distance_m": [m.distance for m in rollouts],
            "divergence": divergences(rollouts, policy, model, robot, self.threads),
        }

    def _noise(self, task: str, robot: int, name: str) -> Result:
        reference, _ = self._policy(task, robot, name)
        scenarios = self._deployed(task, robot)[: self.plan.tasks[task].noisy]
        levels = {}
        for sigma in self.plan.noise:
            rollouts = self.laboratory.run(self._orders(robot, scenarios, reference, 200, sigma))
            levels[f"{sigma:g}"] = [episode_reward(m).total for m in rollouts]
        return {"returns": levels}

    # -- what they share --------------------------------------------------------------------------------------------

    def _orders(
        self, robot: int, scenarios: list[Scenario], policy: str, first: int, sigma: float = 0.0
    ) -> list[Order]:
        return [Order(robot, self.strength[robot], s, policy, first + i, sigma) for i, s in enumerate(scenarios)]

    def _deployed(self, task: str, robot: int) -> list[Scenario]:
        """The scenarios that every policy meets on this robot."""
        number = self.plan.tasks[task].deployments
        request = Request(task, number, seed=1000 * robot + DEPLOYING)
        return [scenario_of(request, i) for i in range(number)]

    def _structure(self, robot: int, name: str) -> Model | None:
        """The model whose parameters are inferred; None where no effect was found that it could have."""
        if not CONTESTANTS[name].with_effect:
            return base_model("hexapod")
        version = self._needed("model", "diagnose", robot)["model"]
        return self.store.load(version) if version else None

    def _inferred(self, task: str, robot: int, name: str) -> Result:
        return self._needed("model", "infer", task, robot, name)

    def _needed(self, entry: str, *piece: Any) -> Result:
        """The result of an earlier piece, if it has this entry.

        Raises:
          _NotThere: it is left out, or that of another contestant.
        """
        found = self.notebook.get(*piece) or {"left_out": f"{piece[0]} was not done", "not_yet": True}
        if entry not in found:
            raise _NotThere({k: found[k] for k in ("same_as", "left_out", "not_yet") if k in found})
        return found

    def _policy(self, task: str, robot: int, name: str) -> tuple[str, Model]:
        """Where the policy of a contestant lies, and the model that it was trained on."""
        if name == FIRST:
            return self.plan.tasks[task].first_policy, base_model("hexapod")
        found = self._inferred(task, robot, name)
        trained = self._needed("policy", "train", task, robot, name)
        return str(self.folder / trained["policy"]), self.store.load(found["model"])

    def _run_folder(self, purpose: str, config: TrainingConfig, model: Model, start: str) -> Path:
        """Where a training goes on from: another one for another configuration, model or code, and the old one goes.

        Neither the number of threads nor where the study lies makes a difference.
        """
        run = Run.of(dataclasses.replace(config, threads=0), model, self.store.root, start)
        runs, name = self.store.folder("runs"), dataclasses.replace(run, store="").key(purpose)
        for stale in runs.glob(f"{purpose}-{config.task}-*"):
            if stale.name != name:
                shutil.rmtree(stale)
        folder = runs / name
        folder.mkdir(exist_ok=True)
        return folder

    def _rollouts_of(self, task: str, robot: int) -> Path:
        return self.folder / "rollouts" / f"{task}-{robot}"

    @staticmethod
    def _write(folder: Path, rollouts: list[Measurement]) -> None:
        """All rollouts as bags, or none."""
        part = folder.with_name(f".{folder.name}.part")
        for stale in (part, folder):
            shutil.rmtree(stale, ignore_errors=True)
        for m in rollouts:
            write_measurement(part, m)
        part.rename(folder)


def check_report(plan: Plan, folder: Path) -> None:
    """Refuse to write the report of a plan where there is no study, or one of other sizes; nothing is changed.

    Raises:
      BringupError: of other sizes.
      WrongCallError: there is none.
    """
    if not (folder / PLAN).is_file():
        raise WrongCallError(
            f"{folder} holds no study (it has no {PLAN}); give the --out of one, or begin one without --report"
        )
    _sizes_with(plan, folder)


def asked(folder: Path) -> list[list[Any]]:
    """Robots, tasks and contestants that the newest call of a study works on; empty lists where it is not known."""
    told = json.loads((folder / PLAN).read_text()).get(ASKED, {})
    return [told.get(name, []) for name in ASKED_FOR]


def _sizes_with(plan: Plan, folder: Path) -> Result:
    """The sizes of a study with those of a plan; robots and methods may be added.

    Raises:
      BringupError: the folder holds a study of other sizes.
    """
    path = folder / PLAN
    sizes = {task: dataclasses.asdict(p) for task, p in plan.tasks.items()}
    sizes["all"] = {"noise": list(plan.noise), "motions": list(plan.diagnosis.motions)}
    try:
        known = json.loads(path.read_text()) if path.exists() else {}
    except ValueError:
        raise BringupError(f"{path} is no plan of a study; remove it, and the sizes that are asked for count") from None
    different = [name for name, size in sizes.items() if known.get(name, size) != size]
    if different:
        raise BringupError(
            f"{folder} holds a study of other sizes ({', '.join(different)}); give another --out, or its preset"
        )
    return known | sizes


def divergences(rollouts: list[Measurement], policy: Policy, model: Model, seed: int, threads: int = 0) -> list[float]:
    """Jensen-Shannon divergence (nats) of each rollout's rewards from those that the model gives in its scenario.

    By nearest neighbours: bins would follow the rewards of the policy that ran, and each contestant has its own. The
    simulated policy reads what the robot's sensors would tell it, and its rewards are made of such readings. No two
    rollouts share a parameter vector, whose luck would else be in all of them.
    """
    rng = np.random.default_rng([seed, 86028121])
    noise = sensor_noise(rollouts, load_rig(model.rig).noise)
    out = simulate(
        model,
        model.sample(rng, DRAWS * len(rollouts)),
        [m.scenario for m in rollouts for _ in range(DRAWS)],
        controller=policy,
        noise=noise,
        pairing="zip",
        timestep=TIMESTEP_S,
        threads=threads,
    )
    simulated = simulated_rewards(add_noise(out, noise, rng)).reshape(len(rollouts), 1, -1)
    return [float(js_nearest(episode_reward(m).steps, s)[0]) for m, s in zip(rollouts, simulated, strict=True)]


def _attitude(m: Measurement) -> np.ndarray:
    assert m.attitude is not None
    return m.attitude


def _moments(generation: dict[str, Any]) -> dict[str, Any]:
    kept = ("generation", "ess", "mean", "variance", "variance_ratio", "wall_s")
    return {key: generation[key] for key in kept if key in generation}
