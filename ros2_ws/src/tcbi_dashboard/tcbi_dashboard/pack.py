"""A comparison on disk, in pieces small enough for a browser: a summary, and one file for each rollout.

    runs/compare-<model>-<time>/summary.json     what the page shows at once
    runs/compare-<model>-<time>/<n>.bin          rollout n: u32 length of a JSON header, the header, float32 arrays

The server sends these files as they are and holds none of them in memory. The arrays of a rollout, in the order of the
header's "arrays": time (T,) s; measured, predicted, low, high (T, C), and predicted_also of a second model; joints and
base of the robot and of each prediction, for the drawing. What was not measured is NaN.
"""

import dataclasses
import datetime
import json
import os
import shutil
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.plain import plain
from tcbi_dashboard.drawing import Ground, ground_quaternion
from tcbi_dashboard.names import COMPARISON, SUMMARY
from tcbi_infer.compare.comparison import Comparison
from tcbi_infer.compare.ladder import Rung
from tcbi_infer.compare.locate import worst_moments
from tcbi_infer.compare.maps import curves, heat, joint_errors, steady
from tcbi_infer.compare.signals import JOINT
from tcbi_sim.engine import SimulatedRollouts
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

DECIMALS = 6  # that numbers keep in JSON
KEPT = 5  # comparisons; older ones are removed
MOMENTS, WORST_S = 12, 1.5  # how many worst moments, and how long each is in s


def write(
    folder: Path,
    model: Model,
    comparison: Comparison,
    also: Comparison | None = None,
    rungs: Sequence[Rung] = (),
    report: str = "",
) -> Path:
    """Write a comparison as a folder of `folder`, whole or not at all.

    Args:
      folder: `runs` of the store.
      model: that was compared.
      comparison: of it.
      also: of another model with the same rollouts.
      rungs: the error of each version that it comes from.
      report: name of the report of the same comparison.
    """
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S%f")
    work = Path(tempfile.mkdtemp(prefix=".new-", dir=folder))
    try:
        motion = _motion(model, comparison)
        ground = Ground(load_rig(model.rig))
        for r in range(len(comparison.rollouts)):
            (work / f"{r}.bin").write_bytes(_rollout(comparison, also, motion, ground, r))
        more = {"ladder": [dataclasses.asdict(r) for r in rungs], "report": report}
        text = json.dumps(plain({**_summary(comparison, also), **more}, DECIMALS))
        (work / SUMMARY).write_text(text, encoding="utf-8")
        final = folder / f"{COMPARISON}{model.version}-{stamp}"
        os.rename(work, final)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise
    for old in sorted(folder.glob(f"{COMPARISON}*/{SUMMARY}"), key=lambda p: p.stat().st_mtime)[:-KEPT]:
        shutil.rmtree(old.parent, ignore_errors=True)
    return final


def _summary(c: Comparison, also: Comparison | None) -> dict[str, Any]:
    replay, layout = c.replay, c.replay.layout
    heat_map = heat(c)
    each = _each_rollout(c)
    return {
        **c.to_json(),
        "floor_statement": c.floor.statement,
        "rig": replay.rig,
        "channels": [{"name": ch.name, "unit": ch.group.unit, "kind": ch.group.name} for ch in layout.channels],
        "each": [
            {
                "rollout": m.rollout_id,
                "policy": m.policy_id,
                "error_over_floor": each[r],
                "seconds": _end(c, r),
                "notes": list(m.notes),
            }
            for r, m in enumerate(replay.measurements)
        ],
        "joint_errors": joint_errors(c),
        "heat": {
            "joints": heat_map.joints,
            "phases": heat_map.phases,
            "values": heat_map.values,
            "rollouts": heat_map.worst[..., 0],
            "times": replay.time[heat_map.worst[..., 1]],
        },
        "steady": steady(c),
        "curves": [{"condition": k.condition, "unit": k.unit, "middle": k.middle, "error": k.error} for k in curves(c)],
        "moments": _moments(c),
        "also": None
        if also is None
        else {
            "model": also.model,
            "error_over_floor": also.error_over_floor,
            "ratios": {s.name: s.ratio for s in also.signals},
        },
    }


