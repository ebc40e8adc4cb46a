"""Writes docs/parameters.md, and the README's table of nodes, from the nodes' own parameter classes.

./tcbi python docs/write_parameters.py
"""

from pathlib import Path

from hexapod_driver.driver_node import DriverParameters
from tcbi_bringup.emulated_robot.experimenter_node import Parameters as ExperimenterParameters
from tcbi_contract.parameters import parameter_table
from tcbi_dashboard.dashboard_node import DashboardParameters
from tcbi_infer.inference_node import InferenceParameters
from tcbi_infer.recorder_node import RecorderParameters
from tcbi_infer.replay_node import ReplayParameters
from tcbi_policy.policy_node import PolicyParameters
from tcbi_policy.retrain_node import RetrainParameters
from tcbi_sim.description_node import DescriptionParameters
from tcbi_sim.sim_node import SimParameters

NODES = {
    "tcbi_sim sim_node": (SimParameters, "the robot in simulation"),
    "tcbi_sim description_node": (DescriptionParameters, "the robot's description, latched"),
    "hexapod_driver driver_node": (DriverParameters, "the robot on a serial port"),
    "tcbi_policy policy_node": (PolicyParameters, "the policy at 5 Hz"),
    "tcbi_policy retrain_node": (RetrainParameters, "the action `retrain`"),
    "tcbi_infer recorder_node": (RecorderParameters, "bags, and the action `collect_rollouts`"),
    "tcbi_infer replay_node": (ReplayParameters, "bags back into the graph"),
    "tcbi_infer inference_node": (InferenceParameters, "posterior, model error, diagnosis"),
    "tcbi_dashboard dashboard_node": (DashboardParameters, "the web page"),
    "tcbi_bringup experimenter_node": (ExperimenterParameters, "the hands and the tracker beside an emulated robot"),
}
HEAD = """# Parameters of the nodes

All are read at the start and refused there in one line if unknown or out of range. Set one of a graph with
`./tcbi up --set NODE.name=value` (JSON, or plain text for a `str`; several times for several), of a single node with
`./tcbi run PACKAGE NODE --ros-args -p name:=value`, or with `ros2 run`. Besides these every node takes `use_sim_time`.

A node ends with exit status 0 on Ctrl-C, with 1 and one line where a user can mend it (a wrong parameter, a device
that is not there), with 70 and a traceback where it crashes. `./tcbi up` starts a failed node again, after pauses
that double, and gives it up after five failures in a row, or after two with status 1.

This page is written by `docs/write_parameters.py`; a test holds it to the code.
"""


def text() -> str:
    """The page."""
    parts = [HEAD]
    for node, (parameters, what) in NODES.items():
        rows = [
            f"| `{name}` | `{default}` | {allowed} | {told} |"
            for name, default, allowed, told in parameter_table(parameters)
        ]
        table = ["| parameter | default | allowed | what |", "| --- | --- | --- | --- |", *rows] if rows else ["None."]
        parts.append("\n".join([f"## `{node}`: {what}", "", *table, ""]))
    return "\n".join(parts)


BEGIN, END = "<!-- nodes -->\n", "<!-- end of nodes -->\n"


def overview() -> str:
    """The README's table: each node with its parameters' names."""
    rows = [
        f"| `{node}` | {', '.join(f'`{name}`' for name, *_ in parameter_table(parameters))} |"
        for node, (parameters, _) in NODES.items()
    ]
    return "\n".join(["| node | parameters |", "| --- | --- |", *rows, ""])


def with_overview(readme: str) -> str:
    """The README with its table as it should be."""
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}{overview()}{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    here = Path(__file__)
    here.with_name("parameters.md").write_text(text())
    readme = here.parents[1] / "README.md"
    readme.write_text(with_overview(readme.read_text()))
