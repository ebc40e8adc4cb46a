"""The real rollouts of an inference: checked, grouped, and each group on its own time grid."""

import dataclasses
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_contract.wording import counted, some
from tcbi_infer.errors import InferError
from tcbi_infer.gaps import unusable
from tcbi_infer.spikes import without_spikes
from tcbi_infer.statistics import RolloutArrays, from_measurements
from tcbi_sim.measurement import Measurement, roll_pitch_yaw
from tcbi_sim.model import Model
from tcbi_sim.rig import Noise
from tcbi_sim.rigs import load_rig

ENOUGH = 8  # rollouts, below which rollouts are cut into blocks so that their scatter can be seen
LEAST_SAMPLES = 20
NOISIER = 3.0  # times the rig's noise: recordings as noisy as that are believed to be so
FINE_S = 0.02  # a gap is longer
MOST_SILENT = 0.05  # of a rollout
WHITE = -0.5  # autocorrelation of third differences, below which noise is white enough to be noise
SENSED = ("attitude", "angular_velocity", "contact")  # that a statistic is made of, and a rollout may lack
SIGNALS = ("joint_position", *SENSED, "linear_acceleration", "position")
STATE = {"joint_position": ("joint angles", "rad"), "attitude": ("attitudes", "rad"), "position": ("positions", "m")}
AVERAGE_S = 0.1  # that noisy signals are averaged over: half a control period, commands change no faster
TURNING_S = 1.0  # the same of attitudes, turned along by the body rates; a rate's bias of 1 degree/s is nothing in it
STRAY = 0.2  # share of the rollouts, up to which those that differ from the others are named


@dataclass(frozen=True)
class Group:
    """Rollouts that are simulated together: one task, one duration, one policy."""

    measurements: tuple[Measurement, ...]
    time: np.ndarray  # (T,) s, from 0
    recorded: RolloutArrays  # N = 1
    arrays: RolloutArrays  # the same, with signals averaged that are noisy

    @property
    def duration(self) -> float:
        """s."""
        return float(self.time[-1])


def checked(model: Model, measurements: Sequence[Measurement]) -> tuple[list[Measurement], list[str]]:
    """Usable rollouts of the model's rig, and what a user should know about them.

    Raises:
      InferError: rollouts of another rig, too few, without commands, or all identical.
    """
    warnings = []
    others = sorted({m.rig for m in measurements} - {model.rig})
    if others:
        wrong = [m.rollout_id for m in measurements if m.rig != model.rig]
        raise InferError(
            f"model {model.version} is of rig {model.rig}, but {some(wrong)} {_are(wrong)} of {', '.join(others)}; "
            "infer each rig's rollouts with a model of that rig"
        )
    measurements = [without_spikes(_finite(m)) for m in measurements]
    usable = [m for m in measurements if len(m.time) >= LEAST_SAMPLES and len(m.commands.time)]
    if len(usable) < len(measurements):
        short = [m.rollout_id for m in measurements if not (len(m.time) >= LEAST_SAMPLES and len(m.commands.time))]
        warnings.append(f"{some(short)} left out: fewer than {LEAST_SAMPLES} samples, or no command")
    torn = {m.rollout_id for m in usable if _torn(m)}
    if torn:
        warnings.append(f"{some(sorted(torn))} left out: samples, commands or a signal are missing in part")
        usable = [m for m in usable if m.rollout_id not in torn]
    lines, usable = _without_the_blind(usable)
    warnings += lines
    distinct = list({m.rollout_id: m for m in usable}.values())
    if len(distinct) < len(usable):
        warnings.append(
            f"{len(usable) - len(distinct)} bags hold a rollout that another one holds too; each counts once"
        )
    if len(distinct) < 2:
        raise InferError(
            f"{counted(len(distinct), 'usable rollout')}, at least 2 are needed to see how rollouts differ (20 "
            f"advised); record more{''.join(f'; {line}' for line in warnings)}"
        )
    first: dict[tuple[bytes | None, ...], Measurement] = {}
    for m in distinct:
        first.setdefault(_signals(m), m)
    unlike = list(first.values())
    if len(unlike) == 1:
        raise InferError(
            f"all {len(distinct)} rollouts are identical to the last bit, so nothing shows how the robot differs from "
            "itself; record rollouts with other seeds or slopes"
        )
    if copies := len(distinct) - len(unlike):
        warnings.append(
            f"{counted(copies, 'rollout')} left out: another one again to the last bit, which tells nothing new"
        )
    return unlike, warnings + _mixture(unlike)


def _finite(m: Measurement) -> Measurement:
    """The same, with NaN, which stands for no reading, where a reading is infinite."""
    signals = {name: getattr(m, name) for name in SIGNALS}
    endless: dict[str, Any] = {
        name: np.where(np.isinf(values), np.nan, values)
        for name, values in signals.items()
        if values is not None and values.dtype.kind == "f" and np.isinf(values).any()
    }
    return dataclasses.replace(m, **endless)


