"""Scripted gaits: open-loop plans of joint targets, one row each control period of 0.2 s.

They are the fallback (`stand`), the yardstick of a trained walk (`tripod`), and the excitation from which physical
parameters are identified (`excite` and its parts). A plan depends on the name and its seed alone: `gait:steps` is the
same motion whenever it runs, so that two runs of it are replicates; `gait:steps:7` is another one.

    gait = Gait("tripod")
    gait.act(time=0.4, observation)      # (B, 18) rad
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S, JOINT_LIMIT, LEGS
from tcbi_policy.errors import PolicyNotFound
from tcbi_policy.kinematics import from_hips, inverse, neutral_feet

MAX_CHANGE = 0.6  # rad a control period, thus 3 rad/s: half of the servo's speed without load
TRIPOD = np.array([leg in ("lf", "rm", "lr") for leg in LEGS])  # these legs against the other three
PLAN_TICKS = 300  # 60 s; a longer rollout starts over

Plan = Callable[[np.random.Generator], np.ndarray]  # -> (n, 18) rad, repeated when it ends


@dataclass(frozen=True)
class Gait:
    """A scripted gait as a controller for the simulation and the policy node.

    Raises:
      PolicyNotFound: there is no gait of this name, or the seed is no number.
    """

    name: str  # as in GAITS, with an optional ":seed"
    needs_attitude: bool = False
    targets: np.ndarray = field(init=False, repr=False)  # (n, 18) rad

    def __post_init__(self) -> None:
        base, _, seed = self.name.partition(":")
        if base not in GAITS or not (seed.isdigit() or not seed):
            known = ", ".join(GAITS)
            raise PolicyNotFound(f"gait {self.name!r} does not exist; there are {known}, each also as <name>:<seed>")
        plan = GAITS[base](np.random.default_rng([int(seed or 0), *base.encode()]))
        object.__setattr__(self, "targets", _safe(plan))

    @property
    def policy_id(self) -> str:
        """The reference that loads this gait."""
        return f"gait:{self.name}"

    def reset(self, count: int, rng: np.random.Generator | None = None) -> None:
        """A plan has no state."""

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """Joint targets (B, 18) in rad at `time` (s since the start); only the batch size of the observation counts."""
        tick = round(time / CONTROL_PERIOD_S) % len(self.targets)
        return np.tile(self.targets[tick], (len(observation), 1))


def _safe(plan: np.ndarray) -> np.ndarray:
    """The plan (n, 18) within the joint range, starting from the neutral stance, no faster than `MAX_CHANGE`."""
    targets = np.clip(plan, -JOINT_LIMIT, JOINT_LIMIT)
    previous = np.zeros(targets.shape[1])
    for k, target in enumerate(targets):
        targets[k] = previous = previous + np.clip(target - previous, -MAX_CHANGE, MAX_CHANGE)
    return targets


def _repeat(cycle: np.ndarray, lead: np.ndarray | None = None) -> np.ndarray:
    """A plan that repeats a cycle (n, 18) after an optional lead-in."""
    rows = [] if lead is None else [lead]
    return np.concatenate([*rows, np.tile(cycle, (-(-PLAN_TICKS // len(cycle)), 1))])[:PLAN_TICKS]


def walk(stroke: float, lift: float, half: int = 2, direction: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """One cycle (2 half, 18) of a tripod walk, rad.

    Three feet move back along the ground by `stroke` while the other three lift and swing forward; then they change.

    Args:
      stroke: m that the trunk advances each half cycle.
      lift: m that a swinging foot rises.
      half: control periods of half a cycle, at least 2.
      direction: rad from straight ahead.
      turn: rad that the trunk turns each half cycle.
    """
    home = neutral_feet()
    rows = []
    for tick in range(2 * half):
        feet = home.copy()
        for leg in range(6):
            swings = (tick < half) == TRIPOD[leg]
            part = (tick % half) / half  # of this half cycle that has passed
            along = (part - 0.5) if swings else (0.5 - part)
            angle = along * turn
            x, y = home[leg, 0], home[leg, 1]
            feet[leg, 0] = x * np.cos(angle) - y * np.sin(angle) + along * stroke * np.cos(direction)
            feet[leg, 1] = x * np.sin(angle) + y * np.cos(angle) + along * stroke * np.sin(direction)
            feet[leg, 2] += lift * np.sin(np.pi * part) if swings else 0.0
        rows.append(inverse(feet))
    return np.array(rows)


def stride(stroke: float, lift: float, outward: float, rise: float) -> np.ndarray:
    """One cycle (4, 18) of a tripod walk that steps over obstacles, rad.

    Within the joints' range a foot comes up by 4 cm where it stands; swung outwards it comes up by 10 cm and more. In
    the first control period of half a cycle three feet go up, outwards and half the way forward, in the second down.

    Args:
      stroke: m that the trunk advances each half cycle.
      lift: m that a swinging foot rises.
      outward: m that it swings out, away from its hip.
      rise: m that the trunk stands higher than in the neutral stance.
    """
    home = neutral_feet() - [0.0, 0.0, rise]
    ahead, out = np.array([stroke, 0.0, 0.0]), outward * from_hips() + [0.0, 0.0, lift]
    swings = np.where(TRIPOD, 1.0, -1.0)[:, None]
    rows = []
    for sign in (swings, -swings):  # of the foot's way: those that swing go forward, the others back
        rows.append(inverse(home + np.where(sign > 0, out, 0.0)))
        rows.append(inverse(home + 0.5 * sign * ahead))
    return np.array(rows)


def lean(
    roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0, rise: float = 0.0, shift: tuple[float, float] = (0, 0)
) -> np.ndarray:
    """Joint angles (18,) in rad that turn (rad), raise and shift (m) the trunk over standing feet."""
    feet = neutral_feet()
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    moved = feet - np.array([*shift, rise])
    return inverse(moved @ (about_z @ about_y @ about_x))


def _stand(rng: np.random.Generator) -> np.ndarray:
    return np.zeros((1, 18))


def _dither(rng: np.random.Generator) -> np.ndarray:
    """Small smooth random motion of every joint about the neutral stance."""
    noise = rng.normal(size=(PLAN_TICKS, 18))
    for k in range(1, PLAN_TICKS):
        noise[k] = 0.7 * noise[k - 1] + np.sqrt(1 - 0.7**2) * noise[k]
    return 0.12 * noise


def _steps(rng: np.random.Generator) -> np.ndarray:
    """Random postures, each held for 0.6 to 1.4 s: what settles, overshoots and lags shows."""
    rows: list[np.ndarray] = []
    while len(rows) < PLAN_TICKS:
        posture = rng.uniform(-0.35, 0.35, 18)
        rows += [posture] * int(rng.integers(3, 8))
    return np.array(rows[:PLAN_TICKS])


def _sinus(rng: np.random.Generator) -> np.ndarray:
    """Every joint on a sine of its own frequency (0.15 to 0.6 Hz) and phase, 0.2 rad high."""
    time = np.arange(PLAN_TICKS)[:, None] * CONTROL_PERIOD_S
    frequency = rng.permutation(np.linspace(0.15, 0.6, 18))
    return 0.2 * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi, 18))


def _chirp(rng: np.random.Generator) -> np.ndarray:
    """The trunk rolls, pitches and heaves over standing feet, from 0.1 to 1 Hz in 10 s, then over again."""
    time = np.arange(50) * CONTROL_PERIOD_S
    phase = 2 * np.pi * (0.1 * time + 0.5 * (1.0 - 0.1) / 10.0 * time**2)
    rows = [lean(0.15 * np.sin(p), 0.12 * np.cos(p), 0.0, 0.015 * np.sin(2 * p)) for p in phase]
    return _repeat(np.array(rows))


def _squat(rng: np.random.Generator) -> np.ndarray:
    """Down slowly, hold, up at once, hold: static load, then a jerk that friction and delay answer differently."""
    low, high = lean(rise=-0.035), lean(rise=0.02)
    down = [high + (low - high) * part for part in np.linspace(0.2, 1.0, 5)]
    return _repeat(np.array([*down, low, low, low, high, high, high, high]))


def _twist(rng: np.random.Generator) -> np.ndarray:
    """The trunk turns and shifts over standing feet until they slip: what tells the friction of the ground."""
    phase = 2 * np.pi * np.arange(8) / 8
    return _repeat(np.array([lean(yaw=0.35 * np.sin(p), shift=(0.03 * np.cos(p), 0.02 * np.sin(p))) for p in phase]))


def _excite(rng: np.random.Generator) -> np.ndarray:
    """All of the excitations in turn, 1.6 s each, so that one balance rollout of 8 s holds five of them."""
    parts = [_steps(rng), CYCLES["tripod"], _chirp(rng)[8:], _twist(rng), _squat(rng), _sinus(rng), _dither(rng)]
    rows: list[np.ndarray] = []
    for start in range(0, PLAN_TICKS, 8):
        part = parts[(start // 8) % len(parts)]
        rows += [part[(start + k) % len(part)] for k in range(8)]
    return np.array(rows[:PLAN_TICKS])


def _cyclic(name: str) -> Plan:
    return lambda rng: _repeat(CYCLES[name])


CYCLES: dict[str, np.ndarray] = {  # (n, 18) rad
    "tripod": walk(stroke=0.08, lift=0.05),
    "tripod_slow": walk(stroke=0.08, lift=0.05, half=3),
    "backward": walk(stroke=-0.08, lift=0.05),
    "turn": walk(stroke=0.0, lift=0.05, turn=0.3),
    "stride": stride(stroke=0.14, lift=0.11, outward=0.08, rise=0.016),
}

GAITS: dict[str, Plan] = {
    "stand": _stand,
    **{name: _cyclic(name) for name in CYCLES},
    "excite": _excite,
    "steps": _steps,
    "dither": _dither,
    "sinus": _sinus,
    "chirp": _chirp,
    "squat": _squat,
    "twist": _twist,
}
