"""The story that the demo tells: record, compare, locate, diagnose, add, infer, retrain, swap, measure again.

Every figure is measured on the spot. What is hidden in the robot is looked at once, at the very end, to be named.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_bringup.commands import console
from tcbi_bringup.demo.lab_node import LabNode
from tcbi_bringup.demo.narration import Narration
from tcbi_bringup.demo.plan import Plan, Recording, recordings, slope_of
from tcbi_bringup.demo.robot import FIRST_POLICY, Robot
from tcbi_bringup.errors import DemoError
from tcbi_contract.wording import counted, with_unit
from tcbi_infer import posterior
from tcbi_infer.bags.reader import read_measurements
from tcbi_infer.compare.comparison import Comparison, compare
from tcbi_infer.compare.history import VersionError
from tcbi_infer.compare.history import remember as remember_errors
from tcbi_infer.diagnose.adopt import adopt, remember
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import EFFECT, NOTHING_MISSING, Diagnosis
from tcbi_infer.gaps import unusable
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.result import LEAST_ESS, Result
from tcbi_policy.reward import episode_reward, inclination
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.store import ModelStore

TASK = "balance"
RECORDINGS = 3  # of the same, at most


Advance = Callable[..., None]  # of a progress bar


def _silent(*_: object, **__: object) -> None:
    """No progress bar."""


@dataclass
class Outcome:
    """Everything the story found, for the table, the JSON and the report."""

    robot: Robot
    plan: Plan
    store: ModelStore
    narration: Narration = field(default_factory=Narration)
    motions: list[Measurement] = field(default_factory=list)
    unseen: list[Measurement] = field(default_factory=list)
    before: list[Measurement] = field(default_factory=list)  # the task with the first policy
    after: list[Measurement] = field(default_factory=list)  # with the last one
    comparison: Comparison | None = None
    diagnoses: list[Diagnosis] = field(default_factory=list)
    inference: Result | None = None
    models: list[Model] = field(default_factory=list)
    errors: dict[str, Comparison] = field(default_factory=dict)  # model version -> on the unseen motions
    retraining: Any = None

    @property
    def verdict(self) -> str:
        """Of the first diagnosis: what was missing in the model that the user came with."""
        return self.diagnoses[0].verdict if self.diagnoses else ""

    def right(self, hidden: Sequence[str]) -> bool:
        """Whether what was said is what is hidden (names of effects): these alone, or that nothing is missing."""
        said = {use.partition(":")[0] for use in self.effects}
        return said == set(hidden) and self.verdict == (EFFECT if hidden else NOTHING_MISSING)

    @property
    def effects(self) -> list[str]:
        """All effects that were added."""
        return list(self.models[-1].effects) if self.models else []


class Story:
    """One telling; each method is a step."""

    def __init__(self, robot: Robot, plan: Plan, folder: Path, lab: LabNode):
        self.robot, self.plan, self.folder, self.lab = robot, plan, folder, lab
        self.out = Outcome(robot, plan, ModelStore(folder / "store"))
        self.say, self.step = self.out.narration.say, self.out.narration.step

    def tell(self, draw: Callable[[Outcome], None] = _silent) -> Outcome:
        """All steps in order; `draw` is called once all findings are there, while the robot still moves."""
        with self.step("record"):
            self.record()
        robot = self._run_meanwhile(self.run_task)
        with self.step("compare"):
            self.compare()
        with self.step("locate"):
            self.locate()
        model = self.explain()
        with self.step("run"):
            robot.result()
            self.say(
                f"meanwhile the robot ran its task with its first policy: return {mean_return(self.out.before):.0f}, "
                f"final inclination {tilt(self.out.before):.1f} deg; "
                f"and {counted(len(self.out.unseen), 'motion')} for the end"
            )
        with self.step("infer"):
            model = self.infer(model)
        with self.step("retrain"):
            self.retrain(model)
        with self.step("measure"):
            self.measure(draw)
        return self.out

    # -- steps ----------------------------------------------------------------------------------------------------

    def record(self) -> None:
        """Motions to learn from."""
        plan, out = self.plan, self.out
        again = "each" if plan.repeated >= len(plan.motions) else f"{plan.repeated} of them"
        self.say(f"robot {self.robot.seed} moves: {len(plan.motions)} motions of {plan.motion_s:g} s, {again} twice")
        # repeats come last, apart from each other: they tell how far the robot repeats itself, which a machine that
        # still loads libraries blurs
        wanted = sorted(recordings(plan.motions, plan.repeated), key=lambda r: (r.motion < plan.repeated, r.trial))
        with console.progress("recording", total=len(wanted), unit="rollouts") as advance:
            out.motions = self._motions(wanted, "motions", 0, advance)
        self.say(f"{len(out.motions)} rollouts, a bag each, in {self.folder / 'rollouts'}")

    def run_task(self) -> None:
        """The task with the first policy, and motions that only the final errors are judged on."""
        self.out.before = self._deploy(FIRST_POLICY, "before")
        self.out.unseen = self._motions(recordings(self.plan.unseen, len(self.plan.unseen)), "unseen", 100)

    def compare(self) -> None:
        """The base model against the measurements."""
        model = self.out.store.load("hexapod-v0")
        self.out.models = [model]
        found = self.out.comparison = compare(model, self.out.motions, particles=self.plan.bands)
        worst = max(found.signals, key=lambda s: s.ratio)
        self.say(
            f"{model.version} misses by {found.error_over_floor:.1f} times what the robot differs from itself; "
            f"worst {worst.name}: {worst.error:.3g} {worst.unit} against {worst.noise_floor:.2g}"
        )
        for line in found.guards:
            self.say(line)

    def locate(self) -> None:
        """Where the error lives."""
        assert self.out.comparison is not None
        for finding in self.out.comparison.where[:3]:
            self.say(finding.statement)

    def explain(self) -> Model:
        """Diagnose, and add what is found."""
        model = self.out.models[0]
        with self.step("diagnose"):
            diagnosis = self._diagnose(model)
        with self.step("add"):
            return self._add(model, diagnosis)

    def infer(self, model: Model) -> Model:
        """TCBI on the task's rollouts, which no fit has seen, from what the diagnosis says on."""
        plan, store = self.plan, self.out.store
        self._mend_deployments()
        problem = Problem.of(model, self.out.before, prior="model", policies=store.root)
        with console.progress("inferring", total=plan.generations) as advance:
            result = infer(
                problem,
                seed=self.robot.seed,
                folder=store.folder("runs"),
                watch=lambda p: advance(done=p.generation - 1 + p.share),
                particles=plan.particles,
                generations=plan.generations,
            )
        self.out.inference = result
        saved = posterior.save(store, result)
        self.out.models.append(saved)
        self.say(f"{saved.version}: {_told(result)}")
        return saved

    def retrain(self, model: Model) -> None:
        """A successor of the policy on the posterior; the graph goes on meanwhile."""
        self.lab.load_policy(FIRST_POLICY)
        with console.progress("training", total=self.plan.training_s) as advance:
            result = self.out.retraining = self.lab.retrain(
                TASK,
                model.version,
                self.plan.training_s,
                self.robot.seed,
                lambda f: advance(
                    done=self.plan.training_s - f.remaining_s,  # a budget: what is left is known from the beginning
                    left_s=f.remaining_s,
                    note=f"mean return {f.mean_return:.0f}",
                ),
            )
        self.say(result.message)

    def measure(self, draw: Callable[[Outcome], None]) -> None:
        """The task again, on new rollouts; every model version on the motions that no fit has seen."""
        out = self.out
        with console.progress("deploying", total=self.plan.deployments, unit="rollouts") as advance:
            robot = self._run_meanwhile(lambda: self.run_task_again(advance))
            floor = out.comparison.floor if out.comparison else None  # from all motions, not these few
            for model in out.models:
                out.errors[model.version] = compare(model, out.unseen, particles=self.plan.bands, floor=floor)
            draw(out)
            robot.result()
        change = f"return {mean_return(out.before):.0f} -> {mean_return(out.after):.0f}"
        self.say(f"{change}, final inclination {tilt(out.before):.1f} -> {tilt(out.after):.1f} deg on the robot")
        self._remember_errors()
        ladder = ", ".join(f"{v} {c.error_over_floor:.1f}" for v, c in out.errors.items())
        self.say(f"error over the noise floor on motions that no fit has seen: {ladder}")

    def run_task_again(self, advance: Advance) -> None:
        """The task with the policy that is best now."""
        accepted = self.out.retraining is not None and self.out.retraining.accepted
        self.out.after = self._deploy(self.out.retraining.policy if accepted else FIRST_POLICY, "after", advance)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _run_meanwhile(self, work: Callable[[], None]) -> Future[None]:
        """Let the robot work while the model is being looked at."""
        pool = ThreadPoolExecutor(1, thread_name_prefix="robot")
        future = pool.submit(work)
        pool.shutdown(wait=False)
        return future

    def _rollout(self, policy: str, seed: int, folder: Path, **options: Any) -> Measurement:
        """Record one; again if a busy machine held up the robot or what records it."""
        tried: list[tuple[float, Path, Measurement]] = []  # share that is spoilt, bag, what it holds
        fault = DemoError("nothing was recorded")
        for _ in range(RECORDINGS):
            try:
                bag = self.lab.record(TASK, policy, seed, folder, **options)
            except DemoError as error:
                fault = error
                self.say(f"{policy}, seed {seed}: {error}; it is recorded again")
                continue
            (measurement,) = read_measurements([bag])
            spoilt = unusable(measurement, measurement.time)
            tried.append((float(spoilt.averages.mean()), bag, measurement))
            if not spoilt.sentences:
                break
            self.say(f"{policy}, seed {seed}: a busy machine spoilt it; it is recorded again ({spoilt.sentences[0]})")
        if not tried:
            raise DemoError(f"{fault}{busy()}")
        tried.sort(key=lambda one: one[0])
        for _, bag, _ in tried[1:]:
            _set_aside(bag)
        return tried[0][2]

    def _motions(self, wanted: list[Recording], name: str, seed: int, advance: Advance = _silent) -> list[Measurement]:
        """Gaits; the ground is tilted another way under each motion."""
        folder, recorded = self.folder / "rollouts" / name, []
        for i, gait, _ in wanted:
            options = {"duration_s": self.plan.motion_s, "slope": slope_of(i)}
            recorded.append(self._rollout(f"gait:{gait}", seed + i, folder, **options))
            advance(1)
        return recorded

    def _deploy(self, policy: str, name: str, advance: Advance = _silent) -> list[Measurement]:
        """The task with a policy; the same seeds, hence the same slopes, before and after."""
        recorded = []
        for number in range(self.plan.deployments):
            recorded.append(self._deployed(policy, name, number))
            advance(1)
        return recorded

    def _deployed(self, policy: str, name: str, number: int) -> Measurement:
        seed = 1000 * (self.robot.seed + 1) + number
        return self._rollout(policy, seed, self.folder / "rollouts" / name, duration_s=self.plan.deployment_s)

    def _mend_deployments(self) -> None:
        """Record again, with the diagnosis out of the way, what it spoilt of the first policy's rollouts."""
        for number, m in enumerate(self.out.before):
            if unusable(m, m.time).sentences:
                self.say(f"{m.rollout_id} was spoilt while the model was looked at; it is recorded again")
                self.out.before[number] = self._deployed(FIRST_POLICY, "before", number)

    def _diagnose(self, model: Model) -> Diagnosis:
        with console.progress("diagnosing", total=1.0) as advance:
            diagnosis = diagnose(
                model,
                self.out.motions,
                uses=self.plan.effects,
                settings=self.plan.settings,
                progress=lambda stage, share: advance(done=share, note=stage),
            )
        self.out.diagnoses.append(diagnosis)
        remember(diagnosis, self.out.store.folder("runs"))
        self.say(diagnosis.statement)
        return diagnosis

    def _remember_errors(self) -> None:
        """Keep the versions' errors where the dashboard looks for them."""
        out = self.out
        lines = [
            VersionError(m.version, m.parent, m.effects, c.error_over_floor, c.rollouts, c.floor.from_replicates)
            for m, c in zip(out.models, out.errors.values(), strict=True)
        ]
        remember_errors(lines, out.store.folder("runs"), out.models[0].rig)

    def _add(self, model: Model, diagnosis: Diagnosis) -> Model:
        """The next version: with the effect that the verdict names, or the base model at its fitted parameters."""
        use = diagnosis.uses[0] if diagnosis.verdict == EFFECT else ""
        saved = self.out.store.save(adopt(model, use, diagnosis.to_json()))
        self.out.models.append(saved)
        what = f"has {use}" if use else "keeps its effects, with fitted parameters"
        means = zip(saved.parameters, saved.mean(), strict=True)
        values = ", ".join(with_unit(f"{p.name} {v:.3g}", p.unit) for p, v in means)
        self.say(f"{saved.version} {what}: {values}")
        if diagnosis.verdict == NOTHING_MISSING:
            self.say(f"{'nothing is missing' if diagnosis.reassuring else 'no effect is named'}: none is added")
        return saved


