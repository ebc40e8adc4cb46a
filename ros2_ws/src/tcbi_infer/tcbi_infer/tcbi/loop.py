"""Who acts in the simulation: each rollout's own policy (closed loop), or its recorded commands (open loop)."""

from collections.abc import Sequence
from pathlib import Path

from tcbi_policy.artefact import GAIT_PREFIX, find_policy
from tcbi_policy.errors import PolicyError
from tcbi_sim.engine import Controller
from tcbi_sim.measurement import Measurement


def find_controllers(
    measurements: Sequence[Measurement], loop: str, policies: Path | None
) -> tuple[dict[str, Controller], str]:
    """Policy id -> controller, empty for open loop, and a line that says which and why.

    Raises:
      PolicyError: closed loop is asked for, and a policy cannot be loaded.
    """
    ids = sorted({m.policy_id for m in measurements})
    if loop == "open":
        return {}, "open loop: the recorded commands are replayed"
    if loop == "auto" and all(i.startswith(GAIT_PREFIX) for i in ids):
        return {}, "open loop: scripted gaits do not react, so the recorded commands are replayed"
    found: dict[str, Controller] = {}
    try:
        for policy_id in ids:
            found[policy_id] = _load(policy_id, policies)
    except PolicyError as e:
        if loop == "closed":
            raise PolicyError(f"closed loop: {e}") from e  # the rollouts name it, not the user
        return {}, f"open loop: the recorded commands are replayed, since a policy cannot be loaded ({e})"
    return found, f"closed loop: {', '.join(ids)} act on the simulated robot"


def _load(policy_id: str, policies: Path | None) -> Controller:
    reference = policy_id if policy_id.startswith(GAIT_PREFIX) else policy_id.partition("@")[0]
    policy = find_policy(reference, policies) if reference else None
    if policy is None or policy.policy_id != policy_id:
        seen = "none" if policy is None else policy.policy_id
        raise PolicyError(f"the rollouts ran {policy_id or 'an unnamed policy'}, here is {seen}")
    return policy
