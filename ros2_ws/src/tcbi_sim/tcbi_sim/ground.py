"""The ground that a free robot stands on: a body of the model that scenarios tilt, with room for blocks."""

from collections.abc import Sequence

import mujoco

GROUND = 1  # its collision bit
BLOCK_COLOR = [0.55, 0.45, 0.35, 1.0]


def add_ground(
    spec: mujoco.MjSpec,
    blocks: int,
    meets: int,
    friction: Sequence[float],
    solref: Sequence[float],
    solimp: Sequence[float],
) -> None:
    """Add the body `ground` with the plane `ground` and the boxes `block_0`, …, out of sight until they are placed.

    Args:
      spec: of the robot.
      blocks: how many.
      meets: collision bits of what it holds up.
      friction: sliding, torsional, rolling, of every contact with it, whatever the other side's.
      solref: of these contacts, as MuJoCo has them.
      solimp: likewise.
    """
    spec.add_texture(
        name="ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=256,
        height=256,
        rgb1=[0.86, 0.88, 0.90],
        rgb2=[0.78, 0.81, 0.84],
    )
    material = spec.add_material(name="ground", texrepeat=[5, 5], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
    ground = spec.worldbody.add_body(name="ground")
    same = dict(
        contype=GROUND,
        conaffinity=meets,
        condim=4,  # with torsion: a foot that turns on its rubber cap rubs, too
        friction=list(friction),
        priority=1,
        solref=list(solref),
        solimp=list(solimp),
    )
    ground.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.05], material="ground", **same)
    for i in range(blocks):
        ground.add_geom(
            name=f"block_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.05, 0.05, 0.03],
            pos=[0, 0, -5 - i],
            rgba=BLOCK_COLOR,
            **same,
        )
