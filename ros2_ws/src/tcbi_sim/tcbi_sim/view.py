"""Show a simulated robot: in MuJoCo's viewer, or as a picture and a video made without a display.

    film = Film(model, scenario, parameters)          # stands at the scenario's start
    film.save_picture(Path("robot.png"))
    film.save_video(Path("robot.mp4"), controller, duration=8.0)
    film.open(controller)                              # a window, until the user closes it

Without a display MuJoCo renders through EGL, for which `prepare_headless` must have been called before mujoco is
imported.
"""

import ctypes.util
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.names import CONTROL_PERIOD_S
from tcbi_sim.errors import SimError

WIDTH, HEIGHT = 960, 540
FRAME_RATE = 25
PROBE_S = 20.0  # wall time that opening a window may take
PROBE = """
import glfw
if not glfw.init():
    raise SystemExit(1)
glfw.window_hint(glfw.VISIBLE, False)
if not glfw.create_window(64, 64, "", None, None):
    raise SystemExit(1)
"""
EGL_REMEDY = "on Debian or Ubuntu: sudo apt install libegl1 libegl-mesa0 libgl1-mesa-dri"


class ViewError(SimError):
    """There is nothing to draw with, or nowhere to draw to."""


@cache
def why_no_window() -> str:
    """Why no window can be opened, or "": tried in another process, which a graphics library may end."""
    display = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
    if not display:
        return "no display"
    try:
        probe = subprocess.run([sys.executable, "-P", "-c", PROBE], capture_output=True, timeout=PROBE_S)
        opened = probe.returncode == 0
    except subprocess.TimeoutExpired:
        opened = False
    return "" if opened else f"display {display} opens no window"


def prepare_headless() -> None:
    """Choose EGL for the rendering; call it before mujoco is imported the first time.

    Raises:
      ViewError: EGL is missing on this machine.
    """
    if os.environ.setdefault("MUJOCO_GL", "egl") == "egl" and ctypes.util.find_library("EGL") is None:
        raise ViewError(f"no display, and no EGL to render without one; {EGL_REMEDY}")


class Film:
    """One simulated episode and a camera that follows the robot."""

    def __init__(self, model, scenario, parameters: np.ndarray | None = None):
        """Stand the robot at the scenario's start.

        Args:
          model: version to show.
          scenario: terrain and posture.
          parameters: (P,) physical values; the model's mean by default.
        """
        from tcbi_sim.engine import Simulator

        values = model.mean() if parameters is None else parameters
        self.scenario = scenario
        self.simulator = Simulator(model, np.asarray(values)[None], [scenario], threads=1, rate=FRAME_RATE * 2.0)

    def frames(self, controller, duration: float) -> Iterator[tuple[object, object]]:
        """(MjModel, MjData) at FRAME_RATE while the controller acts at its own rate; without one it holds still."""
        control_steps = round(CONTROL_PERIOD_S * self.simulator.rate)
        act = _actor(self.simulator, controller, self.scenario.seed)
        for step in range(round(duration * self.simulator.rate)):
            if step % 2 == 0:
                yield self.simulator.materialise(0)
            if step % control_steps == 0:
                act(step / self.simulator.rate)
            self.simulator.advance(1 / self.simulator.rate)

    def save_picture(self, path: Path) -> None:
        """One picture of the start, PNG or JPEG by the file's name."""
        import imageio.v3 as imageio

        with _Painter(shadows=True) as painter:
            _write(path, lambda: imageio.imwrite(path, painter.paint(*self.simulator.materialise(0))))

    def save_video(
        self, path: Path, controller, duration: float, progress: Callable[[int], None] | None = None
    ) -> None:
        """An MP4 of the episode from its start."""
        import imageio_ffmpeg

        def write() -> None:
            writer = imageio_ffmpeg.write_frames(
                str(path), (WIDTH, HEIGHT), fps=FRAME_RATE, macro_block_size=1, ffmpeg_log_level="error"
            )
            writer.send(None)
            try:
                for model, data in self.frames(controller, duration):
                    writer.send(np.ascontiguousarray(painter.paint(model, data)))
                    if progress:
                        progress(1)
            finally:
                writer.close()

        with _Painter(shadows=False) as painter:
            _write(path, write)

    def open(self, controller, duration: float) -> None:
        """A window that plays the episode in real time, over and over, until it is closed."""
        import mujoco.viewer

        model, data = self.simulator.materialise(0)
        with mujoco.viewer.launch_passive(model, data) as viewer:
            viewer.cam.lookat[:], viewer.cam.distance = data.body(1).xpos, 1.2
            while viewer.is_running():
                self.simulator.reset()
                start = time.monotonic()
                for k, (_, now) in enumerate(self.frames(controller, duration)):
                    if not viewer.is_running():
                        return
                    with viewer.lock():
                        data.qpos[:] = now.qpos  # type: ignore[attr-defined]
                        mujoco.mj_forward(model, data)
                    viewer.sync()
                    time.sleep(max(0.0, start + k / FRAME_RATE - time.monotonic()))


def _actor(simulator, controller, seed: int) -> Callable[[float], None]:
    """A function that lets the controller, if there is one, command the simulator at a time."""
    from tcbi_sim.measurement import observation, roll_pitch_yaw

    if controller is None:
        return lambda at: None

    controller.reset(1, np.random.default_rng(seed))
    first = simulator.observe()
    yaw0 = 0.0 if first.attitude is None else roll_pitch_yaw(first.attitude[:, -1])[:, 2]

    def act(at: float) -> None:
        now = simulator.observe()
        attitude = np.array([[1.0, 0, 0, 0]]) if now.attitude is None else now.attitude[:, -1]
        simulator.command(controller.act(at, observation(now.joint_position[:, -1], attitude, yaw0)))

    return act


class _Painter:
    """An offscreen renderer, its light and its camera.

    Args:
      shadows: software rendering takes some 20 times as long with them.
    """

    def __init__(self, shadows: bool):
        self._shadows = shadows

    def __enter__(self) -> "_Painter":
        self._renderer: Any = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._renderer is not None:
            self._renderer.close()

    def paint(self, model, data) -> np.ndarray:
        """(HEIGHT, WIDTH, 3) bytes."""
        import mujoco

        if self._renderer is None:
            model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
            model.vis.quality.shadowsize, model.vis.quality.offsamples = 4096, 4
            model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.28, 0.2
            model.stat.extent = 1.0  # what the shadow map covers
            self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = data.qpos[:3] if model.nq > 7 else [0, 0, 0.25]
        camera.lookat[2] -= 0.03
        camera.distance, camera.azimuth, camera.elevation = 0.95, 130.0, -26.0
        self._renderer.update_scene(data, camera)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        return self._renderer.render()


def _write(path: Path, write: Callable[[], object]) -> None:
    if not path.parent.is_dir():
        raise ViewError(f"cannot write {path}: there is no folder {path.parent}; create it")
    try:
        write()
    except OSError as error:
        raise ViewError(f"cannot write {path}: {error.strerror or error}") from error
