"""Who acts in a simulated rollout: the policy that ran (closed loop), or the recorded commands (open loop)."""

from collections.abc import Sequence
from pathlib import Path

from tcbi_policy.artefact import GAIT_PREFIX, find_policy
from tcbi_policy.errors import PolicyError
from tcbi_sim.engine import Controller
from tcbi_sim.measurement import Measurement


def find_controllers(
    measurements: Sequence[Measurement], loop: str, policies: Path | None
) -> tuple[dict[str, Controller], str]:
    """Policy id -> controller of the policies that act, and a line that says which, and why others do not.

    Unless the loop is given, scripted gaits and policies that cannot be loaded are replayed by their commands.

    Raises:
      PolicyError: closed loop is asked for, and a policy cannot be loaded.
    """
    ids = sorted({m.policy_id for m in measurements})
    if loop == "open":
        return {}, "open loop: the recorded commands are replayed"
    gaits = [i for i in ids if i.startswith(GAIT_PREFIX)] if loop == "auto" else []
    found: dict[str, Controller] = {}
    faults: list[str] = []
    for policy_id in ids:
        if policy_id in gaits:
            continue
        try:
            found[policy_id] = _load(policy_id, policies)
        except PolicyError as e:
            if loop == "closed":
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
