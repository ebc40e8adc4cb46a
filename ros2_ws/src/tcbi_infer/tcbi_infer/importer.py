"""Logs of other formats, JSON or CSV, as measurements: what a small mapping file says of their columns.

    mapping = load_mapping("xl330_bench")             # a built-in mapping, or the path of a TOML file
    measurement = read_log(mapping, Path("kp100_sin_sin.json"))

A log is a file, or a folder of files (say, commands and states apart). docs/bags.md describes the mapping file.
Repeated and backward time stamps are put in order, and said, as in any bag; so is what is left out.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tcbi_contract.wording import counted
from tcbi_infer.bags.streams import ordered
from tcbi_infer.body_log import body_signals
from tcbi_infer.errors import MappingError
from tcbi_infer.log_tables import Tables, numbers, rows_of, stamps
from tcbi_infer.mapping import Mapping
from tcbi_infer.pieces import pieces
from tcbi_infer.readings import Readings, within
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.rigs import load_rig

STANDS_S = 1.0  # s in which a free robot settles in its first posture, before a log begins


def read_log(mapping: Mapping, log: Path) -> Measurement:
    """One log as one rollout.

    Raises:
      MappingError: the log cannot be read, or is not what the mapping says; everything wrong at once where possible.
    """
    notes: list[str] = []
    tables = Tables(mapping, log, notes)
    position = mapping.position
    stamp = stamps(tables, position)
    order = ordered(position.columns[0], stamp, notes)
    rows = rows_of(tables, position, len(mapping.joints))[order]
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        notes.append(f"{int(np.sum(~finite))} samples hold no number and are left out")
    order, rows = order[finite], rows[finite]
    if len(order) < 2:
        because = f" ({'; '.join(notes)})" if notes else ""
        raise MappingError(
            f"{log}: holds {len(order)} samples with a time and a position, at least 2 are needed{because}"
        )
    zero = int(stamp[order[0]])
    time = (stamp[order] - zero) / 1e9
    commands = _commands(tables, mapping, zero, int(stamp[order[-1]]), rows[0], notes)
    readings = within(_readings(tables, mapping, zero), 0.0, float(time[-1]))
    free = load_rig(mapping.rig).floating
    held = len(commands.time) and commands.time[0] <= 0 and not mapping.torque_commands  # by the command in force
    body = body_signals(tables, mapping, zero, time, notes)
    return Measurement(
        rollout_id=rollout_name(log),
        rig=mapping.rig,
        scenario=Scenario(
            task=mapping.task,
            duration=float(time[-1]),
            initial_joint_position=tuple(float(x) for x in (commands.target[0] if free and held else rows[0])),
            settle=STANDS_S if free else 0.0,
            constants=_constants(mapping, tables),
        ),
        policy_id=mapping.policy_id,
        source=mapping.source,
        commands=commands,
        joint_names=mapping.joints,
        foot_names=mapping.feet,
        time=time,
        joint_position=rows,
        notes=tuple(notes),
        readings=readings,
        **body,
    )


def read_rollouts(mapping: Mapping, log: Path) -> list[Measurement]:
    """One log as one rollout, or as the pieces that the mapping cuts it into; raises as `read_log`."""
    whole = read_log(mapping, log)
    return pieces(whole, mapping.window) if mapping.window else [whole]


def rollout_name(log: Path) -> str:
    """A log's name without its endings."""
    name = log.name
    for suffix in (".gz", ".json", ".csv"):
        name = name.removesuffix(suffix)
    return name


