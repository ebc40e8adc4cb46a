"""Which processes make a graph: a robot or its simulation, and what acts, records, infers and trains beside it."""

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from hexapod_driver.calibration import load as load_calibration
from tcbi_bringup.emulated_robot.hidden_names import STRENGTHS
from tcbi_bringup.errors import LaunchError, WrongCallError
from tcbi_bringup.launcher import Graph, NodeProcess
from tcbi_bringup.node_parameters import Setting, given_parameters
from tcbi_policy.artefact import find_policy
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.store import LATEST, ModelStore
from tcbi_sim.tasks import find_task

SIM, EMULATED, NONE = "sim", "emulated", "none"
AFTER_CRASH = {"needs_reset": True}  # of the driver: an emergency stop must not end with its process
PORT_S = 20.0  # time an emulated robot has to open its port


@dataclass(frozen=True)
class GraphOptions:
    """What a user asks for.

    Attributes:
      store: folder of models, policies, rollouts and runs.
      robot: "sim", "emulated", the serial port of a real robot, or "none" for what a replay plays.
      task: task of the simulation's terrain at the start; "" for flat ground.
      policy: what acts at first, e.g. "gait:tripod" or a file; "" for the policy node's own default.
      model: model version to simulate, and to compare with.
      lockstep: simulate as fast as it goes (sim only).
      namespace: before every topic.
      seed: of the simulation or the emulated robot.
      sensor_port: a real robot's second port, "" where everything goes over one.
      calibration: a real robot's file, "" for the shipped one.
      hidden: effect in the emulated robot, "" to draw it from the seed.
      strength: of that effect, "" for the default.
      learning: start the inference and the retrain node too.
      recordings: where rollouts are recorded and looked for; None for a folder of the store.
      baud_rate: of a real robot's port, bit/s; 0 for the driver's own.
      sensor_baud_rate: of its second port.
      settings: parameters of nodes, beside what the graph gives them, or in its place.
    """

    store: Path
    robot: str = SIM
    task: str = ""
    policy: str = ""
    model: str = "latest"
    lockstep: bool = False
    namespace: str = ""
    seed: int = 0
    sensor_port: str = ""
    calibration: str = ""
    hidden: str = ""
    strength: str = ""
    learning: bool = True
    recordings: Path | None = None
    baud_rate: int = 0
    sensor_baud_rate: int = 0
    settings: tuple[Setting, ...] = ()

    @property
    def bags(self) -> Path:
        """Where rollouts are recorded and looked for; each namespace has a recorder, hence a folder of its own."""
        return self.recordings or self.store / "rollouts" / self.namespace

    @property
    def simulated_time(self) -> bool:
        """Whether the nodes take their time from `/clock`."""
        return self.lockstep or self.robot == NONE

    def check(self) -> None:
        """Refuse what does not go together, and a task, a model or a policy that no node could load.

        Raises:
          LaunchError: a port or the folder of recordings cannot be used, in one line.
          CalibrationError: the file cannot be read, or says what cannot be.
          PolicyError: the policy does not exist, is damaged, or is another robot's.
          UnknownNameError: there is no such task or model version.
          WrongCallError: options that do not go together, or a setting that no node has or allows.
        """
        if self.lockstep and self.robot != SIM:
            raise WrongCallError(
                f"--lockstep: got --robot {self.robot}, allowed is sim; a robot does not wait for commands"
            )
        for option, choice in (("--hidden", self.hidden), ("--strength", self.strength)):
            if choice and self.robot != EMULATED:
                raise WrongCallError(
                    f"{option}: got --robot {self.robot}, allowed is emulated; only there is known what is hidden"
                )
        for option, chosen in (("--task", self.task), ("--seed", self.seed)):
            if chosen and self.robot == NONE:
                raise WrongCallError(f"{option}: got --robot none, allowed is sim or emulated; a replay has its own")
        if self.robot in (SIM, EMULATED, NONE):
            for option, value in (
                ("--sensor-port", self.sensor_port),
                ("--calibration", self.calibration),
                ("--baud-rate", self.baud_rate),
                ("--sensor-baud-rate", self.sensor_baud_rate),
            ):
                if value:
                    raise WrongCallError(
                        f"{option}: got --robot {self.robot}, allowed is a serial port; only a real robot has one"
                    )
        else:
            self._check_ports()
            load_calibration(self.calibration)
        if self.task:
            find_task(self.task)
        known = ModelStore(self.store).versions("hexapod")
        if self.model not in (LATEST, *known):
            raise UnknownNameError("model version", self.model, known)
        if self.policy:
            find_policy(self.policy, self.store)
        graph_processes(self, Path())
        self._check_recordings()

    def _check_recordings(self) -> None:
        try:
            self.bags.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.bags):
                pass
        except OSError as error:
            raise LaunchError(
                f"{self.bags} cannot be used for recordings ({error.strerror}); choose another folder"
            ) from error

    def _check_ports(self) -> None:
        for option, port in (("--robot", self.robot), ("--sensor-port", self.sensor_port)):
            simulated = "sim, emulated, none, or " if option == "--robot" else ""
            if port and not Path(port).exists():
                raise LaunchError(
                    f"{option}: got {port!r}, allowed is {simulated}a serial port that exists; {_ports_present()}; "
                    "switch the robot on and pair it, then call again"
                )


