"""The true signals in what MuJoCo's sensors give of a rig's structure."""

import mujoco
import numpy as np

from tcbi_sim.rig import Rig
from tcbi_sim.sensing import Samples


class SensorData:
    """Where each signal stands in `sensordata`, and what it is.

    Attributes:
      need_forces: whether joint angles depend on the forces that act just now.
    """

    def __init__(self, mj: mujoco.MjModel, rig: Rig) -> None:
        def columns(*names: str) -> np.ndarray:
            sensors = [mj.sensor(name) for name in names]
            return np.concatenate([np.arange(s.adr[0], s.adr[0] + s.dim[0]) for s in sensors])

        measured = {mj.sensor(i).name for i in range(mj.nsensor)}
        motors = [[f"{what}/{j}" for j in rig.joint_names] for what in ("force", "velocity")]  # there where links bend
        bends = {name for names in motors for name in names} <= measured
        self._joints = columns(*(f"position/{j}" for j in rig.joint_names))
        self._motors = [columns(*names) for names in motors] if bends else None
        self.need_forces = bends
        self._contacts = columns(*(f"contact/{f}" for f in rig.foot_names)) if rig.foot_names else None
        self._imu = [columns(n) for n in ("attitude", "gyro", "accelerometer")] if rig.has_imu else None
        self._tracker = columns("tracker") if rig.floating else None
        self._threshold = rig.contact_threshold

    def samples(self, data: np.ndarray, times: np.ndarray, compliance: np.ndarray, back_emf: np.ndarray) -> Samples:
        """The signals in (B, n, S) sensor data.

        Args:
          data: of B simulations at n times.
          times: (n,) s.
          compliance: (B, J) rad/(N m), of the links.
          back_emf: (B, J) N m s/rad, that acts just now.
        """
        attitude, rates, acceleration = [data[:, :, c].copy() for c in self._imu] if self._imu else [None] * 3
        contact = None if self._contacts is None else data[:, :, self._contacts] > self._threshold
        position = None if self._tracker is None else data[:, :, self._tracker].copy()
        joints = data[:, :, self._joints].copy()
        if self._motors is not None:  # the encoder sits before the link that bends
            force, velocity = (data[:, :, c] for c in self._motors)
            joints += compliance[:, None, :] * (force - back_emf[:, None, :] * velocity)
        return Samples(times, joints, attitude, rates, acceleration, contact, position)
