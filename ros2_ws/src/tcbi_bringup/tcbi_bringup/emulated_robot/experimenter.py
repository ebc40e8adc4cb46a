"""The experimenter's hands and the lab's tracker: a local socket beside the robot, which no driver knows of.

A real robot has no service that tilts its ground; a person does that. This Unix socket stands for the person: one JSON
object a line, one answer a line.

    {"do": "place", "slope_roll": 0.1, "slope_pitch": 0.0, "yaw": 0.0,
     "blocks": [{"center": [0.4, 0, 0.035], "size": [0.15, 0.6, 0.07], "yaw": 0}]}   ->  {"ok": true}
    {"do": "pose"}  ->  {"ok": true, "time": 12.3, "position": [x, y, z], "orientation": [w, x, y, z]}
    anything wrong  ->  {"ok": false, "error": "one line"}
"""

import json
import os
import socket
import socketserver
import stat
import tempfile
import threading
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.live_body import LiveBody
from tcbi_bringup.emulated_robot.mechanics import Box, Scene
from tcbi_contract.errors import describe
from tcbi_contract.names import SLOPE_LIMIT

TIMEOUT_S = 5.0


def default_socket_path() -> Path:
    """Where the emulated robot's socket lies unless it is told otherwise: one a user and ROS domain."""
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    return folder / f"tcbi-emulated-robot-{os.getuid()}-{os.environ.get('ROS_DOMAIN_ID', '0')}.sock"


class ExperimenterServer:
    """Answers on the socket from a thread of its own while the context is open.

    Raises:
      EmulatedRobotError: another process answers there, or the path cannot be bound.
    """

    def __init__(self, body: LiveBody, path: Path):
        _make_free(path)
        self.path = path
        try:
            self._server = _Server(str(path), _Handler)
        except OSError as error:
            raise EmulatedRobotError(
                f"cannot open the experimenter's socket {path}: {error}; choose another"
            ) from error
        self._server.daemon_threads = True
        self._server.body = body
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="experimenter", daemon=True
        )

    def __enter__(self) -> "ExperimenterServer":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self.path.unlink(missing_ok=True)


class _Server(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
    body: LiveBody


class _Handler(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        assert isinstance(self.server, _Server)
        try:
            for line in self.rfile:
                self.wfile.write(json.dumps(answer(self.server.body, line)).encode() + b"\n")
        except (BrokenPipeError, ConnectionResetError):
            return


def answer(body: LiveBody, line: bytes) -> dict[str, Any]:
    """Do what one line asks."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise EmulatedRobotError("a request is one JSON object on one line")
        what = request.get("do")
        if what == "place":
            body.place(read_scene(request))
            return {"ok": True}
        if what == "pose":
            time, position, orientation = body.pose()
            return {"ok": True, "time": time, "position": position.tolist(), "orientation": orientation.tolist()}
        raise EmulatedRobotError(describe("request 'do'", what, "'place' or 'pose'"))
    except json.JSONDecodeError as error:
        return {"ok": False, "error": f"not JSON: {error}"}
    except EmulatedRobotError as error:
        return {"ok": False, "error": str(error)}


def read_scene(table: dict[str, Any]) -> Scene:
    """A scene from its JSON form.

    Raises:
      EmulatedRobotError: a wrong key, type or value.
    """
    unknown = sorted(set(table) - {"do", "slope_roll", "slope_pitch", "yaw", "blocks"})
    if unknown:
        raise EmulatedRobotError(f"unknown keys of a scene: {', '.join(unknown)}")
    try:
        blocks = tuple(
            Box(_vector(block["center"]), _vector(block["size"]), float(block.get("yaw", 0.0)))
            for block in table.get("blocks", ())
        )
        roll, pitch, yaw = (float(table.get(name, 0.0)) for name in ("slope_roll", "slope_pitch", "yaw"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise EmulatedRobotError(f"a scene needs numbers, and blocks with center and size: {error!r}") from error
    return checked(Scene(roll, pitch, blocks, yaw))


def checked(scene: Scene) -> Scene:
    """The scene, if it can be set up.

    Raises:
      EmulatedRobotError: a slope beyond the contract's limit, a block without volume, or a number that is none.
    """
    for name, value in (("slope_roll", scene.slope_roll), ("slope_pitch", scene.slope_pitch)):
        if not abs(value) <= SLOPE_LIMIT + 1e-9:
            raise EmulatedRobotError(describe(f"{name} (rad)", value, f"-{SLOPE_LIMIT:.4f} to {SLOPE_LIMIT:.4f}"))
    numbers = [scene.yaw, *(v for b in scene.blocks for v in (*b.center, *b.size, b.yaw))]
    if not np.all(np.isfinite(numbers)):
        raise EmulatedRobotError("a scene's numbers must be finite")
    if any(edge <= 0 for block in scene.blocks for edge in block.size):
        raise EmulatedRobotError("a block's edges must be longer than 0 m")
    return scene


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)


def _make_free(path: Path) -> None:
    """Remove what a killed process left; refuse what is alive or is no socket."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise EmulatedRobotError(f"{path} exists and is no socket; choose another --socket")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
    raise EmulatedRobotError(f"another emulated robot answers on {path}; stop it or choose another --socket")


class ExperimenterClient:
    """The other end of the socket; one connection, opened on first use and again after a fault."""

    def __init__(self, path: Path):
        self._path = path
        self._socket: socket.socket | None = None
        self._stream: Any = None

    def place(self, scene: Scene) -> None:
        """Set up the ground and put the robot down.

        Raises:
          EmulatedRobotError: no robot there, or it refused.
        """
        blocks = [{"center": b.center, "size": b.size, "yaw": b.yaw} for b in scene.blocks]
        slopes = {"slope_roll": scene.slope_roll, "slope_pitch": scene.slope_pitch, "yaw": scene.yaw}
        self._ask({"do": "place", **slopes, "blocks": blocks})

    def pose(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Robot time (s), position (3,) m and orientation (4,) w x y z of the base in the world.

        Raises:
          EmulatedRobotError: no robot there.
        """
        reply = self._ask({"do": "pose"})
        return reply["time"], np.array(reply["position"]), np.array(reply["orientation"])

    def close(self) -> None:
        """Hang up."""
        if self._stream is not None:
            self._stream.close()
        if self._socket is not None:
            self._socket.close()
        self._socket = self._stream = None

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        try:
            if self._socket is None:
                self._connect()
            self._stream.write(json.dumps(request).encode() + b"\n")
            self._stream.flush()
            line = self._stream.readline()
            if not line:
                raise ConnectionError("it hung up")
        except OSError as error:
            self.close()
            raise EmulatedRobotError(f"no emulated robot answers on {self._path}: {error}; is it running?") from error
        reply = json.loads(line)
        if not reply["ok"]:
            raise EmulatedRobotError(f"the experimenter refused: {reply['error']}")
        return reply

    def _connect(self) -> None:
        self._socket = connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(TIMEOUT_S)
        connection.connect(str(self._path))
        self._stream = connection.makefile("rwb")
