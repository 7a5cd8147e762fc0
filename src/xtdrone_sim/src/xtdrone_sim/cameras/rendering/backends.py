"""Selection of pybullet's renderer: OpenGL through EGL, which needs no screen, or TinyRenderer on the CPU."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import logging
import os
import subprocess
import sys
import threading
from typing import Any

from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection

from xtdrone_common.settings import check_choice
from xtdrone_sim.physics.quiet_pybullet import BulletClient, connect, pybullet, without_lines

BACKENDS = ("auto", "egl", "tiny")

_log = logging.getLogger(__name__)
_PLUGIN = "eglRenderer"
_SHADOW_PASS = "useShadowMap"  # bool of the plugin (Bullet's GLInstancingRenderer.cpp)
_CHATTER = (b"Loaded EGL", b"GL_", b"Version =", b"Vendor =", b"Renderer =", b"ven =", b"EGL device", b"Destroy EGL")
_TALKS = 3  # first images of a size, for some of which the plugin prints messages
_TRIAL_LIMIT = 60.0  # s of wall time
_one = threading.Lock()  # the plugin supports one physics server per process


class RendererError(RuntimeError):
    """The renderer is not available; the message gives the reason."""


class Backend:
    """A physics server with a renderer.

    Attributes:
        client: number of the physics server.
        name: "egl" or "tiny".
    """

    def __init__(self, wanted: str = "auto") -> None:
        """Start the server and load the renderer.

        Args:
            wanted: one of ``BACKENDS``; "auto": EGL if available, otherwise the CPU renderer, with a log message.

        Raises:
            ValueError: ``wanted`` is not one of ``BACKENDS``.
            RendererError: EGL is requested but not available.
        """
        check_choice("backend", wanted, BACKENDS)
        self.client: BulletClient = connect()
        self.name = "tiny"
        self._plugin = -1
        self._size = (0, 0)  # of the last image
        self._talks = 0  # further images for which the plugin may print messages
        if wanted == "tiny":
            return
        problem = self._load()
        if problem is None:
            self.name = "egl"
        elif wanted == "egl":
            self.client.disconnect()
            raise RendererError(f"no EGL renderer: {problem}")
        else:
            _log.warning("images are drawn by pybullet's TinyRenderer, as there is no EGL renderer: %s", problem)

    def _load(self) -> str | None:
        """Load the EGL plugin; return the reason for a failure, else None."""
        found = importlib.util.find_spec(_PLUGIN)
        if found is None or found.origin is None:
            return f"this pybullet comes without {_PLUGIN}"
        problem = _trial(found.origin)
        if problem is not None:
            return problem
        if not _one.acquire(blocking=False):
            return "another renderer of this process is using it"
        with without_lines(_CHATTER):
            self._plugin = self.client.loadPlugin(found.origin, f"_{_PLUGIN}Plugin")
        if self._plugin >= 0:
            _skip_shadow_pass(found.origin)
            return None
        _one.release()
        return "the plugin does not load"

    def picture(self, width: int, height: int, **how: Any) -> tuple[Any, ...]:
        """Draw an image; return the result of pybullet's ``getCameraImage``."""
        if self.name == "tiny":
            return self.client.getCameraImage(width, height, renderer=pybullet.ER_TINY_RENDERER, **how)
        if (width, height) != self._size:
            self._size, self._talks = (width, height), _TALKS
        self._talks -= 1
        with without_lines(_CHATTER) if self._talks >= 0 else contextlib.nullcontext():
            return self.client.getCameraImage(width, height, renderer=pybullet.ER_BULLET_HARDWARE_OPENGL, **how)

    def close(self) -> None:
        """Shut down the server."""
        with without_lines(_CHATTER):
            if self._plugin >= 0:
                self.client.unloadPlugin(self._plugin)
            self.client.disconnect()
        if self._plugin >= 0:
            self._plugin = -1
            _one.release()


def _skip_shadow_pass(plugin: str) -> None:
    """Disable the plugin's shadow pass, which it runs for every image, even without shadows.

    The shadow map has 4096 x 4096 pixels; on the CPU it takes half of the time of an image. The plugin keeps the choice
    in an internal variable without an API. If the variable is missing, images only take longer.
    """
    with open(plugin, "rb") as file:
        table = ELFFile(file).get_section_by_name(".symtab")
        symbols = table.get_symbol_by_name(_SHADOW_PASS) if isinstance(table, SymbolTableSection) else None
    address = _loaded_at(plugin)
    if not symbols or len(symbols) > 1 or symbols[0]["st_size"] != 1 or address is None:
        _log.debug("the EGL plugin has no variable %s: it draws a shadow map for every image", _SHADOW_PASS)
        return
    wanted = ctypes.c_uint8.from_address(address + symbols[0]["st_value"])
    if wanted.value == 1:
        wanted.value = 0


def _loaded_at(library: str) -> int | None:
    """Return the base address of a library in this process; None if it is not loaded."""
    path = os.path.realpath(library)
    with open("/proc/self/maps", encoding="utf-8", errors="replace") as lines:
        starts = [line.split("-")[0] for line in lines if line.rstrip("\n").endswith(path)]
    return int(starts[0], 16) if starts else None


@functools.cache
def _trial(plugin: str) -> str | None:
    """Load the plugin in a separate process, which it may crash; return the reason for a failure, else None."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError as error:
        return f"{error} (Debian's packages libegl1 and libgl1-mesa-dri)"
    script = (
        "import sys, pybullet\n"
        "client = pybullet.connect(pybullet.DIRECT)\n"
        "plugin = pybullet.loadPlugin(sys.argv[1], sys.argv[2])\n"
        "_, _, picture, _, _ = pybullet.getCameraImage(8, 8, renderer=pybullet.ER_BULLET_HARDWARE_OPENGL)\n"
        "sys.exit(3 if plugin < 0 else 0)\n"
    )
    command = [sys.executable, "-c", script, plugin, f"_{_PLUGIN}Plugin"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TRIAL_LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return f"the plugin has not drawn an image within {_TRIAL_LIMIT:g} s"
    if done.returncode == 0:
        return None
    words = [line for line in (done.stdout + done.stderr).splitlines() if line and not line.startswith("pybullet")]
    return f"the plugin does not load: {words[-1] if words else f'exit status {done.returncode}'}"
