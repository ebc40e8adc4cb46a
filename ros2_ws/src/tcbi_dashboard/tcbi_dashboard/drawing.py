"""A rig's geometry for the browser, and where its base is while it moves."""

from typing import Any

import mujoco
import numpy as np

from tcbi_sim.measurement import Scenario, quaternion_from_rpy
from tcbi_sim.rig import Rig

SHAPES = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
}


def skeleton(rig: Rig) -> dict[str, Any]:
    """The bodies of a rig as a tree, each with its shapes; lengths in m, quaternions w x y z.

    Returns:
      {"joints", "floating", "bodies": [{"name", "parent", "position", "quaternion", "joint", "axis", "anchor"}],
       "shapes": [{"body", "kind", "size", "position", "quaternion", "joint"}]}; `joint` is an index into "joints" or
       -1: of a body the one that turns it, of a shape the one whose error colours it.
    """
    model = rig.build(0).compile()
    bodies = [_body(model, b, rig) for b in range(1, model.nbody)]
    owner = {b["index"]: b["joint"] for b in bodies}
    shapes = []
    for g in range(model.ngeom):
        kind = SHAPES.get(mujoco.mjtGeom(model.geom_type[g]))
        body = int(model.geom_bodyid[g])
        if kind is None or body == 0:
            continue
        shapes.append(
            {
                "body": body,
                "kind": kind,
                "size": _rounded(model.geom_size[g]),
                "position": _rounded(model.geom_pos[g]),
                "quaternion": _rounded(model.geom_quat[g]),
                "joint": owner[body],
            }
        )
    return {"joints": list(rig.joint_names), "floating": rig.floating, "bodies": bodies, "shapes": shapes}


def _body(model: mujoco.MjModel, b: int, rig: Rig) -> dict[str, Any]:
    joint, axis, anchor = -1, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
    for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
        name = model.joint(j).name
        if name in rig.joint_names:
            joint, axis, anchor = rig.index(name), _rounded(model.jnt_axis[j]), _rounded(model.jnt_pos[j])
    return {
        "index": b,
        "name": model.body(b).name,
        "parent": int(model.body_parentid[b]),
        "position": _rounded(model.body_pos[b]),
        "quaternion": _rounded(model.body_quat[b]),
        "joint": joint,
        "axis": axis,
        "anchor": anchor,
    }


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(v), 6) for v in values]


class Ground:
    """Puts a robot whose place was not measured on its ground: no measurement, only a drawing."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._model = rig.build(0).compile()
        self._data = mujoco.MjData(self._model)
        self._joint = np.array([self._model.joint(name).qposadr[0] for name in rig.joint_names])
        self._feet = np.array([self._model.geom(foot).id for foot in rig.foot_geoms], int)

    def base(
        self, joint_position: np.ndarray, attitude: np.ndarray | None, position: np.ndarray | None, scenario: Scenario
    ) -> np.ndarray:
        """(T, 7) base in the world: position m, quaternion w x y z.

        Args:
          joint_position: (T, J) rad.
          attitude: (T, 4) or None, for a level base.
          position: (T, 3) m from a tracker, or None: the lowest foot then touches the ground.
          scenario: whose slope the ground has.
        """
        result = np.zeros((len(joint_position), 7))
        result[:, 3] = 1.0
        if not self._rig.floating:
            return result
        if attitude is not None:
            result[:, 3:] = attitude
        if position is not None and np.isfinite(position).any():
            result[:, :3] = position
            return result
        if not len(self._feet):
            result[:, 2] = self._rig.stand_height
            return result
        normal = ground_normal(scenario)
        for t, joints in enumerate(joint_position):
            self._data.qpos[:3], self._data.qpos[3:7] = 0.0, result[t, 3:]
            self._data.qpos[self._joint] = joints
            mujoco.mj_kinematics(self._model, self._data)
            height = self._data.geom_xpos[self._feet] @ normal - self._model.geom_size[self._feet, 0]
            result[t, 2] = -height.min() / normal[2]
        return result


def ground_quaternion(scenario: Scenario) -> np.ndarray:
    """(4,) w x y z of the ground in the world."""
    return quaternion_from_rpy(np.array(scenario.slope_roll), np.array(scenario.slope_pitch), np.array(0.0))


def ground_normal(scenario: Scenario) -> np.ndarray:
    """(3,) unit vector out of the ground."""
    w, x, y, z = ground_quaternion(scenario)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
