"""Everything that is wrong with a user's own task file, one plain line each.

check_file(Path("my_task.py"))          # its task's name and [] where it is fit for use
"""

import dataclasses
import math
from pathlib import Path

import numpy as np

from tcbi_contract.names import JOINT_LIMIT, JOINTS, SLOPE_LIMIT
from tcbi_policy.environment import TIMESTEP_S
from tcbi_policy.gaits import Gait
from tcbi_policy.reward import DISTANCE, TRIAL_STEPS, Steps, distance_term, simulated_rewards
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.tasks import TASKS, Task, including
from tcbi_sim.user_file import UserFileError, apart, told
from tcbi_sim.user_tasks import UserTaskError, load_file

DRAWS, SIMULATIONS, TRIAL_S = 20, 4, 2.0


def check_file(path: Path) -> tuple[str | None, list[str]]:
    """Name of the task of a file, None if it holds none, and its faults: what it draws, and what its reward gives."""
    try:
        task = load_file(path)
    except UserTaskError as e:
        return None, list(e.faults)
    faults = [f"the name {task.name!r} is taken by a built-in task; choose another one"] if task.name in TASKS else []
    faults += _term_faults(task)
    try:
        faults += _draw_faults(task) or _memory_faults(task) or _trial_faults(task)
    except Exception as e:  # noqa: BLE001 - it is the user's code, which may raise anything
        faults.append(f"draw() or a term's measure, {told(e, path)}")
    return task.name, faults


def check_file_apart(path: Path) -> tuple[str | None, list[str]]:
    """The same in a process of its own, so that a file that ends its process, or never ends, has a fault like any."""
    try:
        return apart(check_file, path)
    except UserFileError as e:
        return None, e.faults


def _term_faults(task: Task) -> list[str]:
    faults = []
    for term in task.reward:
        faults += [
            f"term {term.name!r} has no {part}" for part in ("unit", "formula") if not getattr(term, part).strip()
        ]
        if not math.isfinite(term.weight) or term.weight == 0:
            faults.append(f"term {term.name!r}: weight is {term.weight}, allowed are finite numbers but 0")
        if term.name == DISTANCE and term.measure is not distance_term(1.0).measure:  # known from a rollout's end, in m
            faults.append(f"term {term.name!r} has the name of distance_term, but another measure; give another name")
    twice = sorted({t.name for t in task.reward if [s.name for s in task.reward].count(t.name) > 1})
    return faults + [f"term {name!r} is there twice; allowed is once" for name in twice]


def _draw_faults(task: Task) -> list[str]:
    for seed in range(DRAWS):
        scenario = task.draw(np.random.default_rng(seed), seed)
        if not isinstance(scenario, Scenario):
            return [f"draw() gives a {type(scenario).__name__}, allowed is a Scenario of tcbi_sim.measurement"]
        faults = _scenario_faults(task, scenario)
        if task.draw(np.random.default_rng(seed), seed) != scenario:
            faults.append("draw() gives another scenario for the same generator; take all chance from the generator")
        if faults:
            return faults
    return []


def _scenario_faults(task: Task, scenario: Scenario) -> list[str]:
    faults = [
        f"draw() gives {name} {seen!r}, the task's is {wanted!r}"
        for name, seen, wanted in (("task", scenario.task, task.name), ("duration", scenario.duration, task.duration))
        if seen != wanted
    ]
    slopes = (scenario.slope_roll, scenario.slope_pitch)
    if max(map(abs, slopes)) > SLOPE_LIMIT:
        faults.append(f"draw() gives a slope of {slopes} rad, allowed is -pi/6 to pi/6")
    posture = scenario.initial_joint_position or ()
    if any(abs(angle) > JOINT_LIMIT for angle in posture):
        faults.append("draw() gives an initial joint position beyond -pi/6 to pi/6 rad")
    if len(scenario.blocks) > task.blocks:
        faults.append(f"draw() places {len(scenario.blocks)} blocks, but the task says {task.blocks} at most")
    return faults


def _memory_faults(task: Task) -> list[str]:
    """Terms that give a step another value among others than by itself, as training asks for it."""
    rng = np.random.default_rng(0)
    action = rng.uniform(-JOINT_LIMIT, JOINT_LIMIT, (TRIAL_STEPS + 1, len(JOINTS)))
    attitude = np.column_stack([np.ones(TRIAL_STEPS + 1), rng.uniform(-0.1, 0.1, (TRIAL_STEPS + 1, 3))])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    progress = np.cumsum(rng.uniform(-0.01, 0.05, TRIAL_STEPS + 1))

    def of(begin: int, end: int) -> Steps:
        return Steps(
            attitude[begin : end + 1], progress[begin : end + 1], action[begin + 1 : end + 1], action[begin:end]
        )

    faults = []
    for term in task.reward:
        together = np.asarray(term.measure(of(0, TRIAL_STEPS)))
        if together.shape != (TRIAL_STEPS,):
            faults.append(f"term {term.name!r} measures {together.shape} values of {TRIAL_STEPS} steps, not one a step")
            continue
        alone = np.concatenate([np.asarray(term.measure(of(k, k + 1))) for k in range(TRIAL_STEPS)])
        if not np.allclose(together, alone, rtol=1e-9, equal_nan=True):
            faults.append(
                f"term {term.name!r} looks at more than one step: a step's value may follow from the attitude and the "
                "progress at its two ends, its action and the one before alone"
            )
    return faults


def _trial_faults(task: Task) -> list[str]:
    """Short rollouts in the training environment's simulation."""
    model, rng = base_model("hexapod"), np.random.default_rng(0)
    scenarios = [
        dataclasses.replace(task.draw(rng, i), duration=min(TRIAL_S, task.duration)) for i in range(SIMULATIONS)
    ]
    with including(task):
        values = model.sample(rng, SIMULATIONS)
        out = simulate(model, values, scenarios, controller=Gait("steps"), pairing="zip", timestep=TIMESTEP_S)
        rewards = simulated_rewards(out)[~out.diverged]
    faults = []
    if not np.isfinite(rewards).all():
        faults.append("the reward of a step is not finite in a simulation that is")
    if rewards.size and np.ptp(rewards) == 0:
        faults.append("the reward is the same in every step of a robot that moves; nothing can be learnt from it")
    return faults
