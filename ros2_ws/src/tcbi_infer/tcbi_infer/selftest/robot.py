"""A robot whose truth is known: a model with a planted effect, simulated by another solver at another step, with noise.

The effect's own code is the model's; what differs from the model that is diagnosed is the integrator, a step a tenth as
long, the weight of friction against normal force in contacts, 3 % of scatter between the joints' gains, the ground
under each repeat, and the sensors' noise and steps. Effects written another way are what `./tcbi bench hidden` tries.
"""

import dataclasses
import zlib
from collections.abc import Sequence

import mujoco
import numpy as np

from tcbi_infer.diagnose.motions import Motion
from tcbi_infer.errors import InferError
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Measurement, Scenario
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import Rig
from tcbi_sim.rigs import load_rig
from tcbi_sim.scatter import SCATTER, with_scatter
from tcbi_sim.sensing import add_noise

TIMESTEP = 0.0005  # s
REPEATS = 2  # of each motion: what the robot differs from itself is its noise floor
PUT_DOWN = 0.003  # rad: how differently a robot that stands is put down for each repeat
STRENGTHS = {"strong": 1.0, "weak": 0.4}  # of the way from the null value to the library's own best guess
NOTHING = ""  # planted
RECORDING = 1  # added to a robot's seed: noise is not drawn from the stream of its parameters


@dataclasses.dataclass(frozen=True)
class Robot:
    """What is planted in one robot; `use` is "" for nothing."""

    use: str
    strength: str
    seed: int

    @property
    def effect(self) -> str:
        """Name in the library."""
        return self.use.partition(":")[0]

    def truth(self, model: Model) -> tuple[Model, np.ndarray]:
        """The model that this robot is, and its (P,) parameters: half-way between the model's mean and a draw of it."""
        rng = np.random.default_rng(self._seed)
        base = model.to_unit(model.mean()) + 0.5 * (
            model.to_unit(model.sample(rng, 1)[0]) - model.to_unit(model.mean())
        )
        values = list(model.from_unit(base))
        if self.use:
            model = model.with_effect(self.use)
            values += [planted_value(p, self.strength) for p in model.parameters[len(values) :]]
        model, joints = with_scatter(model)
        gains = rng.normal(1.0, SCATTER, len(joints)).clip(1 - 3 * SCATTER, 1 + 3 * SCATTER)
        return model, np.array([*values, *gains])

    def planted(self, model: Model) -> dict[str, float]:
        """The effect's parameters in this robot, by qualified name."""
        truth, values = self.truth(model)
        return {
            n: float(v) for n, v in zip(truth.names, values, strict=True) if self.use and n.startswith(f"{self.use}.")
        }

    def record(self, model: Model, motions: Sequence[Motion]) -> list[Measurement]:
        """Every motion, twice, as another solver says and as this rig's sensors would see it.

        Raises:
          InferError: the simulation of this robot diverged.
        """
        truth, values = self.truth(model)
        rig, rng = load_rig(model.rig), np.random.default_rng([*self._seed, RECORDING])
        trials = [(motion, repeat) for motion in motions for repeat in range(REPEATS)]
        out = simulate(
            truth,
            np.repeat(values[None], len(trials), axis=0),
            [dataclasses.replace(put_down(m.scenario, rig, rng), seed=int(rng.integers(2**32))) for m, _ in trials],
            commands=[m.commands for m, _ in trials],
            pairing="zip",
            timestep=TIMESTEP,
            solver=other_solver(rig),
        )
        if out.diverged.any():
            bad = ", ".join(sorted({m.name for (m, _), d in zip(trials, out.diverged[:, 0], strict=True) if d}))
            raise InferError(
                f"a robot with {self.use or 'nothing planted'} cannot be simulated at {1000 * TIMESTEP:g} ms steps: "
                f"{bad} diverged; leave it out of --effects"
            )
        return [
            dataclasses.replace(
                add_noise(out.measurement(i), rig.noise, rng),
                rollout_id=f"{motion.name}-{repeat}",
                policy_id=motion.name if motion.policy_id is None else motion.policy_id,
                source="selftest",
                scenario=motion.scenario,
                commands=motion.commands,
            )
            for i, (motion, repeat) in enumerate(trials)
        ]

    @property
    def _seed(self) -> list[int]:
        return [self.seed, zlib.crc32(f"{self.use} {self.strength}".encode())]


def planted_value(parameter: Parameter, strength: str) -> float:
    """An effect's parameter at a strength; one without a null value, which says where or how, at its best guess."""
    if parameter.null is None:
        return parameter.nominal
    null, full = float(parameter.to_unit(parameter.null)), float(parameter.to_unit(parameter.nominal))
    return float(parameter.from_unit(null + STRENGTHS[strength] * (full - null)))


def robots(uses: Sequence[str], strengths: Sequence[str], count: int) -> list[Robot]:
    """`count` robots of each effect and strength, each at any place where there is a choice; as many with nothing.

    Args:
      uses: what is planted; of an effect with many places one is drawn for each robot.
      strengths: keys of `STRENGTHS`.
      count: robots of each kind.
    """
    result = [Robot(NOTHING, "none", seed) for seed in range(count)]
    for name in dict.fromkeys(use.partition(":")[0] for use in uses):
        places = [use for use in uses if use.partition(":")[0] == name]
        for seed in range(count):
            pick = np.random.default_rng([seed, zlib.crc32(name.encode())]).integers(len(places))
            result += [Robot(places[pick], strength, seed) for strength in strengths]
    return result


def other_solver(rig: Rig) -> dict[str, float]:
    """MuJoCo's options in place of the rig's own: another integrator, and half the weight of friction in contacts."""
    own = rig.build(0).option
    euler, implicit = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return {"integrator": int(implicit if own.integrator == euler else euler), "impratio": max(own.impratio / 2, 1.0)}


def put_down(scenario: Scenario, rig: Rig, rng: np.random.Generator) -> Scenario:
    """The scenario as it turned out: a robot that stands never stands the same way twice."""
    if not rig.floating:
        return scenario
    roll, pitch = rng.normal(0.0, PUT_DOWN, 2)
    return dataclasses.replace(
        scenario, slope_roll=scenario.slope_roll + float(roll), slope_pitch=scenario.slope_pitch + float(pitch)
    )
