"""What lies between a motor and its leg: play, a heavy rotor, links that bend, horns off their splines, odd servos."""

import numpy as np

from tcbi_bringup.emulated_robot.drawing import Drawing
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect
from tcbi_bringup.emulated_robot.mechanics import Build
from tcbi_contract.names import JOINTS


class LooseHorns(HiddenEffect):
    """Worn splines between servo and leg in all joints: the motor turns through a gap before its teeth push the leg.

    The encoder sits on the motor's side of the gap.
    """

    strong, weak = 0.060, 0.025  # rad, from face to face

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"gap_rad": self.size}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.gap += self.size


class HeavyRotors(HiddenEffect):
    """Motors of another make: a rotor of its own behind stiff teeth, with more inertia than the drawing's."""

    strong, weak = 0.004, 0.0015  # kg m^2 at the output shaft, beside the drawing's

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"inertia_kg_m2": self.size}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.rotor += self.size


class SpringyLinks(HiddenEffect):
    """Printed links that twist: motor and leg are two inertias with a spring and a little damping between them."""

    strong, weak = 0.20, 0.08  # rad/(N m)

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self.truth = {"compliance_rad_per_n_m": self.size}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.compliance += self.size


class OddServo(HiddenEffect):
    """One servo of another batch, whose position loop is softer or stiffer."""

    strong, weak = 0.55, 0.30  # natural logarithm of its stiffness over the others'

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self._servo = int(rng.integers(len(JOINTS)))
        self._factor = float(np.exp(min(self.size, 0.65) * rng.choice([-1.0, 1.0])))
        self.truth = {"joint": JOINTS[self._servo], "stiffness_factor": self._factor}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.gain_factor[self._servo] = build.gain_factor.get(self._servo, 1.0) * self._factor


class SlippedHorn(HiddenEffect):
    """One horn a tooth off: the link behind it is turned on the servo's shaft."""

    strong, weak = 0.10, 0.04  # rad

    def __init__(self, strength: str, rng: np.random.Generator):
        super().__init__(strength, rng)
        self._joint = str(rng.choice(JOINTS))
        self._angle = self.size * float(rng.choice([-1.0, 1.0]))
        self.truth = {"joint": self._joint, "offset_rad": self._angle}

    def attach(self, build: Build, drawing: Drawing) -> None:
        build.horn_offset[self._joint] = build.horn_offset.get(self._joint, 0.0) + self._angle