def _signals(m: Measurement) -> tuple[bytes | None, ...]:
    """All that was measured in a rollout, to the last bit."""
    signals = (getattr(m, name) for name in SIGNALS)
    return tuple(None if values is None else values.tobytes() for values in signals)


def _without_the_blind(measurements: list[Measurement]) -> tuple[list[str], list[Measurement]]:
    """Rollouts without the few that lack a signal that most have: they would take its statistics from all."""
    lines, kept = [], measurements
    for name in SENSED:
        blind = [m.rollout_id for m in kept if getattr(m, name) is None]
        if 0 < len(blind) <= len(measurements) / 3:
            lines.append(f"{some(blind)} left out: no {name.replace('_', ' ')} was recorded, which the others have")
            kept = [m for m in kept if m.rollout_id not in blind]
    return lines, kept


def _torn(m: Measurement) -> bool:
    """Whether samples or commands are missing in it, or a signal for more than `MOST_SILENT` of it."""
    found = unusable(m, np.arange(m.time[0], m.time[-1], FINE_S))
    unread = np.isnan(m.joint_position).any(axis=1).mean() > MOST_SILENT
    return bool(unread or found.samples.any()) or any(lost.mean() > MOST_SILENT for lost in found.signals.values())


def _mixture(measurements: Sequence[Measurement]) -> list[str]:
    found = []
    for kind, of, how, apart in (
        ("tasks", lambda m: m.scenario.task, ": their distributions are pooled", True),
        ("sources", lambda m: m.source, ", in one posterior", True),
        ("policies", lambda m: m.policy_id, "", False),
    ):
        seen = {m.rollout_id: of(m) for m in measurements}
        if len(several := sorted(set(seen.values()))) > 1:
            found.append(f"rollouts of several {kind} ({some(several)}) are taken together{how}{_strays(seen, apart)}")
    if len(measurements) < ENOUGH:
        found.append(
            f"only {len(measurements)} rollouts: each is cut into {blocks_for(len(measurements))} blocks to judge the "
            "scatter, which misses what differs between rollouts only; record 20 for a posterior to rely on"
        )
    return found


def _strays(seen: Mapping[str, str], apart: bool) -> str:
    """Which rollouts differ from nearly all others, of rollout -> what it is of, and what to do if they are `apart`."""
    ((usual, count),) = Counter(seen.values()).most_common(1)
    odd = len(seen) - count
    if odd > STRAY * len(seen) and not (odd == 1 and len(seen) > 2):
        return "; infer from each apart if they shall not be" if apart else ""
    strays = some([r for r, what in seen.items() if what != usual])
    said = f"; all but {strays} are of {usual or 'an unnamed one'}"
    return f"{said}: leave {strays} out, or infer from them apart" if apart else said


