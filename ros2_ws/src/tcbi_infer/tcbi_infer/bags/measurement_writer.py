"""Write a measurement as a bag of the contract, so that simulated and imported rollouts are bags like any other."""

from pathlib import Path

from tcbi_infer.bags.encoding import messages
from tcbi_infer.bags.writer import BagWriter
from tcbi_sim.measurement import Measurement

START_NS = 1_000_000_000  # stamp of BEGIN where nothing says when it was; zero would mean "no stamp"


def write_measurement(
    folder: Path | str,
    measurement: Measurement,
    *,
    start_ns: int = START_NS,
    namespace: str = "",
    torque_commands: bool = False,
) -> Path:
    """Write `folder/<rollout_id>/`; reading it gives the same measurement, times rounded to the nanosecond.

    Args:
      start_ns: stamp of the BEGIN event, ns.
      namespace: put before every topic.
      torque_commands: the targets are torques (N m), as for a rig whose kind is torque.

    Returns:
      The bag's folder.

    Raises:
      BagError: a bag of this name is there already.
      RecordingError: the disk refuses it.
    """
    root = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    with BagWriter(Path(folder), measurement.rollout_id, {"rig": measurement.rig}) as bag:
        for topic, time, data in messages(measurement, start_ns, torque_commands):
            bag.write(root + topic, time, data)
    return bag.path
