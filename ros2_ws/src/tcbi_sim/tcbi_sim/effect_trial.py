"""One use of an effect, tried on a rig: whether it does nothing at its null value, something elsewhere, and no harm.

    trial = try_use(find_use("backlash", rig), rig)
    trial.faults, trial.change, trial.null_change

One motion is simulated without the effect, and then at once with it at its null value, at its nominal one, at both
ends of every parameter's range and at a few draws from the prior. The row at the null value stands among the others,
so an effect that reaches over to other simulations shows there.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import mujoco
import numpy as np

from tcbi_contract.errors import TcbiError
from tcbi_sim.effect import EffectUse
from tcbi_sim.engine import SimulatedRollouts, simulate
from tcbi_sim.errors import EffectError
from tcbi_sim.fields import CommandFields, Fields, SensingFields
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import Model, base_model
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig
from tcbi_sim.simulator import Simulator
from tcbi_sim.structure import compile_structure
from tcbi_sim.user_file import told

DURATION = 2.0  # s
DRAWS = 3  # from the prior
EXACT = 1e-9  # rad, rad/s or m: what counts as no change where nothing is added to the structure
STRUCTURAL = 0.3  # of the change at the nominal value: what an added joint or shape may change at the null value
LEAST = 1e-3  # same units: the least change at the nominal value
SIGNALS = {"joint_position": "rad", "attitude": "1", "angular_velocity": "rad/s", "position": "m"}
COARSE = ("joint_position", "attitude")  # signals that an added joint leaves smooth


@dataclass(frozen=True)
class Trial:
    """What a use of an effect did on one rig.

    Attributes:
      change: by signal, root mean square difference at the nominal value from the model without the effect.
      null_change: the largest of these differences at the null value.
      faults: one line each; empty where the effect is fit for use.
    """

    rig: str
    use: str
    change: dict[str, float]
    null_change: float
    faults: tuple[str, ...]


def motion(rig: Rig) -> tuple[Scenario, Commands]:
    """A lively motion of any rig: random ramps of a robot on a slope; a bench's steps, far ones and then small ones."""
    rng, joints = np.random.default_rng(0), len(rig.joint_names)
    if rig.floating:
        targets = rng.uniform(-0.57, 0.57, (10, joints)) * rig.joint_range
        return Scenario("trial", DURATION, 0.1, -0.05), Commands(np.arange(10) * 0.2, targets)
    steps = rng.normal(0, np.repeat([0.2, 0.01], 50)[:, None], (100, joints))
    return Scenario("trial", DURATION), Commands(np.arange(100) * 0.02, np.cumsum(steps, axis=0), 0.0)


def try_use(use: EffectUse, rig: Rig) -> Trial:
    """Simulate a use of an effect and judge what it does."""
    try:
        model = base_model(rig).with_effect(use.key)
        faults = _writes(model, use, rig)
        if faults:
            return Trial(rig.name, use.key, {}, float("nan"), tuple(faults))
        return _judge(model, use, rig)
    except EffectError as e:
        return Trial(rig.name, use.key, {}, float("nan"), (f"{e.part}(), {told(e.cause, e.file)}",))
    except TcbiError as e:
        return Trial(rig.name, use.key, {}, float("nan"), (" ".join(str(e).split()),))


def rows(model: Model, use: EffectUse) -> tuple[np.ndarray, list[str]]:
    """(N, P) parameter vectors, the rig's own at their nominal values, and what each is."""
    nominal = {p.name: p.nominal for p in model.parameters}
    null = {p.name: p.nominal if p.null is None else p.null for p in use.parameters}
    found = [(nominal | null, "its null value"), (nominal, "its nominal value")]
    for p in use.parameters:
        found += [(nominal | {p.name: end}, f"{p.name} = {end:g} {p.unit}") for end in (p.low, p.high)]
    rng = np.random.default_rng(0)
    for _ in range(DRAWS):
        drawn = {p.name: float(p.sample(rng, 1)[0]) for p in use.parameters}
        found.append((nominal | drawn, ", ".join(f"{n} = {v:.4g}" for n, v in drawn.items())))
    return np.array([[row[n] for n in model.names] for row, _ in found]), [text for _, text in found]


