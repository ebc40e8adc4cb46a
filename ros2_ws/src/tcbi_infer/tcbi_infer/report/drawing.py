"""The robot drawn from its own geometry, each part coloured by the error of the joint that moves it."""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import matplotlib
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from tcbi_infer.report.plots import STYLE, to_svg
from tcbi_sim.rig import Rig
from tcbi_sim.simulator import compile_structure

COLORS = matplotlib.colormaps["YlOrRd"]
WIDTH, HEIGHT = 7.6, 2.9  # inch
ROUND = 16  # points on a circle
NEAR_FLOOR = 3.0  # least error from which colours need not begin at the noise floor
UNMEASURED = "#d5d8dc"
TICKS = (1, 2, 3, 5, *(digit * 10**power for power in range(1, 6) for digit in (1, 2, 5)))
X, Y, Z = np.eye(3)
FLOATING = {
    "from above, front up": (-Y, X, Z),
    "left side": (X, Z, Y),
    "right side": (-X, Z, -Y),
}  # right, up, towards the eye
FIXED = {"front": (Y, Z, X), "left side": (X, Z, Y)}


@dataclasses.dataclass(frozen=True)
class Scale:
    """Colours of errors over the noise floor, from the least to the largest on a log scale."""

    low: float
    high: float

    @staticmethod
    def of(values: Iterable[float]) -> "Scale":
        """From the noise floor (1) where the least error is near it."""
        known = [max(float(v), 1.0) for v in values if np.isfinite(v)]
        low = min(known, default=1.0)
        low = 1.0 if low < NEAR_FLOOR else 0.8 * low
        return Scale(low, max([3.0 * low, *known]))

    def share(self, value: float) -> float:
        """0 at the low end, 1 at the high one."""
        return float(np.clip(np.log(value / self.low) / np.log(self.high / self.low), 0.0, 1.0)) if value > 0 else 0.0

    def color(self, value: float) -> Any:
        """Of a part or cell; grey where nothing was measured."""
        return COLORS(self.share(value)) if np.isfinite(value) else UNMEASURED


def robot(rig: Rig, errors: Mapping[str, float], body: float = float("nan"), scale: Scale | None = None) -> str:
    """A drawing of a rig in its posture.

    Args:
      rig: what to draw.
      errors: joint -> error over noise floor; joints that are missing are grey.
      body: error over noise floor of what stands still against the joints, such as the attitude of the trunk.
      scale: of the colours; by default that of these errors alone.
    """
    model = compile_structure(rig, ())
    data = mujoco.MjData(model)
    data.qpos[[model.joint(name).qposadr[0] for name in rig.joint_names]] = rig.at_rest
    mujoco.mj_forward(model, data)
    values = _by_body(model, rig, errors, body)
    shapes = [(values[b], points) for b, points in _parts(model, data)]
    scale = scale or Scale.of(v for v, _ in shapes)
    views = FLOATING if rig.floating else FIXED
    with matplotlib.rc_context(STYLE):
        figure = Canvas(figsize=(WIDTH, HEIGHT), layout="constrained")
        panels = figure.subplots(1, len(views), squeeze=False)[0]
        for axes, (title, view) in zip(panels, views.items(), strict=True):
            _draw(axes, shapes, view, scale)
            axes.set_title(title, fontsize=9)
        if rig.floating:
            _name_legs(panels[0], model, data, rig)
        bar = figure.colorbar(
            ScalarMappable(LogNorm(scale.low, scale.high), COLORS), ax=list(panels), shrink=0.85, pad=0.01
        )
        marks: list[float] = [t for t in TICKS if scale.low <= t <= scale.high]
        marks = marks if len(marks) > 1 else [scale.low, scale.high]
        bar.set_ticks(marks, labels=[f"{t:.3g}" for t in marks], minor=False)
        bar.ax.minorticks_off()
        bar.set_label("error / noise floor")
        return to_svg(figure)


def _by_body(model: mujoco.MjModel, rig: Rig, errors: Mapping[str, float], body: float) -> dict[int, float]:
    """Body -> error of the nearest joint above it; the trunk's own where there is none."""
    own: dict[int, float] = {}
    for name in rig.joint_names:
        at = int(model.jnt_bodyid[model.joint(name).id])
        own[at] = float(np.fmax(own.get(at, np.nan), errors.get(name, np.nan)))
    values = {}
    for b in range(model.nbody):
        above = b
        while above and above not in own:
            above = int(model.body_parentid[above])
        values[b] = own.get(above, body)
    return values


def _parts(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[int, np.ndarray]]:
    """Body and surface points (n, 3) in m of everything that belongs to the robot."""
    parts = []
    for g in range(model.ngeom):
        b = int(model.geom_bodyid[g])
        name = model.body(b).name
        shown = model.geom_rgba[g, 3] > 0 and name != "ground" and not name.startswith("block_")
        local = _surface(model, g)
        if b and shown and len(local):
            parts.append((b, local @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]))
    return parts


def _surface(model: mujoco.MjModel, g: int) -> np.ndarray:
    """(n, 3) points on a geom in its own frame; none of a plane."""
    size, kind = model.geom_size[g], mujoco.mjtGeom(int(model.geom_type[g]))
    angle = np.linspace(0, 2 * np.pi, ROUND, endpoint=False)
    tilt = np.linspace(-np.pi / 2, np.pi / 2, ROUND // 2 + 1)
    ball = np.array([(np.cos(t) * np.cos(a), np.cos(t) * np.sin(a), np.sin(t)) for t in tilt for a in angle])
    ends = np.array([[0, 0, size[1]], [0, 0, -size[1]]])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return ball * size[0]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return ball * size
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.concatenate([ball * size[0] + end for end in ends])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(ROUND)], axis=-1) * size[0]
        return np.concatenate([circle + end for end in ends])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.array(list(itertools.product((-1, 1), repeat=3))) * size
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[g])
        first = int(model.mesh_vertadr[mesh])
        return model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(float)
    return np.empty((0, 3))


def _draw(
    axes: Axes, shapes: list[tuple[float, np.ndarray]], view: tuple[np.ndarray, np.ndarray, np.ndarray], scale: Scale
) -> None:
    right, up, near = view
    for value, points in sorted(shapes, key=lambda s: float(np.mean(s[1] @ near))):
        flat = np.stack([points @ right, points @ up], axis=-1)
        outline = flat[ConvexHull(flat).vertices]
        color = scale.color(value)
        axes.add_patch(Polygon(outline, closed=True, facecolor=color, edgecolor="#5b6470", lw=0.5))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.axis("off")


def _name_legs(axes: Axes, model: mujoco.MjModel, data: mujoco.MjData, rig: Rig) -> None:
    """Leg names beside their ends in the view from above."""
    for leg, joints in rig.legs.items():
        tip = model.jnt_bodyid[model.joint(joints[-1]).id]
        end = data.geom_xpos[model.geom_bodyid == tip].mean(axis=0) if (model.geom_bodyid == tip).any() else None
        if end is not None:
            place = (16 * float(np.sign(-end[1])), 0.0)
            axes.annotate(leg, (-end[1], end[0]), place, textcoords="offset points", ha="center", va="center", size=8)
