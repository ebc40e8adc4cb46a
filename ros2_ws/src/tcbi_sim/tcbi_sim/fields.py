"""What effects write: per-simulation model fields, the command path and the sensors, addressed by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from mujoco.batch import Batch

SETCONST_INPUTS = frozenset(mujoco.MjModel._setconst_inputs)


@dataclass
class CommandFields:
    """How commands reach the servos: B simulations, J joints. Zero everywhere is a perfect link."""

    latency: np.ndarray  # (B, J) s
    deadband: np.ndarray  # (B, J) rad, a change of the target below it is ignored
    quantum: np.ndarray  # (B, J) rad, targets are rounded to multiples
    loss: np.ndarray  # (B,) probability that a command never arrives
    offset: np.ndarray  # (B, J) rad, added to the target: a servo mounted off its zero
    speed: np.ndarray  # (B, J) rad/s, fastest ramp of the servo

    @classmethod
    def perfect(cls, count: int, joints: int) -> "CommandFields":
        """A link without any fault."""
        per_joint = [np.zeros((count, joints)) for _ in range(4)]
        return cls(
            per_joint[0], per_joint[1], per_joint[2], np.zeros(count), per_joint[3], np.full((count, joints), np.inf)
        )


@dataclass
class SensingFields:
    """How readings leave the robot. Zero everywhere is a perfect sensor."""

    latency: np.ndarray  # (B,) s, of every sensor
    joint_offset: np.ndarray  # (B, J) rad, subtracted from the reading
    gyro_bias: np.ndarray  # (B, 3) rad/s
    imu_tilt: np.ndarray  # (B, 2) rad, roll and pitch of the IMU's mounting

    @classmethod
    def perfect(cls, count: int, joints: int) -> "SensingFields":
        """Sensors without any fault."""
        return cls(np.zeros(count), np.zeros((count, joints)), np.zeros((count, 3)), np.zeros((count, 2)))


class ModelFields(Mapping[str, np.ndarray]):
    """Per-simulation arrays (B, ...) of MjModel fields, expanded on first use and writable in place."""

    def __init__(self, batch: Batch):
        self._batch = batch
        self._used: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._used:
            self._used[name] = self._batch.expand(name)
        return self._used[name]

    def __iter__(self):
        return iter(self._used)

    def __len__(self) -> int:
        return len(self._used)

    def restore(self) -> None:
        """Every field used so far back to the compiled model's values."""
        for name, values in self._used.items():
            source = self._batch.model.opt if name.startswith("opt.") else self._batch.model
            values[...] = getattr(source, name.removeprefix("opt."))

    @property
    def needs_constants(self) -> bool:
        """Whether constants that MuJoCo derives from the fields must be computed anew."""
        return any(name in SETCONST_INPUTS or name.startswith("opt.") for name in self._used)


@dataclass
class Fields:
    """Everything an effect may change, for B simulations at once."""

    mj: mujoco.MjModel
    model: ModelFields
    command: CommandFields
    sensing: SensingFields
    joint_names: tuple[str, ...]
    powered_damping: np.ndarray  # (B, J) N m s/rad, back-EMF: damping of a joint while its servo has power
    compliance: np.ndarray  # (B, J) rad/(N m), of the links: how far each bends beyond its servo
    strength: np.ndarray  # (B, J) share of stiffness and greatest torque that servos have just now; `update` may write
    stall_torque: np.ndarray  # (B, J) N m, greatest torque at full strength, 1 where there is no limit; for `update`
    begins: np.ndarray  # (B,) bool, which simulations `apply` is called for at the start of an episode; others go on
    memory: dict = field(default_factory=dict)  # state of effects that change with time, by use of the effect

    @classmethod
    def perfect(cls, mj: mujoco.MjModel, batch: Batch, count: int, joint_names: tuple[str, ...]) -> "Fields":
        """A robot without any fault."""
        joints = len(joint_names)
        link, sensors = CommandFields.perfect(count, joints), SensingFields.perfect(count, joints)
        damping, compliance = np.zeros((count, joints)), np.zeros((count, joints))
        strength, torque = np.ones((count, joints)), np.ones((count, joints))
        begins = np.ones(count, bool)
        return cls(mj, ModelFields(batch), link, sensors, joint_names, damping, compliance, strength, torque, begins)

    @property
    def count(self) -> int:
        """B."""
        return len(self.command.loss)

    def carried(self, key: str) -> np.ndarray:
        """State (B, J) of an effect that changes with time: as it stood, and zero where an episode begins."""
        old = self.memory.get(key, np.zeros(self.strength.shape))
        self.memory[key] = np.where(self.begins[:, None], 0.0, old)
        return self.memory[key]

    def joint(self, name: str) -> int:
        """Position of a joint in the rig's order, the order of `command` and `sensing` columns."""
        return self.joint_names.index(name)

    def dof(self, joint: str) -> int:
        """Index of a hinge's degree of freedom."""
        return int(self.mj.joint(joint).dofadr[0])

    def dofs(self, joints: "tuple[str, ...] | None" = None) -> np.ndarray:
        """Degrees of freedom of several hinges; all of the rig's by default."""
        return np.array([self.dof(j) for j in joints or self.joint_names])

    def body(self, name: str) -> int:
        """Index of a body."""
        return int(self.mj.body(name).id)

    def geom(self, name: str) -> int:
        """Index of a geom."""
        return int(self.mj.geom(name).id)

    def actuators(self, joints: "tuple[str, ...] | None" = None) -> np.ndarray:
        """Actuators of several joints, which bear the joints' names; all of the rig's by default."""
        return np.array([self.mj.actuator(j).id for j in joints or self.joint_names])

    def scale_gain(self, actuators: np.ndarray, factor: np.ndarray) -> None:
        """Multiply position servos' stiffness.

        Args:
          actuators: (A,) indices.
          factor: (B,) or (B, A).
        """
        factor = np.asarray(factor)
        if factor.ndim == 1:
            factor = factor[:, None]
        self.model["actuator_gainprm"][:, actuators, 0] *= factor
        self.model["actuator_biasprm"][:, actuators, 1] *= factor