def _set_aside(bag: Path) -> None:
    """Put a spoilt bag where nobody takes it for one of the rollouts."""
    aside = bag.parent / "spoilt"
    aside.mkdir(exist_ok=True)
    bag.rename(aside / bag.name)


def mean_return(measurements: list[Measurement]) -> float:
    """Mean return of rollouts."""
    return float(np.mean([episode_reward(m).total for m in measurements]))


def tilt(measurements: list[Measurement]) -> float:
    """Mean final inclination in degrees."""
    return float(np.mean([np.degrees(inclination(m.attitude[-1])) for m in measurements if m.attitude is not None]))


def _told(found: Result) -> str:
    """The parameters with their 90 % intervals, and which of them the task's rollouts narrow."""
    if found.ess < LEAST_ESS or found.fits is None:
        return "too few simulations to tell"
    if not found.fits:
        return "the model fits the data too poorly to tell its parameters"
    values = "; ".join(f"{e.name} {e.mean:.3g} ({e.low90:.3g} to {e.high90:.3g})" for e in found.estimates)
    narrower = ", ".join(e.name for e in found.estimates if e.identified)
    return f"{values}; the task's rollouts narrow {narrower or 'none of them beyond what was known'}"


def busy() -> str:
    """A remedy where the machine has more to do than it can, which the graph's clocks do not bear; else ""."""
    load, processors = os.getloadavg()[0], len(os.sched_getaffinity(0))
    if load <= processors + 1:
        return ""
    return (
        f"; {load:.0f} processes want this machine's {counted(processors, 'processor')}: run the demo again when it "
        "has less to do"
    )