def _ports_present() -> str:
    from serial.tools.list_ports import comports

    found = [port.device for port in comports()]
    return f"ports present: {', '.join(found)}" if found else "no serial port is present"


def robot_processes(options: GraphOptions, folder: Path) -> list[NodeProcess]:
    """The robot's side of the graph, nothing where there is none.

    Args:
      options: what to start.
      folder: short path of a folder for an emulated robot's port and socket.
    """
    if options.robot == NONE:
        return []
    node = partial(NodeProcess, namespace=options.namespace, essential=True)
    driver = partial(node, "hexapod_driver", "driver_node", after_crash=AFTER_CRASH)
    if options.robot == SIM:
        mode = "lockstep" if options.lockstep else "realtime"
        parameters = {"mode": mode, "model": options.model, "seed": options.seed, "task": options.task}
        return [node("tcbi_sim", "sim_node", parameters={**parameters, "store": str(options.store)})]
    if options.robot != EMULATED:
        calibration = str(Path(options.calibration).expanduser().resolve()) if options.calibration else ""
        link = {"port": options.robot, "sensor_port": options.sensor_port, "calibration": calibration}
        rates = {"baud_rate": options.baud_rate, "sensor_baud_rate": options.sensor_baud_rate}
        given = {name: rate for name, rate in rates.items() if rate}
        return [driver(parameters={**link, **given})]
    port, socket = emulated_port(folder), folder / "socket"
    place = ("--link", str(port), "--socket", str(socket))
    hidden = ("--hidden", options.hidden) if options.hidden else ()
    arguments = (*place, "--seed", str(options.seed), "--strength", options.strength or STRENGTHS[0], *hidden)
    return [
        NodeProcess("tcbi_bringup", "emulated_robot", arguments=arguments, ros=False, essential=True),
        driver(parameters={"port": str(port)}),
        node("tcbi_bringup", "experimenter_node", parameters={"socket": str(socket)}, essential=False),
    ]


def newest_model(store: Path) -> str:
    """The model version that a simulation takes where none is named."""
    return ModelStore(store).versions("hexapod")[-1]


def emulated_port(folder: Path) -> Path:
    """Where an emulated robot puts its serial port."""
    return folder / "port"


def companion_processes(options: GraphOptions) -> list[NodeProcess]:
    """All the rest: description, policy, recorder, inference, retraining."""
    clock = {"use_sim_time": True} if options.simulated_time else {}
    store = {"store": str(options.store)}

    def node(package: str, executable: str, parameters: Mapping[str, object]) -> NodeProcess:
        return NodeProcess(package, executable, namespace=options.namespace, parameters={**parameters, **clock})

    nodes = [
        node("tcbi_sim", "description_node", {}),
        node("tcbi_policy", "policy_node", {**store, **({"policy": options.policy} if options.policy else {})}),
        node("tcbi_infer", "recorder_node", {"folder": str(options.bags)}),
    ]
    if options.learning:
        watched = {**store, "bags": str(options.bags), "model": options.model}
        nodes += [node("tcbi_infer", "inference_node", watched), node("tcbi_policy", "retrain_node", store)]
    return nodes


def graph_processes(options: GraphOptions, folder: Path) -> list[NodeProcess]:
    """All processes, in the order of their start, with the parameters that were set.

    Raises:
      WrongCallError: a setting names what no node has, or a value that it does not allow.
    """
    processes = [*robot_processes(options, folder), *companion_processes(options)]
    given = given_parameters(options.settings, processes)
    return [replace(p, parameters={**p.parameters, **given.get(p.key, {})}) for p in processes]


def start_graph(
    graph: Graph, options: GraphOptions, folder: Path, end_asked: Callable[[], bool] = lambda: False
) -> None:
    """Start all processes, an emulated robot's driver once there is a port to open.

    Args:
      graph: to start them in.
      options: what to start.
      folder: short path of a folder for an emulated robot's port and socket.
      end_asked: whether somebody has asked for the end, who does not wait for the port.

    Raises:
      LaunchError: the emulated robot has ended, or opens no port.
    """
    for process in graph_processes(options, folder):
        graph.start(process)
        if not process.ros:
            _wait_for_port(emulated_port(folder), graph, end_asked)


def _wait_for_port(port: Path, graph: Graph, end_asked: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PORT_S
    while not port.exists() and not end_asked():
        graph.check_briefly()
        if time.monotonic() > deadline:
            raise LaunchError(f"the emulated robot opened no port within {PORT_S:g} s; see {graph.log_dir}")
        time.sleep(0.05)
