"""`./tcbi view` draws the robot without a display."""

import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest


def view(*arguments: str, folder: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, since MuJoCo chooses its renderer when it is imported."""
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")} | environment
    command = [sys.executable, "-P", "-m", "tcbi_bringup.cli", "view", *arguments]
    return subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True, timeout=100)


def robot_pixels(image: np.ndarray) -> int:
    """How many pixels have the orange of the legs."""
    red, green, blue = (image[..., i].astype(int) for i in range(3))
    return int(np.sum((red > 120) & (red > green + 30) & (green > blue + 40)))


def frames_of(video: Path, folder: Path) -> list[np.ndarray]:
    """Its frames, by ffmpeg's own program."""
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(video), str(folder / "frame%02d.png")],
        check=True,
    )
    return [imageio.imread(path) for path in sorted(folder.glob("frame*.png"))]


@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="no EGL on this machine (libegl1)")
def test_a_picture_and_a_video_show_the_robot(tmp_path: Path):
    png, mp4 = tmp_path / "robot.png", tmp_path / "robot.mp4"
    done = view("--task", "balance", "--seed", "7", "--png", str(png), "--video", str(mp4), "--seconds", "0.4")
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    picture, frames = imageio.imread(png), frames_of(mp4, tmp_path)
    assert picture.shape[:2] == (540, 960)
    assert 2_000 < robot_pixels(picture) < 60_000
    assert len(frames) == 10
    assert robot_pixels(frames[-1]) > 2_000


@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="no EGL on this machine (libegl1)")
def test_a_display_that_is_named_but_not_there_is_told_and_files_are_drawn(tmp_path: Path):
    done = view("--seconds", "0.1", folder=tmp_path, DISPLAY=":99")
    assert done.returncode == 0, done.stderr
    assert "display :99 opens no window: rendering to files" in done.stderr and "GLFW" not in done.stderr
    assert robot_pixels(imageio.imread(tmp_path / "tcbi_view.png")) > 2_000


@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="no EGL on this machine (libegl1)")
def test_a_rig_that_the_walk_does_not_fit_holds_still(tmp_path: Path):
    mp4 = tmp_path / "bench.mp4"
    done = view("--rig", "servo_bench", "--video", str(mp4), "--seconds", "0.4")
    assert done.returncode == 0, done.stderr
    assert "servo_bench holds still: gait:tripod does not fit it" in done.stderr
    frames = frames_of(mp4, tmp_path)
    assert len(frames) == 10 and frames[0].max() > 40
    assert np.abs(frames[0].astype(int) - frames[-1]).max() < 10


@pytest.mark.parametrize("policy", ["gait:stand", "balance"])
def test_a_policy_that_is_named_and_does_not_fit_is_refused_in_one_line(tmp_path: Path, policy: str):
    done = view("--rig", "servo_bench", "--policy", policy, "--png", str(tmp_path / "bench.png"))
    assert done.returncode == 1 and not (tmp_path / "bench.png").exists()
    (error,) = (line for line in done.stderr.splitlines() if line.startswith("tcbi:"))
    assert f"policy {policy} does not fit this robot" in error and "Traceback" not in done.stderr


def test_a_folder_that_is_not_there_is_named_in_one_line(tmp_path: Path):
    done = view("--png", str(tmp_path / "none" / "robot.png"))
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if line.startswith("tcbi:")]
    assert len(errors) == 1 and str(tmp_path / "none") in errors[0]


def test_an_unknown_task_is_named_with_the_known_ones(tmp_path: Path):
    done = view("--task", "forwards", "--png", str(tmp_path / "robot.png"))
    assert done.returncode == 2
    assert "forwards" in done.stderr and "balance" in done.stderr
