"""Which processes make a graph: a robot or its simulation, and what acts, records, infers and trains beside it."""

from dataclasses import dataclass
from pathlib import Path

from tcbi_bringup.errors import LaunchError
from tcbi_bringup.launcher import NodeProcess

SIM, EMULATED = "sim", "emulated"


@dataclass(frozen=True)
class GraphOptions:
    """What a user asks for.

    Attributes:
      robot: "sim", "emulated", or the serial port of a real robot.
      task: task of the simulation's terrain at the start; "" for flat ground.
      policy: what acts at first, e.g. "gait:tripod" or a file; "" for the policy node's own default.
      model: model version to simulate, and to compare with.
      lockstep: simulate as fast as it goes (sim only).
      namespace: before every topic.
      store: folder of models, policies, rollouts, runs; None for the default.
      seed: of the simulation or the emulated robot.
      learning: start the inference and the retrain node too.
    """

    robot: str = SIM
    task: str = ""
    policy: str = ""
    model: str = "latest"
    lockstep: bool = False
    namespace: str = ""
    store: Path | None = None
    seed: int = 0
    learning: bool = True

    def check(self) -> None:
        """Refuse what does not go together.

        Raises:
          LaunchError: in one line.
        """
        if self.lockstep and self.robot != SIM:
            raise LaunchError(
                f"--lockstep: got --robot {self.robot}, allowed is sim; a robot does not wait for commands"
            )
        if self.robot not in (SIM, EMULATED) and not Path(self.robot).exists():
            raise LaunchError(
                f"--robot: got {self.robot!r}, allowed is sim, emulated, or a serial port that exists; "
                f"{_ports_present()}; switch the robot on and pair it, then call again"
            )


def _ports_present() -> str:
    from serial.tools.list_ports import comports

    found = [port.device for port in comports()]
    return f"ports present: {', '.join(found)}" if found else "no serial port is present"


def robot_processes(options: GraphOptions, port: Path) -> list[NodeProcess]:
    """The robot's side of the graph.

    Args:
      options: what to start.
      port: where an emulated robot puts its serial port.
    """
    common = {"namespace": options.namespace, "essential": True}
    if options.robot == SIM:
        parameters = {
            "mode": "lockstep" if options.lockstep else "realtime",
            "model": options.model,
            "seed": options.seed,
        }
        parameters |= {"task": options.task} if options.task else {}
        return [NodeProcess("tcbi_sim", "sim_node", parameters=parameters | _store(options), **common)]
    driver = NodeProcess(
        "hexapod_driver",
        "driver_node",
        parameters={"port": str(port) if options.robot == EMULATED else options.robot},
        **common,
    )
    if options.robot != EMULATED:
        return [driver]
    arguments = ("--link", str(port), "--seed", str(options.seed))
    emulated = NodeProcess("tcbi_bringup", "emulated_robot", arguments=arguments, ros=False, essential=True)
    return [emulated, driver]


def companion_processes(options: GraphOptions) -> list[NodeProcess]:
    """All the rest: description, policy, recorder, inference, retraining."""
    clock = {"use_sim_time": True} if options.lockstep else {}

    def node(package: str, executable: str, **parameters: object) -> NodeProcess:
        return NodeProcess(package, executable, namespace=options.namespace, parameters={**parameters, **clock})

    policy = {"policy": options.policy} if options.policy else {}
    nodes = [
        node("tcbi_sim", "description_node"),
        node("tcbi_policy", "policy_node", **policy, **_store(options)),
        node("tcbi_infer", "recorder_node", **_store(options)),
    ]
    if options.learning:
        nodes += [
            node("tcbi_infer", "inference_node", **_store(options)),
            node("tcbi_policy", "retrain_node", **_store(options)),
        ]
    return nodes


def _store(options: GraphOptions) -> dict[str, str]:
    return {"store": str(options.store)} if options.store else {}