def _judge(model: Model, use: EffectUse, rig: Rig) -> Trial:
    scenario, commands = motion(rig)
    values, texts = rows(model, use)
    without = simulate(base_model(rig), _nominal(base_model(rig).parameters), [scenario], commands=[commands])
    out = simulate(model, values, [scenario], commands=[commands])
    faults = []
    if out.diverged.any():
        where = [text for text, diverged in zip(texts, out.diverged[:, 0], strict=True) if diverged]
        faults.append(f"the simulation diverges at {'; at '.join(where)}: narrow the range, or write smaller values")
    not_finite = [s for s in SIGNALS if (v := getattr(out, s)) is not None and not np.isfinite(v).all()]
    if not_finite:
        faults.append(f"{', '.join(not_finite)} become NaN or infinite; check what apply() and update() write")
    change = differences(out, without, 1)
    at_null = differences(out, without, 0)
    structural = use.effect.edit is not None
    signals = [s for s in change if s in COARSE or not structural]
    acts, null_change = max(change.values()), max(at_null[s] for s in signals)
    if not faults:
        allowed = max(EXACT, STRUCTURAL * max(change[s] for s in signals)) if structural else EXACT
        if any(p.null is not None for p in use.parameters) and not null_change <= allowed:
            alone = differences(simulate(model, values[:1], [scenario], commands=[commands]), without, 0)
            faults.append(_at_null(use, null_change, max(alone[s] for s in signals), allowed))
        faults += _changes(acts)
        faults += _idle(use, out)
    return Trial(rig.name, use.key, change, null_change, tuple(faults))


def differences(out: SimulatedRollouts, without: SimulatedRollouts, row: int) -> dict[str, float]:
    """Root mean square difference of each signal of one row from the only one of `without`."""
    result = {}
    for name in SIGNALS:
        a, b = getattr(out, name), getattr(without, name)
        if a is not None:
            result[name] = float(np.sqrt(np.mean((a[row] - b[0]) ** 2)))
    return result


def _changes(acts: float) -> list[str]:
    return [
        f"changes nothing at its nominal value: {acts:.2g} in the signal that changes most, at least {LEAST:g} is "
        "wanted; make the nominal value larger, or write into the fields in place (fields.command.latency += …)"
    ] * (not acts > LEAST)


def _at_null(use: EffectUse, beside: float, alone: float, allowed: float) -> str:
    """Why the row at the null value moves otherwise than without the effect, among other rows and by itself."""
    if alone <= allowed:
        return (
            f"reaches over from one simulation to another: at its null value it changes {beside:.2g} beside others, "
            "nothing alone; apply() may write each simulation's own value only, values[i] to row i"
        )
    return (
        f"changes something at its null value ({_nulls(use)}): {alone:.2g}, allowed is {allowed:.2g}; null must be "
        "where the effect vanishes, and apply() must add to the field (+=) or multiply it (*=), not replace it"
    )


def _nulls(use: EffectUse) -> str:
    return ", ".join(f"{p.name.rpartition('.')[2]} = {p.null:g}" for p in use.parameters if p.null is not None)


def _idle(use: EffectUse, out: SimulatedRollouts) -> list[str]:
    """Parameters that change nothing from one end of their range to the other, the others at their nominal values."""
    faults = []
    for i, p in enumerate(use.parameters):
        tried = 1, 2 + 2 * i, 3 + 2 * i  # as `rows` has them: nominal, both ends
        each = [values for name in SIGNALS if (values := getattr(out, name)) is not None]
        if all(np.array_equal(values[a], values[b]) for values in each for a, b in itertools.combinations(tried, 2)):
            own = p.name.rpartition(".")[2]
            faults.append(f"parameter {own!r} changes nothing from {p.low:g} to {p.high:g}; use it, or leave it out")
    return faults


def _nominal(parameters: tuple[Parameter, ...]) -> np.ndarray:
    return np.array([[p.nominal for p in parameters]])


def _writes(model: Model, use: EffectUse, rig: Rig) -> list[str]:
    """What apply() and update() write that no effect may write."""
    values, _ = rows(model, use)
    scenario = dataclasses.replace(motion(rig)[0], settle=0.0)
    simulator = Simulator(model, values, [scenario] * len(values), threads=1)
    allowed = _layout(Simulator(base_model(rig), _nominal(base_model(rig).parameters), [scenario], threads=1).fields)
    compiled = compile_structure(rig, [use])
    compiled.opt.timestep = simulator.timestep
    if use.effect.update:
        simulator.advance(2 / simulator.rate)
    faults = _strange(simulator.fields, allowed, len(values))
    if not np.array_equal(simulator.parameters, values):
        faults.append("changes the values that it is given; copy them before calculating in place")
    if not faults and use.effect.edit is None:
        faults += _overwrites(simulator, model, use, rig)
    if _bytes(simulator.mj) != _bytes(compiled):
        faults.append("writes into fields.mj, which all simulations share; write into fields.model[…] instead")
    return faults


