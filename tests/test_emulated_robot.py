"""The emulated robot behind its port: the driver drives it, the experimenter places it, the tracker sees it."""

from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Imu, JointState

from tcbi_bringup.launcher import NodeProcess
from tcbi_contract import messages, names
from tcbi_msgs.srv import ResetEpisode

pytestmark = pytest.mark.graph

LEAN = 0.2  # rad


def processes(folder: Path) -> tuple[NodeProcess, NodeProcess, NodeProcess]:
    """Robot, driver, experimenter."""
    port, sock = str(folder / "robot.port"), str(folder / "robot.sock")
    arguments = ("--seed", "3", "--hidden", "none", "--link-path", port, "--socket", sock)
    robot = NodeProcess("tcbi_bringup", "emulated_robot", arguments=arguments, ros=False)
    driver = NodeProcess("hexapod_driver", "driver_node", parameters={"port": port})
    experimenter = NodeProcess("tcbi_bringup", "experimenter_node", parameters={"socket": sock})
    return robot, driver, experimenter


def test_the_driver_drives_it_and_the_experimenter_tilts_its_ground(start_graph, peer, tmp_path: Path) -> None:
    robot, driver, experimenter = processes(tmp_path)
    start_graph(robot, wait=False)
    peer.wait_until((tmp_path / "robot.port").exists, "the robot's port")
    start_graph(driver, experimenter)
    joints = peer.collect(names.JOINT_STATES, JointState, messages.STREAM_QOS)
    attitudes = peer.collect(names.IMU, Imu, messages.STREAM_QOS)
    poses = peer.collect(names.TRACKER_POSE, PoseStamped, messages.STREAM_QOS)

    posture = np.tile([0.1, 0.1, -0.1], 6)
    peer.reset(joint_position=posture.tolist())
    placed = peer.call("place_robot", ResetEpisode.Request(slope_roll=LEAN), ResetEpisode)
    assert placed.success, placed.message
    for seen in (joints, attitudes, poses):
        seen.clear()
    peer.wait_until(lambda: min(len(joints), len(attitudes), len(poses)) >= 20, "twenty of each signal")

    assert np.abs(np.array(joints[-1].position) - posture).max() < 0.3
    assert 2 * np.arcsin(attitudes[-1].orientation.x) == pytest.approx(LEAN, abs=0.06)
    assert 2 * np.arcsin(poses[-1].pose.orientation.x) == pytest.approx(LEAN, abs=0.06)
    position = poses[-1].pose.position
    assert np.hypot(position.x, position.y) < 0.06 and 0.05 < position.z < 0.2
    assert messages.seconds(joints[-1].header.stamp) >= messages.seconds(placed.stamp)

    refused = peer.call("place_robot", ResetEpisode.Request(slope_pitch=1.0), ResetEpisode)
    assert not refused.success and "slope_pitch" in refused.message