def _each_rollout(c: Comparison) -> list[float]:
    """Error over noise floor of each rollout's joints."""
    joints = c.replay.layout.where(JOINT)
    scaled = (c.replay.measured - c.predicted)[..., joints] / c.floor.values[joints]
    count = np.maximum(np.isfinite(scaled).sum(axis=(1, 2)), 1)
    return [float(v) for v in np.sqrt(np.nansum(scaled**2, axis=(1, 2)) / count)]


def _moments(c: Comparison) -> list[dict[str, Any]]:
    """The worst windows of any joint, replicates counted once."""
    replay, layout = c.replay, c.replay.layout
    firsts = [g.members[0] for g in replay.replicates]
    residual = (replay.measured - c.predicted)[firsts]
    span = round(WORST_S * layout.rate)
    found = []
    for s, t, i in worst_moments(residual, c.floor.values, layout.where(JOINT), MOMENTS, span):
        window = residual[s, t : t + span, i]
        peak = t + int(np.nanargmax(np.abs(window)))
        rms = float(np.sqrt(np.nanmean(window**2)))
        found.append(
            {
                "rollout": firsts[s],
                "begin": float(replay.time[t]),
                "end": float(replay.time[min(t + span, len(replay.time)) - 1]),
                "peak": float(replay.time[peak]),
                "signal": layout.channels[i].name,
                "unit": layout.channels[i].group.unit,
                "error": rms,
                "over_floor": rms / float(c.floor.values[i]),
            }
        )
    return found


def _motion(model: Model, c: Comparison) -> SimulatedRollouts:
    """The prediction at the mean parameters again, with its posture and place instead of channels."""
    return c.replay.simulate(model, model.mean()[None])


def _end(c: Comparison, r: int) -> float:
    seen = np.flatnonzero(np.isfinite(c.replay.measured[r]).any(axis=1))
    return float(c.replay.time[seen[-1]]) if len(seen) else 0.0


def _rollout(c: Comparison, also: Comparison | None, motion: SimulatedRollouts, ground: Ground, r: int) -> bytes:
    replay = c.replay
    s = next(i for i, g in enumerate(replay.replicates) if r in g.members)
    measured: Measurement = replay.measurements[r]
    length = max(2, int(np.searchsorted(replay.time, _end(c, r) + 1e-9)))
    cut = slice(0, length)
    offset = motion.joint_position.shape[2] - len(replay.time)  # the sample at time 0, which the grid leaves out
    simulated = slice(offset, offset + length)
    joints = motion.joint_position[0, s, simulated]
    attitude = None if motion.attitude is None else motion.attitude[0, s, simulated]
    tracked = measured.position is not None and motion.position is not None
    place = motion.position[0, s, simulated] if tracked and motion.position is not None else None
    own = measured.position[cut] if tracked and measured.position is not None else None
    arrays = {
        "time": replay.time[cut],
        "measured": replay.shown[r, cut],
        "predicted": c.predicted[r, cut],
        "low": c.low[r, cut],
        "high": c.high[r, cut],
        **({} if also is None else {"predicted_also": also.predicted[r, cut]}),
        "joints_measured": measured.joint_position[cut],
        "joints_predicted": joints,
        "base_measured": ground.base(
            measured.joint_position[cut],
            None if measured.attitude is None else measured.attitude[cut],
            own,
            measured.scenario,
        ),
        "base_predicted": ground.base(joints, attitude, place, replay.scenarios[s]),
    }
    header = {
        "rollout": measured.rollout_id,
        "tracked": tracked,
        "ground": ground_quaternion(measured.scenario),
        "blocks": [{"center": b.center, "size": b.size, "yaw": b.yaw} for b in measured.scenario.blocks],
    }
    return encode(header, arrays)


def encode(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> bytes:
    """A JSON header and named float32 arrays as one piece."""
    listed = [{"name": name, "shape": list(values.shape)} for name, values in arrays.items()]
    text = json.dumps(plain({**header, "arrays": listed}, DECIMALS)).encode()
    text += b" " * (-len(text) % 4)
    return b"".join([struct.pack("<I", len(text)), text, *(v.astype("<f4").tobytes() for v in arrays.values())])


def decode(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What `encode` wrote."""
    (size,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + size])
    arrays, at = {}, 4 + size
    for entry in header["arrays"]:
        count = int(np.prod(entry["shape"]))
        arrays[entry["name"]] = np.frombuffer(data, "<f4", count, at).reshape(entry["shape"])
        at += 4 * count
    return header, arrays