def blocks_for(rollouts: int) -> int:
    """Blocks that each rollout is cut into, so that there are at least `ENOUGH` units to resample."""
    return -(-ENOUGH // rollouts)


def sample_rate(model: Model, measurements: Sequence[Measurement], closed_loop: bool) -> float:
    """The rig's rate, or an integer fraction of it where the recordings are slower (Hz).

    In closed loop it is one with whole samples in a control period.
    """
    recorded = min(float(1 / np.median(np.diff(m.time))) for m in measurements)
    rate = load_rig(model.rig).rate
    rates = [rate / n for n in range(max(1, round(rate / recorded)), 0, -1)]
    fitting = [r for r in rates if not closed_loop or abs(r * CONTROL_PERIOD_S - round(r * CONTROL_PERIOD_S)) < 1e-6]
    return next(iter(fitting), rate)


def grouped(measurements: Sequence[Measurement], rate: float, acting: Container[str]) -> list[Group]:
    """Rollouts of one task and nearly one duration (0.5 s) together, cut to the shortest of them.

    Args:
      measurements: the real rollouts.
      rate: of the groups' time grids (Hz).
      acting: ids of the policies that act in closed loop; rollouts of each are a group of their own.
    """
    groups: dict[tuple, list[Measurement]] = {}
    for m in measurements:
        end = min(m.scenario.duration, float(m.time[-1]))
        key = (m.scenario.task, round(2 * end), m.commands.ramp, m.policy_id if m.policy_id in acting else "")
        groups.setdefault(key, []).append(m)
    return [_group(members, rate) for _, members in sorted(groups.items(), key=lambda item: str(item[0]))]


def _group(members: list[Measurement], rate: float) -> Group:
    end = min(min(m.scenario.duration, float(m.time[-1]) + 0.5 / rate) for m in members)
    time = np.arange(int(np.floor(end * rate + 1e-6)) + 1) / rate
    cut = [_until(m, float(time[-1])) for m in members]
    arrays = from_measurements(cut, time)
    return Group(tuple(cut), time, arrays, arrays)


def _until(m: Measurement, duration: float) -> Measurement:
    inside = m.commands.time < duration - 1e-9
    power = m.commands.torque_on
    commands = dataclasses.replace(
        m.commands,
        time=m.commands.time[inside],
        target=m.commands.target[inside],
        torque_on=None if power is None else power[inside],
    )
    cut = min(m.scenario.duration, float(m.time[-1])) - duration
    distance = m.distance if cut < CONTROL_PERIOD_S + 1e-6 else np.nan  # it was read at the end
    scenario = dataclasses.replace(m.scenario, duration=duration)
    return dataclasses.replace(m, commands=commands, scenario=scenario, distance=distance)


def sensor_noise(measurements: Sequence[Measurement], nominal: Noise) -> Noise:
    """Noise for simulated readings: the rig's, less if the recordings show less, more if they show much more.

    More is taken only for noise where it is white: slow sampling leaves motion in the differences, too.

    Body rates are not smooth where feet strike: their noise is never taken for more than the rig's.
    """

    def state(signals: Sequence[np.ndarray | None], sd: float, turn: float = np.inf) -> float:
        found = _white(signals, turn)
        return found if found > NOISIER * sd and _looks_white(signals, turn) else min(sd, found)

    tilts = [None if m.attitude is None else roll_pitch_yaw(m.attitude)[:, :2] for m in measurements]
    places = [None if m.position is None else m.position[:, :2] for m in measurements]  # height enters no reward
    return Noise(
        joint_position=state([m.joint_position for m in measurements], nominal.joint_position),
        attitude=state(tilts, nominal.attitude, turn=2 * np.pi),
        angular_velocity=min(nominal.angular_velocity, _white([m.angular_velocity for m in measurements])),
        position=state(places, nominal.position),
        encoder_step=_encoder_step([m.joint_position for m in measurements], nominal.encoder_step),
    )


def noise_kept(groups: Sequence[Group]) -> float:
    """Share of the readings' white noise (standard deviation) that is left on the groups' time grids.

    Between two samples, at a share f of the way, linear interpolation leaves (1 - f)^2 + f^2 of its variance.
    """
    left = []
    for group in groups:
        for m in group.measurements:
            at = np.clip(np.interp(group.time, m.time, np.arange(len(m.time))), 0, len(m.time) - 1)
            share = at - np.floor(at)
            left.append((1 - share) ** 2 + share**2)
    return float(np.sqrt(np.mean(np.concatenate(left))))


def _white(signals: Sequence[np.ndarray | None], turn: float = np.inf) -> float:
    """Standard deviation of the white noise on (T, D) signals, of which angles repeat after a `turn`.

    Third differences of smooth signals leave little but noise; the median is taken, since motion can only add to it.
    """
    thirds = _thirds(signals, turn)
    spread = [np.nanmedian(np.abs(third)) / (0.6745 * np.sqrt(20.0)) for third in thirds]
    return float(np.median(spread)) if spread else 0.0


def _looks_white(signals: Sequence[np.ndarray | None], turn: float = np.inf) -> bool:
    """Whether neighbouring third differences go against each other: by -0.75 in white noise, hardly in motion."""
    found = []
    for third in _thirds(signals, turn):
        limit = 3.0 * np.nanmedian(np.abs(third), axis=0) / 0.6745
        kept = np.clip(np.nan_to_num(third), -limit, limit)
        square = (kept**2).sum(axis=0)
        told = square > 0
        found += ((kept[1:] * kept[:-1]).sum(axis=0)[told] / square[told]).tolist()
    return bool(found) and float(np.median(found)) < WHITE


def _thirds(signals: Sequence[np.ndarray | None], turn: float) -> list[np.ndarray]:
    """Third differences of (T, D) signals, of which angles repeat after a `turn`."""
    thirds = [np.diff(values, n=3, axis=0) for values in signals if values is not None and len(values) > 4]
    if np.isfinite(turn):
        thirds = [(third + turn / 2) % turn - turn / 2 for third in thirds]
    return thirds


def _encoder_step(joints: Sequence[np.ndarray], step: float) -> float:
    """The rig's encoder step (rad) if recorded (T, J) joint angles move in whole ones, else 0."""
    if step <= 0:
        return 0.0
    moves = np.concatenate([np.diff(values, axis=0).ravel() for values in joints]) / step
    moves = moves[np.abs(moves) > 0.5]
    return step if moves.size and np.median(np.abs(moves - np.rint(moves))) < 0.01 else 0.0


def noisy_signals(noise: Noise, nominal: Noise) -> tuple[str, ...]:
    """Signals that are much noisier than the rig's sensors, as fields of `Noise` and `RolloutArrays`."""
    return tuple(name for name in STATE if getattr(noise, name) > getattr(nominal, name))


def noisier(noise: Noise, nominal: Noise) -> list[str]:
    """A line for each of them."""
    return [
        f"{STATE[name][0]} are recorded with a noise of {getattr(noise, name):.2g} {STATE[name][1]} where the rig has "
        f"{getattr(nominal, name):.2g}; simulated readings get as much, and both are averaged over {AVERAGE_S} s"
        + f" (over {TURNING_S} s, turned along by the body rates, where these were recorded)"
        * (name == "attitude")
        for name in noisy_signals(noise, nominal)
    ]


def _are(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"
