"""The process that draws camera images, and its client.

Drawing holds Python's global lock, and a failing renderer may end its process; therefore it runs in a separate one.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.cameras.drawn_scene import DrawnScene, View
from xtdrone_sim.cameras.rendering import Renderer, RendererError
from xtdrone_sim.cameras.shutter import mean_of
from xtdrone_sim.rays.scene import SceneAt
from xtdrone_worlds.worlds.sdf import load_world_file, read_world, world_file

_NAMES = {"egl": "pybullet's EGL renderer", "tiny": "pybullet's TinyRenderer"}
_ATTEMPTS = 3  # consecutive processes that end without an image before drawing fails


class DrawingError(RuntimeError):
    """Images cannot be drawn; the message gives the reason."""


@dataclass(frozen=True)
class Drawn:
    """The objects to draw.

    Attributes:
        world: name or file.
        fleet: e.g. ``typhoon_h480:6``.
        backend: back end of the renderer.
        shadows: whether the sun casts shadows.
    """

    world: str
    fleet: str
    backend: str = "auto"
    shadows: bool = False


@dataclass(frozen=True)
class Changes:
    """Differences of the models from those of the world's file.

    Attributes:
        sdf: a world with the models that have been added.
        deleted: names of the deleted models and actors.
    """

    sdf: str
    deleted: tuple[str, ...]


class DrawingProcess:
    """Draws images in a separate process; called by one thread at a time.

    Attributes:
        ended: number of processes that have ended unexpectedly, each with the loss of an image.
        last_end: description of the end of the last of them.
    """

    def __init__(self, drawn: Drawn) -> None:
        """Start the process, without waiting until it is ready."""
        self.ended = 0
        self.last_end = ""
        self._drawn = drawn
        self._changes: Changes | None = None
        self._told: Changes | None = None  # models that have been sent to the process
        self._fruitless = 0
        self._lock = threading.Lock()  # guards the current process: close() may be called during a drawing
        self._closed = False
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            for end in (ours, theirs):
                end.setblocking(True)  # rospy gives new sockets a timeout
            self._process = subprocess.Popen(
                [sys.executable, "-m", "xtdrone_sim.cameras.camera_worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C reaches only the node, whose end closes the connection
            )
            self._connection = Connection(ours.detach())
        self._ready, self._told = False, None
        with contextlib.suppress(ConnectionError):  # it has ended already; the first image reports it
            self._connection.send(self._drawn)

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def change(self, changes: Changes) -> None:
        """Use other models for the next images."""
        self._changes = changes

    def draw(self, scenes: Sequence[SceneAt], view: View) -> bytes | None:
        """Return the rows of an image, RGB, and with ``view.depth`` then those of the depths, float32, m.

        The colours are the mean of those of all scenes, the depths are those of the one in the middle. None if the
        process has ended meanwhile and was replaced.

        Raises:
            DrawingError: the world cannot be drawn, or several processes have ended without drawing an image.
        """
        try:
            if not self._ready:
                self._answer()
                self._ready = True
            changes = self._changes
            if changes is not self._told:
                self._connection.send(changes)
                self._told = changes
            self._connection.send((tuple(scenes), view))
            picture = self._answer()
        except (EOFError, ConnectionError):
            self._replace()
            return None
        self._fruitless = 0
        return picture

    def _answer(self) -> bytes:
        problem, picture = self._connection.recv()
        if problem:
            raise DrawingError(problem)
        return picture

    def _replace(self) -> None:
        """Replace a process that has ended, unless it was closed."""
        with self._lock:
            if not self._closed:
                self._start_another()

    def _start_another(self) -> None:
        self._connection.close()
        status = self._process.wait()
        self.ended += 1
        self._fruitless += 1
        self.last_end = f"signal {-status}" if status < 0 else f"exit status {status}"
        if self._fruitless >= _ATTEMPTS:
            raise DrawingError(f"the drawing process repeatedly ends ({self.last_end}) before it has drawn an image")
        self._start()

    def close(self) -> None:
        """End the process, from any thread; an image in progress is lost."""
        with self._lock:
            self._closed = True
            self._process.kill()
            self._process.wait()


def _serve(connection: Connection) -> None:
    """Draw the requested images until the connection closes."""
    drawn: Drawn = connection.recv()
    try:
        renderer = Renderer(drawn.backend)
        fleet = parse_fleet(drawn.fleet)
        scene = DrawnScene(renderer, load_world_file(drawn.world), fleet, shadows=drawn.shadows)
    except (ValueError, OSError, RendererError) as error:
        connection.send((f"{drawn.world}: {error}", None))
        return
    with renderer:
        print(f"cameras: images are drawn by {_NAMES[renderer.backend]}", flush=True)
        connection.send(("", None))
        while True:
            order = connection.recv()
            if isinstance(order, Changes):
                _change(scene, order, drawn.world)
                continue
            moments, view = order
            try:
                answer = ("", _expose(scene, moments, view))
            except ValueError as error:
                answer = (str(error), b"")
            connection.send(answer)


def _expose(scene: DrawnScene, moments: Sequence[SceneAt], view: View) -> bytes:
    """Return the drawn images as bytes, see ``DrawingProcess.draw``."""
    pictures = [
        scene.draw(at, replace(view, depth=view.depth and k == len(moments) // 2)) for k, at in enumerate(moments)
    ]
    depth = pictures[len(moments) // 2].depth
    return mean_of([picture.rgb for picture in pictures]).tobytes() + (b"" if depth is None else depth.tobytes())


def _change(scene: DrawnScene, changes: Changes, world: str) -> None:
    """Use other models from now on; one that cannot be drawn is left out."""
    try:
        scene.change(read_world(changes.sdf, world_file(world)).models, changes.deleted)
    except ValueError as error:
        print(f"cameras: a model is not drawn: {error}", flush=True)


def main() -> None:
    """Serve the socket whose number is the first argument."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, ConnectionError):  # the node has ended
        _serve(Connection(int(sys.argv[1])))


if __name__ == "__main__":
    # Orders are instances of the imported module's classes, not of those of __main__.
    from xtdrone_sim.cameras import camera_worker

    camera_worker.main()
