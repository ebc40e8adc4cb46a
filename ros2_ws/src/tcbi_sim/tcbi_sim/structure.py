"""The MuJoCo model of a rig with the structural changes of effects: compiled once, before any simulation."""

import copy
import functools
from collections.abc import Sequence

import mujoco

from tcbi_sim.effect import EffectUse
from tcbi_sim.errors import SimError
from tcbi_sim.rig import Rig


def silence_mujoco() -> None:
    """Keep MuJoCo's warnings off the console and out of MUJOCO_LOG.TXT; divergence is reported per simulation."""
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    config.set()


def compile_structure(rig: Rig, uses: Sequence[EffectUse], blocks: int = 0) -> mujoco.MjModel:
    """The MuJoCo model of a rig with the structural changes of some effects, at nominal parameters; the caller's own.

    Raises:
      SimError: MuJoCo refuses what an effect has changed.
    """
    return copy.copy(_compiled(rig, tuple(uses), blocks))


@functools.lru_cache(maxsize=64)
def _compiled(rig: Rig, uses: tuple[EffectUse, ...], blocks: int) -> mujoco.MjModel:
    try:
        return edited_spec(rig, uses, blocks).compile()
    except ValueError as e:
        keys = ", ".join(use.key for use in uses if use.effect.edit)
        raise SimError(
            f"MuJoCo refuses {rig.name} as edit() of {keys} has changed it: {' '.join(str(e).split())}"
        ) from e


def edited_spec(rig: Rig, uses: Sequence[EffectUse], blocks: int = 0) -> mujoco.MjSpec:
    """A rig's spec with the structural changes of some effects."""
    spec = rig.build(blocks)
    for use in uses:
        use.edit(spec, rig)
    return spec