def _commands(tables: Tables, mapping: Mapping, zero: int, end: int, start: np.ndarray, notes: list[str]) -> Commands:
    """The commands on the rollout's clock, from `zero` to before `end` (ns).

    One that repeats the command before it says nothing and is left out.

    Args:
      start: (J,) the first measured position, rad.
    """
    signal, none = mapping.command, Commands(np.empty(0), np.empty((0, len(mapping.joints))))
    if signal is None:
        notes.append("the mapping names no command: nothing can be simulated again with the same commands")
        return none
    stamp = stamps(tables, signal)
    target = rows_of(tables, signal, len(mapping.joints))
    flag = _torque_flags(tables, mapping, len(stamp))
    there = np.isfinite(target).all(axis=1) | (flag <= 0.5)  # loggers give a limp servo no goal; its flag must stay
    if not there.all():
        notes.append(f"{signal.columns[0]}: left out {counted(int(np.sum(~there)), 'command')} without a number")
    order = np.flatnonzero(there)[ordered(signal.columns[0], stamp[there], notes)]
    stamp, on = stamp[order], flag[order] > 0.5
    if mapping.torque_commands:
        target = np.where(np.isfinite(target[order]), target[order], 0.0)  # a limp motor has none
    else:
        target = _carried(target[order], start)
    effective = stamp < end
    stamp, target, on = stamp[effective], target[effective], on[effective]
    if not stamp.size:
        notes.append("no command before the last sample: nothing can be simulated again with the same commands")
        return none
    started = np.flatnonzero(stamp <= zero)
    if started.size:  # what was in force when the first sample was taken
        stamp, target, on = stamp[started[-1] :].copy(), target[started[-1] :], on[started[-1] :]
        stamp[0] = zero
    new = np.concatenate([[True], np.any(np.diff(target, axis=0) != 0, axis=1) | (np.diff(on) != 0)])
    if mapping.ramp:
        new[:] = True  # a repeated command starts a ramp of its own
    return Commands((stamp[new] - zero) / 1e9, target[new], mapping.ramp, None if on.all() else on[new])


def _carried(target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Targets (N, J) in the order of time; what is no number becomes the joint's last one, before any `start`."""
    told = np.vstack([start, target])
    last = np.maximum.accumulate(np.where(np.isfinite(told), np.arange(len(told))[:, None], 0), axis=0)
    return np.take_along_axis(told, last, axis=0)[1:]


def _torque_flags(tables: Tables, mapping: Mapping, count: int) -> np.ndarray:
    """(N,) above 0.5 where the servos are powered; NaN where the log does not say."""
    if mapping.torque_on is None:
        return np.ones(count)
    values = numbers(tables, mapping.torque_on, mapping.torque_on.columns[0])
    if len(values) != count:
        raise MappingError(f"{tables.log}: {len(values)} torque flags for {count} commands; they must be in one file")
    return values


def _readings(tables: Tables, mapping: Mapping, zero: int) -> Readings:
    """Temperatures and voltages on the rollout's clock; rows without a number are no readings."""
    found: Readings = {}
    for key, signal in mapping.readings:
        values = numbers(tables, signal, signal.columns[0]) * np.asarray(signal.scale)
        stamp = stamps(tables, signal)
        there = np.isfinite(values)
        order = ordered(key, stamp[there], [])
        found[key] = (stamp[there][order] - zero) / 1e9, values[there][order]
    return found


def _constants(mapping: Mapping, tables: Tables) -> tuple[tuple[str, float], ...]:
    header = tables.header()
    found = []
    faults = []
    for name, value in mapping.constants:
        if isinstance(value, str):
            if not isinstance(header.get(value), (int, float)):
                faults.append(f"constant {name!r}: the log has no number under {value!r}")
                continue
            value = header[value]
        found.append((name, float(value)))
    if faults:
        raise MappingError(
            f"{tables.log}: {'; '.join(faults)}; it has {', '.join(header) or 'none'}; correct the mapping"
        )
    return tuple(found)


def logs_in(paths: Iterable[Path], mapping: Mapping) -> list[Path]:
    """The logs that are meant: files and folders as given; a folder of logs stands for the logs in it."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir() and not mapping.is_log(path):
            inside = [p for p in sorted(path.iterdir()) if mapping.is_log(p)]
            if not inside:
                raise MappingError(f"{path}: holds no log of this mapping")
            found += inside
        else:
            found.append(path)
    return found
