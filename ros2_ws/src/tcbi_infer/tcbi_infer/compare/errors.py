"""Errors of comparison and diagnosis that a user can cause and mend."""

from collections.abc import Mapping

from tcbi_infer.errors import InferError


class CompareError(InferError):
    """Measurements and model cannot be compared."""


class NothingToCompareError(CompareError):
    """No rollouts were given, or none that can be replayed.

    Args:
      reasons: why each rollout given cannot be, by its id.
    """

    def __init__(self, reasons: Mapping[str, str]):
        told = [f"{name} {reason}" for name, reason in list(reasons.items())[:3]]
        more = f" and {len(reasons) - 3} more" if len(reasons) > 3 else ""
        found = f": {', '.join(told)}{more}" if told else ""
        super().__init__(f"no rollout to compare{found}; give at least one bag with joint_states and joint_commands")


class WrongRigError(CompareError):
    """Rollouts of another robot than the model's."""

    def __init__(self, model: str, rig: str, seen: str, joints: tuple[str, ...]):
        super().__init__(
            f"model {model!r} is of the rig {rig!r}, but a rollout is of {seen!r} with joints {', '.join(joints)}; "
            "choose another --model or leave the rollout out"
        )


class WrongJointsError(CompareError):
    """A rollout of the model's rig without all of its joints."""

    def __init__(self, rig: str, joints: tuple[str, ...], seen: tuple[str, ...]):
        super().__init__(
            f"the rig {rig!r} has the joints {', '.join(joints)}, but a rollout of it has {', '.join(seen)}; correct "
            "the names in the rig's file, or import the log again with the rig's names"
        )