def _overwrites(simulator: Simulator, model: Model, use: EffectUse, rig: Rig) -> list[str]:
    """Whether apply() leaves what others wrote as it is at the null value, and writes the same when called again."""
    fields = simulator.fields
    values, _ = rows(model, use)
    null, nominal = ({n: np.full(len(values), v) for n, v in zip(model.names, values[k], strict=True)} for k in (0, 1))

    def written(row: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Every field after apply(), begun from what other effects might have written."""
        arrays = _arrays(fields)
        for name, array in before.items():
            arrays[name][...] = array
        use.apply(fields, rig, row)
        return {name: array.copy() for name, array in _arrays(fields).items()}

    before = {name: _as_others_wrote(name, array) for name, array in _arrays(fields).items()}
    after, first, second = written(null), written(nominal), written(nominal)
    lost = [n for n, array in before.items() if not np.allclose(after[n], array, rtol=EXACT, atol=EXACT)]
    faults = [
        f"changes something at its null value ({_nulls(use)}): fields.{name}, as other effects may have left it; null "
        "must be where the effect vanishes, and apply() must add to the field (+=) or multiply it (*=), each "
        "simulation by its own value, not replace it"
        for name in lost
    ]
    if any(not np.array_equal(first[n], second[n]) for n in before):
        faults.append("apply() writes something else each time; draw no random numbers there, take them as parameters")
    return faults


def _arrays(fields: Fields) -> dict[str, np.ndarray]:
    """Every float array that apply() may write, by its name below `fields`."""
    groups = {f"{g}.{n}": v for g in ("command", "sensing") for n, v in vars(getattr(fields, g)).items()}
    own = {n: getattr(fields, n) for n in ("powered_damping", "compliance")}
    return groups | own | {f"model[{n!r}]": v for n, v in fields.model.items() if v.dtype.kind == "f"}


def _as_others_wrote(name: str, array: np.ndarray) -> np.ndarray:
    """Values of a field as another effect might leave them: none is what a perfect robot has."""
    if name.startswith("model"):
        return 1.25 * array
    return np.full_like(array, 3.0 if name == "command.speed" else 0.0123)


def _layout(fields: Fields) -> dict[str, tuple[int, ...]]:
    """Every array that an effect may write, and its shape without the number of simulations."""
    groups = {"command": CommandFields, "sensing": SensingFields}
    own = {
        f"{group}.{f.name}": getattr(getattr(fields, group), f.name).shape[1:]
        for group, cls in groups.items()
        for f in dataclasses.fields(cls)
    }
    return own | {name: getattr(fields, name).shape[1:] for name in ("powered_damping", "compliance", "strength")}


def _strange(fields: Fields, allowed: dict[str, tuple[int, ...]], count: int) -> list[str]:
    seen = {f"{g}.{n}": v for g in ("command", "sensing") for n, v in vars(getattr(fields, g)).items()}
    top = {f.name for f in dataclasses.fields(Fields)}
    seen |= {n: v for n, v in vars(fields).items() if n in allowed or n not in top}
    faults = [
        f"writes fields.{name}, which does nothing; allowed are {', '.join(sorted(allowed))} and model[…]"
        for name in sorted(set(seen) - set(allowed))
    ]
    for name, shape in allowed.items():
        value = np.asarray(seen[name])
        if value.shape != (count, *shape):
            faults.append(
                f"leaves fields.{name} with shape {value.shape}, allowed is {(count, *shape)}; write in place"
            )
        elif np.isnan(value).any() or (np.isinf(value).any() and name != "command.speed"):
            faults.append(f"writes NaN or infinity into fields.{name}; finite numbers are allowed")
    for name, values in fields.model.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            faults.append(f"writes NaN or infinity into fields.model[{name!r}]; finite numbers are allowed")
    return faults


def _bytes(model: mujoco.MjModel) -> bytes:
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
