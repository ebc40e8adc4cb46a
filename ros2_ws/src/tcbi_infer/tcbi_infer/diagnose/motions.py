"""Motions that are ready to be recorded: scripted gaits for a robot that has them, else plans within what was seen.

for motion in ready_motions(rig, measurements):
    motion.name, motion.commands, motion.scenario, motion.command
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S, JOINTS
from tcbi_infer.collection import Request, scenario_of
from tcbi_infer.errors import InferError
from tcbi_policy.gaits import GAITS, Gait
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.rig import Rig

DRAWN = ("excite", "steps", "dither", "sinus")  # gaits of which every seed is another motion
STILL = ("stand",)
TASK = "balance"  # on a plain slope, without blocks
GAITS_TO_LEARN = ("steps", "sinus", "tripod", "squat", "twist")
SLOPE, TURN = 0.12, 2.4  # rad: of the ground, and between the directions in which it falls under one gait and the next
SHORTEST_S, LONGEST_S = 2.0, 8.0
LEAST_COMMANDS = 40  # of a plan, however slowly the recordings were commanded
STANDING_REACH = 0.25  # rad, either side of the posture
GENTLE = 0.8  # of the largest position and speed seen
WORDS = {
    "sweep": "slowly from one end to the other and back",
    "hold": "four places, each reached in a ramp and held",
    "steps": "random places, each held for a moment and left at once",
    "chirp": "a sine that grows faster from beginning to end",
    "sinus": "slow sines, each joint its own",
    "reversals": "small strokes to and fro about the middle",
}


@dataclasses.dataclass(frozen=True)
class Motion:
    """A motion that can be commanded.

    Attributes:
      name: "gait:twist", or of the plans in `WORDS`.
      description: in words.
      command: of the shell, that records it twice; "" where the rig has no recorder of its own here.
      policy_id: of the policy that commands it; None where that has the motion's name.
    """

    name: str
    description: str
    scenario: Scenario
    commands: Commands
    command: str = ""
    policy_id: str | None = None


def ready_motions(rig: Rig, measurements: Sequence[Measurement]) -> list[Motion]:
    """What could be recorded next with a rig, other than what was recorded already.

    Args:
      rig: the robot or bench.
      measurements: rollouts of it: they give ground, length, and the limits of plans.
    """
    duration = float(np.clip(np.median([m.scenario.duration for m in measurements]), SHORTEST_S, LONGEST_S))
    duration = max(round(duration / CONTROL_PERIOD_S), 1) * CONTROL_PERIOD_S
    if rig.joint_names == JOINTS:
        first = measurements[0].scenario
        seen = {m.policy_id for m in measurements}
        return [gait_motion(name, first.slope_roll, first.slope_pitch, duration) for name in _unseen_gaits(seen)]
    return _plans(rig, measurements, duration)


def _unseen_gaits(seen: set[str]) -> list[str]:
    names = []
    for name in GAITS:
        variants = [name, *(f"{name}:{seed}" for seed in range(1, 100) if name in DRAWN)]
        fresh = [v for v in variants if f"gait:{v}" not in seen]
        if name not in STILL and fresh:
            names.append(fresh[0])
    return names


def gait_motion(name: str, slope_roll: float, slope_pitch: float, duration: float, seed: int = 0) -> Motion:
    """A scripted gait on a slope (rad), as `./tcbi collect` records it."""
    request = Request(TASK, 1, seed, slope_roll=(slope_roll,), slope_pitch=(slope_pitch,), duration_s=duration)
    time = np.arange(round(duration / CONTROL_PERIOD_S)) * CONTROL_PERIOD_S
    targets = Gait(name).targets
    commands = Commands(time, targets[np.arange(len(time)) % len(targets)])
    command = (
        f"for again in 1 2; do ./tcbi collect --task {TASK} --policy gait:{name} --duration {duration:g} --seed {seed} "
        f"--slope-roll {slope_roll:.4g} --slope-pitch {slope_pitch:.4g} --out rollouts; done"
    )
    words = (GAITS[name.partition(":")[0]].__doc__ or f"{name.partition(':')[0].replace('_', ' ')} gait").split(":")[0]
    return Motion(f"gait:{name}", words.strip().rstrip("."), scenario_of(request, 0), commands, command)


def _plans(rig: Rig, measurements: Sequence[Measurement], duration: float) -> list[Motion]:
    """Plans for a rig without gaits, within positions (or torques) and speeds of the recorded commands."""
    first = measurements[0]
    targets = np.concatenate([m.commands.target for m in measurements])
    intervals = np.concatenate([np.diff(m.commands.time) for m in measurements])
    recorded = float(np.median(intervals)) if len(intervals) else CONTROL_PERIOD_S
    period = min(recorded, duration / LEAST_COMMANDS)
    low, high = targets.min(axis=0), targets.max(axis=0)
    if not np.any(high > low):
        return []  # a rig that was let go, not driven
    changes = [np.abs(np.diff(m.commands.target, axis=0)).reshape(-1, len(low)) for m in measurements]
    fastest = np.concatenate([*changes, np.zeros((1, len(low)))]).max(axis=0)
    middle, reach = (low + high) / 2, GENTLE * (high - low) / 2
    start = tuple(map(float, middle)) if rig.kind == "position" else first.scenario.initial_joint_position
    scenario = dataclasses.replace(
        first.scenario, duration=duration, initial_joint_position=start, initial_joint_velocity=None
    )
    return planned(scenario, middle, reach, GENTLE * fastest * period / recorded, period, first.commands.ramp)


def planned(
    scenario: Scenario,
    middle: np.ndarray,
    reach: np.ndarray,
    fastest: np.ndarray,
    period: float = CONTROL_PERIOD_S,
    ramp: float = CONTROL_PERIOD_S,
) -> list[Motion]:
    """Every plan within `reach` (J,) rad of `middle`, no faster than `fastest` (J,) rad a command."""
    duration = scenario.duration
    time = np.arange(round(duration / period)) * period
    motions = []
    for name, plan in plans(np.random.default_rng(0)).items():
        wanted, last = middle + reach * plan(time / duration, len(middle)), middle
        for k, target in enumerate(wanted):
            wanted[k] = last = last + np.clip(target - last, -fastest, fastest)
        motions.append(Motion(name, WORDS[name], scenario, Commands(time, wanted, ramp)))
    return motions


def standard_motions(rig: Rig, duration: float) -> list[Motion]:
    """Motions for a rig of which nothing was recorded: gaits on slopes, or plans about its posture.

    A rig that is fixed moves over half of its joints' range, one that stands free as far as it stays on its feet.

    Raises:
      InferError: the rig is driven by torque, of which it does not say how much is safe.
    """
    if rig.joint_names == JOINTS:
        return [
            gait_motion(name, SLOPE * float(np.cos(TURN * i)), SLOPE * float(np.sin(TURN * i)), duration)
            for i, name in enumerate(GAITS_TO_LEARN)
        ]
    if rig.kind != "position":
        raise InferError(f"the rig {rig.name!r} is driven by torque and has no motions of its own; give bags of it")
    joints, rest = len(rig.joint_names), rig.at_rest
    reach = np.full(joints, STANDING_REACH if rig.floating else min(0.5 * rig.joint_range, 1.0))
    fastest = np.full(joints, 0.5 * rig.speed_limit * CONTROL_PERIOD_S)
    start = tuple(map(float, rest))
    scenario = Scenario("selftest", duration, settle=1.0 if rig.floating else 0.0, initial_joint_position=start)
    return planned(scenario, rest, reach, fastest)


Plan = Callable[[np.ndarray, int], np.ndarray]  # (K,) share of the time gone, joints -> (K, J) between -1 and 1


def plans(rng: np.random.Generator) -> dict[str, Plan]:
    """Plans by name; joints of a rig with several move at their own pace, so that they can be told apart."""

    def held(share: np.ndarray, joints: int, places: np.ndarray) -> np.ndarray:
        return places[np.minimum((share * len(places)).astype(int), len(places) - 1)][:, :joints]

    def sine(share: np.ndarray, joints: int, cycles: float, growth: float = 0.0) -> np.ndarray:
        pace = np.linspace(0.7, 1.0, joints) if joints > 1 else np.ones(1)
        phase = 2 * np.pi * pace * (cycles * share + growth * share**2)[:, None]
        return np.sin(phase + np.arange(joints))

    def ramped(share: np.ndarray, joints: int) -> np.ndarray:
        corners = np.array([0.0, 0.08, 0.25, 0.33, 0.5, 0.58, 0.75, 0.83, 1.0])
        places = np.array([0.0, 1.0, 1.0, 0.4, 0.4, -0.4, -0.4, -1.0, -1.0])
        signs = np.where(np.arange(joints) % 2, -1.0, 1.0)
        return np.interp(share, corners, places)[:, None] * signs

    random = rng.uniform(-1, 1, (9, 64))
    strokes = 0.25 * np.where(np.arange(24) % 2, 1.0, -1.0)[:, None] * np.ones((1, 64))
    return {
        "sweep": lambda share, joints: (2 / np.pi) * np.arcsin(sine(share, joints, 1.0)),
        "hold": ramped,
        "steps": lambda share, joints: held(share, joints, random),
        "chirp": lambda share, joints: sine(share, joints, 0.5, 4.0),
        "sinus": lambda share, joints: 0.8 * sine(share, joints, 2.0),
        "reversals": lambda share, joints: held(share, joints, strokes),
    }
