"""Errors of comparison and diagnosis that a user can cause and mend."""

from tcbi_infer.errors import InferError


class CompareError(InferError):
    """Measurements and model cannot be compared."""


class NothingToCompareError(CompareError):
    """No rollouts were given, or none with samples."""

    def __init__(self) -> None:
        super().__init__("no rollout to compare: give at least one bag with joint_states and joint_commands")


class WrongRigError(CompareError):
    """Rollouts of another robot than the model's."""

    def __init__(self, model: str, rig: str, seen: str, joints: tuple[str, ...]):
        super().__init__(
            f"model {model!r} is of the rig {rig!r}, but a rollout is of {seen!r} with joints {', '.join(joints)}; "
            "choose another --model or leave the rollout out"
        )
