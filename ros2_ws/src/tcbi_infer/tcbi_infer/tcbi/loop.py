"""Who acts in a simulated rollout: the recorded commands (open loop), or the policy that ran (closed loop).

What a policy commands depends on the robot through what it sees alone. So with the readings at hand the commands that
it gave tell nothing more of the parameters, and a policy that acts anew only adds the scatter of its own reactions.
"""

from collections.abc import Sequence
from pathlib import Path

from tcbi_policy.artefact import GAIT_PREFIX, find_policy
from tcbi_policy.errors import PolicyError
from tcbi_sim.engine import Controller
from tcbi_sim.measurement import Measurement

OPEN, CLOSED, AUTO = LOOPS = ("open", "closed", "auto")


def find_controllers(
    measurements: Sequence[Measurement], loop: str, policies: Path | None
) -> tuple[dict[str, Controller], str]:
    """Policy id -> controller of the policies that act, and a line that says which, and why others do not.

    Args:
      measurements: the real rollouts.
      loop: `OPEN`; `CLOSED`; or `AUTO`, closed but for scripted gaits and policies that cannot be loaded.
      policies: the store's root.

    Raises:
      PolicyError: closed loop is asked for, and a policy cannot be loaded.
    """
    ids = sorted({m.policy_id for m in measurements})
    if loop == OPEN:
        return {}, "open loop: the recorded commands are replayed"
    gaits = [i for i in ids if i.startswith(GAIT_PREFIX)] if loop == AUTO else []
    found: dict[str, Controller] = {}
    faults: list[str] = []
    for policy_id in ids:
        if policy_id in gaits:
            continue
        try:
            found[policy_id] = _load(policy_id, policies)
        except PolicyError as e:
            if loop == CLOSED:
                raise PolicyError(f"closed loop: {e}") from e  # the rollouts name it, not the user
            faults.append(str(e))
    return found, _said(list(found), gaits, faults)


def _said(acting: list[str], gaits: list[str], faults: list[str]) -> str:
    reasons = ["scripted gaits do not react"] if gaits else []
    reasons += [f"a policy cannot be loaded ({'; '.join(faults)})"] if faults else []
    replayed = f"the recorded commands are replayed, since {' and '.join(reasons)}"
    if not acting:
        return f"open loop: {replayed}"
    act = f"closed loop: {', '.join(acting)} act on the simulated robot"
    return f"{act}; for the other rollouts {replayed}" if reasons else act


def _load(policy_id: str, policies: Path | None) -> Controller:
    reference = policy_id if policy_id.startswith(GAIT_PREFIX) else policy_id.partition("@")[0]
    policy = find_policy(reference, policies) if reference else None
    if policy is None or policy.policy_id != policy_id:
        seen = "none" if policy is None else policy.policy_id
        raise PolicyError(f"the rollouts ran {policy_id or 'an unnamed policy'}, here is {seen}")
    return policy
