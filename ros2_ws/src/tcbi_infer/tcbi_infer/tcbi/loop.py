"""Who acts in a simulated rollout: the recorded commands (open loop), or the policy that ran (closed loop).

What a policy commands depends on the robot through what it sees alone. So with all readings at hand its commands would
tell nothing more of the parameters, and a policy that acts anew adds the scatter of its own reactions. But histograms
keep only part of the readings, and a policy that holds the robot in place amplifies small deviations in them. Which is
worth more was measured (docs/tcbi_measured.md): walks and noisy readings are replayed, else policies act.
"""

from collections.abc import Sequence
from pathlib import Path

from tcbi_policy.artefact import GAIT_PREFIX, find_policy
from tcbi_policy.errors import PolicyError, PolicyNotFound
from tcbi_policy.reward import counts_distance, has_reward
from tcbi_sim.engine import Controller
from tcbi_sim.measurement import Measurement

AUTO, OPEN, ACTING, CLOSED = LOOPS = ("auto", "open", "acting", "closed")


def find_controllers(
    measurements: Sequence[Measurement], loop: str, policies: Path | None, noisy: Sequence[str] = ()
) -> tuple[dict[str, Controller], str]:
    """Policy id -> controller of the policies that act, and a line that says which, and why others do not.

    Args:
      measurements: the real rollouts.
      loop: `OPEN`; `CLOSED`; `ACTING`, closed but for scripted gaits and policies that cannot be loaded; or `AUTO`,
        which is `ACTING` but for rollouts of tasks that count distance, and `OPEN` where signals are noisy.
      policies: the store's root.
      noisy: signals that are noisier than the rig's sensors.

    Raises:
      PolicyError: closed loop is asked for, and a policy cannot be loaded.
    """
    if loop == OPEN:
        return {}, "open loop: the recorded commands are replayed"
    found: dict[str, Controller] = {}
    reasons: dict[str, None] = {}  # of those that do not act, each once, in order
    faults: list[str] = []
    for policy_id in sorted({m.policy_id for m in measurements}):
        if loop != CLOSED and policy_id.startswith(GAIT_PREFIX):
            reasons["scripted gaits do not react"] = None
        elif loop == AUTO and (why := _why_replayed([m for m in measurements if m.policy_id == policy_id], noisy)):
            reasons[why] = None
        else:
            try:
                found[policy_id] = _load(policy_id, policies)
            except PolicyError as e:
                if loop == CLOSED:
                    raise PolicyError(f"closed loop: {e}") from e  # the rollouts name it, not the user
                faults.append(f"{policy_id} is not here" if isinstance(e, PolicyNotFound) else str(e))
    return found, _said(
        list(found), [*reasons, *([f"a policy cannot be loaded ({'; '.join(faults)})"] if faults else [])]
    )


def _why_replayed(measurements: Sequence[Measurement], noisy: Sequence[str]) -> str:
    """Why a policy that could act does not by `AUTO`; empty if it does."""
    if noisy:
        return "readings are noisy"
    walks = sorted({t for m in measurements if has_reward(t := m.scenario.task) and counts_distance(t)})
    return f"task {' and '.join(walks)} counts distance" if walks else ""


def _said(acting: list[str], reasons: list[str]) -> str:
    replayed = f"the recorded commands are replayed, since {' and '.join(reasons)}"
    if not acting:
        return f"open loop: {replayed}"
    act = f"closed loop: {', '.join(acting)} act{'s' * (len(acting) == 1)} on the simulated robot"
    return f"{act}; for the other rollouts {replayed}" if reasons else act


def _load(policy_id: str, policies: Path | None) -> Controller:
    reference = policy_id if policy_id.startswith(GAIT_PREFIX) else policy_id.partition("@")[0]
    policy = find_policy(reference, policies) if reference else None
    if policy is None or policy.policy_id != policy_id:
        seen = "none" if policy is None else policy.policy_id
        raise PolicyError(f"the rollouts ran {policy_id or 'an unnamed policy'}, here is {seen}")
    return policy
