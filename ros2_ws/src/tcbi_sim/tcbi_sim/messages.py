"""Between the sim node's messages and what its pure modules speak; needs ROS."""

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from trajectory_msgs.msg import JointTrajectory

from tcbi_contract.messages import seconds
from tcbi_contract.safety import CommandRefused, Mode, ordered_target
from tcbi_sim.live import LiveSimulation


def read_command(message: JointTrajectory) -> tuple[tuple[float, ...], float]:
    """Targets (rad, the contract's order) and the time of the move (s).

    Raises:
      CommandRefused: not one point, wrong joints, or numbers that are none.
    """
    if len(message.points) != 1:
        raise CommandRefused(f"joint_commands: got {len(message.points)} points, allowed is one")
    point = message.points[0]
    return ordered_target(message.joint_names, point.positions), seconds(point.time_from_start)


def sim_diagnostics(stamp: Time, live: LiveSimulation, facts: dict[str, object], note: str = "") -> DiagnosticArray:
    """Health of the sim node.

    Args:
      stamp: present time.
      live: the simulation.
      facts: more keys and values to show, in order.
      note: what a user should know now; makes the status a warning.
    """
    status = DiagnosticStatus(name="sim_node: simulated robot", hardware_id=live.model.rig)
    status.level, status.message = DiagnosticStatus.OK, "simulating"
    if live.safety.mode is not Mode.ACTIVE:
        status.level, status.message = DiagnosticStatus.WARN, f"limp: {live.safety.reason}"
    if note:
        status.level, status.message = DiagnosticStatus.WARN, note
    if live.diverged:
        status.level, status.message = DiagnosticStatus.ERROR, "the physics broke down; call reset_episode"
    shown = {
        "model": live.model.version,
        "task": live.scenario.task or "none",
        "torque": live.safety.mode.value,
        "needs_reset": str(live.safety.needs_reset).lower(),
        "commands refused": live.refused,
        "last refusal": live.reason or "none",
        **facts,
    }
    status.values = [KeyValue(key=key, value=str(value)) for key, value in shown.items()]
    message = DiagnosticArray(status=[status])
    message.header.stamp = stamp
    return message
