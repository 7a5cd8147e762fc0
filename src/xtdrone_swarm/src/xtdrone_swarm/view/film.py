"""Films of a swarm, drawn off-screen and written frame by frame: MP4 by ffmpeg, GIF and PNG by Pillow.

A film is written to a temporary file beside its path and renamed at the end, so that an existing film is complete.
Ctrl-C finishes the film with the frames so far; an error leaves no film.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator, Sized
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scipy.spatial import cKDTree

from xtdrone_swarm.view.swarm_picture import Frame, SwarmView

FPS = 25.0
FPS_RANGE = (0.1, 120.0)
GIF_FASTEST = 50.0  # browsers slow down faster films
_GIF_TICK = 0.01  # s, the unit of times in a GIF
_GIF_COLOURS = 256
_LINE_PERIOD = 5.0  # s of wall time between progress lines without a terminal

Picture = NDArray[np.uint8]


class FilmError(ValueError):
    """A film that cannot be written."""


class FilmWriter:
    """A film written picture by picture.

    The context manager finishes the film, also after Ctrl-C, and discards it after any other exception.

    Attributes:
        path: Path of the finished film.
        frames: number of pictures so far.
        only_last: whether only the last picture is used, as for a PNG.
    """

    def __init__(
        self, path: str | Path, size: tuple[int, int], fps: float = FPS, view: SwarmView | None = None
    ) -> None:
        """Start a film, which replaces the file at ``path`` when it is finished.

        Args:
            path: Path with the suffix .mp4, .gif or .png.
            size: width and height of the pictures, pixels.
            fps: pictures per second.
            view: view that draws the pictures; a GIF uses its colours.

        Raises:
            FilmError: unknown suffix, rate out of range, missing or read-only folder, or no ffmpeg.
        """
        self.path = check_film(path, fps)
        self.frames = 0
        kind = self.path.suffix.lower()
        self.only_last = kind == ".png"
        # A unique name in the same folder, for an atomic renaming and concurrent films.
        try:
            handle, name = tempfile.mkstemp(prefix=f".{self.path.stem}-", suffix=f".part{kind}", dir=self.path.parent)
        except OSError as error:
            raise FilmError(f"film {self.path}: cannot be written: {error.strerror}") from error
        os.close(handle)
        self._part = Path(name)
        self._part.chmod(0o666 & ~_umask())
        self._encoder: _Mp4 | _Gif | _Png
        try:
            if kind == ".mp4":
                self._encoder = _Mp4(self._part, size, fps)
            elif kind == ".gif":
                self._encoder = _Gif(self._part, size, fps, view)
            else:
                self._encoder = _Png(self._part)
        except BaseException:
            self._part.unlink(missing_ok=True)
            raise

    def add(self, picture: Picture) -> None:
        """Append a picture.

        Args:
            picture: RGBA, shape (height, width, 4); the array may be reused.

        Raises:
            FilmError: the picture cannot be written, for example because the disk is full.
        """
        self._encoder.add(picture)
        self.frames += 1

    def finish(self) -> None:
        """Complete the film and move it to its path.

        Raises:
            FilmError: no picture was added, or the film cannot be written.
        """
        try:
            if not self.frames:
                raise FilmError(f"film {self.path}: there is no frame to write")
            self._encoder.finish()
            os.replace(self._part, self.path)
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Discard the film and keep an older file at its path."""
        self._encoder.abandon()
        self._part.unlink(missing_ok=True)

    def __enter__(self) -> FilmWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or (issubclass(kind, KeyboardInterrupt) and self.frames):
            self.finish()
        else:
            self.abandon()


def check_film(path: str | Path, fps: float = FPS) -> Path:
    """Check that a film can be written to ``path``, before the flight is simulated, and return the path.

    Raises:
        FilmError: see :class:`FilmWriter`.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".mp4", ".gif", ".png"):
        raise FilmError(f"film {path}: unknown ending {kind!r}; allowed are .mp4, .gif and .png (the last frame)")
    fastest = GIF_FASTEST if kind == ".gif" else FPS_RANGE[1]
    if isinstance(fps, bool) or not (isinstance(fps, int | float) and FPS_RANGE[0] <= fps <= fastest):
        raise FilmError(f"film {path}: {fps!r} frames per second are not allowed, {FPS_RANGE[0]:g} to {fastest:g}")
    if path.is_dir():
        raise FilmError(f"film {path}: is a folder")
    if not path.parent.is_dir():
        raise FilmError(f"film {path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise FilmError(f"film {path}: the folder {path.parent} is not writable")
    if kind == ".mp4" and shutil.which("ffmpeg") is None:
        raise FilmError(f"film {path}: the program ffmpeg is missing (package ffmpeg); a .gif needs none")
    return path


def film(
    frames: Iterable[Frame],
    path: str | Path,
    fps: float = FPS,
    progress: bool | Console = True,
    *,
    view: SwarmView | None = None,
    names: Iterable[str] | None = None,
    total: int | None = None,
    **options: Any,
) -> Path:
    """Draw frames, write them as a film and return its path.

    Args:
        frames: states, ``1 / fps`` apart for a film in real time; a generator may simulate the flight meanwhile.
        path: Path with the suffix .mp4, .gif or .png (a picture of the last state with trails).
        fps: pictures per second.
        progress: whether to show a progress bar, or the console on which to show it.
        view: view that draws the frames; by default a new one for the first frame.
        names: Names of the vehicles for a new view; by default ``uav_0``, ``uav_1``, ...
        total: number of frames for the progress bar, if ``frames`` has no length.
        options: options of a new :class:`SwarmView`: slots, edges, trails, size.

    Raises:
        FilmError: see :class:`FilmWriter`; or ``frames`` is empty.
        ValueError: a frame does not fit the view.
        KeyboardInterrupt: Ctrl-C, after finishing the film with the frames so far.
    """
    check_film(path, fps)
    count = total if total is not None or not isinstance(frames, Sized) else len(frames)
    source = iter(frames)
    try:
        first = next(source)
    except StopIteration:
        raise FilmError(f"film {path}: there is no frame to write") from None
    if view is None:
        named = tuple(names) if names is not None else tuple(f"uav_{i}" for i in range(len(first.positions)))
        view = SwarmView(named, **options)
    with FilmWriter(path, view.size, fps, view) as writer:
        drawn = False
        for frame in shown(_chain(first, source), count, f"film {writer.path.name}", progress):
            view.update(frame)
            if not writer.only_last:
                writer.add(view.draw())
            drawn = True
        if writer.only_last and drawn:
            writer.add(view.draw())
    return writer.path


def _chain(first: Frame, rest: Iterator[Frame]) -> Iterator[Frame]:
    yield first
    yield from rest


def shown(frames: Iterable[Frame], total: int | None, text: str, progress: bool | Console) -> Iterator[Frame]:
    """Yield the frames and show the progress: a bar on a terminal, otherwise a line every few seconds.

    Args:
        frames: Frames to be yielded.
        total: number of frames; None if unknown.
        text: description of the work.
        progress: False for no output; or the console.
    """
    if progress is False:
        yield from frames
        return
    console = Console(stderr=True) if progress is True else progress
    if not console.is_terminal:
        yield from _with_lines(frames, total, text, console)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[moment]}"),
    )
    with Progress(*columns, console=console, refresh_per_second=5) as bar:
        task = bar.add_task(text, total=total, moment="")
        for frame in frames:
            yield frame
            bar.update(task, advance=1, moment=f"sim {frame.time:.1f} s")


def _with_lines(frames: Iterable[Frame], total: int | None, text: str, console: Console) -> Iterator[Frame]:
    said = time.monotonic()
    for number, frame in enumerate(frames, 1):
        yield frame
        if time.monotonic() - said >= _LINE_PERIOD:
            said = time.monotonic()
            of = f"/{total}" if total is not None else ""
            console.print(f"{text}: {number}{of} frames, sim {frame.time:.1f} s", highlight=False, soft_wrap=True)


def _umask() -> int:
    """Return the process's mask for new files, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


class _Mp4:
    """H.264 in the 4:2:0 format of browsers, by an ffmpeg process that reads raw pictures from a pipe."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self._path = path
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (closed with the encoder)
        width, height = size
        command = [
            *("ffmpeg", "-hide_banner", "-loglevel", "error", "-nostdin", "-y"),
            *("-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "pipe:0"),
            *("-an", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-c:v", "libx264", "-pix_fmt", "yuv420p"),
            *("-preset", "veryfast", "-crf", "19", "-movflags", "+faststart", "-f", "mp4", str(path)),
        ]
        # In a separate session, because Ctrl-C is for this process, which then finishes the film. If this process is
        # killed, the end of the pipe ends ffmpeg.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._errors, start_new_session=True
        )

    def add(self, picture: Picture) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(picture).data)
        except OSError as error:
            raise FilmError(f"film: ffmpeg has ended: {self._last_error() or error}") from error

    def finish(self) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError as error:
            raise FilmError(f"film: ffmpeg has ended: {self._last_error() or error}") from error
        if self._process.wait() != 0:
            raise FilmError(f"film: ffmpeg has failed: {self._last_error() or f'status {self._process.returncode}'}")
        self._errors.close()

    def abandon(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):  # the reader of the remaining buffer has ended
                self._process.stdin.close()
        self._errors.close()

    def _last_error(self) -> str:
        """Return ffmpeg's last line on standard error."""
        self._process.kill()
        self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


class _Gif:
    """A GIF with one palette, so that static parts do not flicker, and only the changed rectangle of each frame.

    Pillow's GIF writer keeps all frames in memory, and its files are several times as large.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float, view: SwarmView | None) -> None:
        self._file = path.open("wb")
        self._size = size
        self._period = 1.0 / fps / _GIF_TICK
        self._palette = None if view is None else _Palette(_colours_of(view))
        self._before: NDArray[np.uint8] | None = None
        self._number = 0

    def add(self, picture: Picture) -> None:
        try:
            if self._before is None:
                self._begin(picture)
            self._append(picture)
        except OSError as error:
            raise FilmError(f"film: cannot be written: {error.strerror or error}") from error

    def _begin(self, picture: Picture) -> None:
        """Write the header: size, palette of 256 colours, endless repetition."""
        if self._palette is None:
            few = Image.fromarray(np.ascontiguousarray(picture[..., :3])).quantize(_GIF_COLOURS)
            self._palette = _Palette(np.array(few.getpalette(), dtype=np.uint8).reshape(-1, 3))
        self._file.write(b"GIF89a" + struct.pack("<2H3B", *self._size, 0xF7, 0, 0) + self._palette.table)
        self._file.write(b"\x21\xff\x0bNETSCAPE2.0" + struct.pack("<BBHB", 3, 1, 0, 0))

    def _append(self, picture: Picture) -> None:
        """Write the rectangle that differs from the picture before."""
        assert self._palette is not None
        index = self._palette.indices(picture)
        rows = columns = slice(0, 1)  # if nothing has changed
        if self._before is None:
            rows, columns = slice(None), slice(None)
        elif len(new := np.argwhere(index != self._before)):
            (top, left), (bottom, right) = new.min(axis=0), new.max(axis=0)
            rows, columns = slice(top, bottom + 1), slice(left, right + 1)
        self._before = index
        image = Image.fromarray(np.ascontiguousarray(index[rows, columns]), "P")
        # Times are multiples of 0.01 s: single frames are rounded so that their sum is exact.
        start, end = (math.floor(self._period * k + 0.5) for k in (self._number, self._number + 1))
        self._number += 1
        corner = (int(columns.start or 0), int(rows.start or 0))
        options = {"duration": 10 * (end - start), "disposal": 1, "include_color_table": False}
        for block in GifImagePlugin.getdata(image, corner, **options):
            self._file.write(block)

    def finish(self) -> None:
        try:
            self._file.write(b";")
            self._file.close()
        except OSError as error:
            raise FilmError(f"film: cannot be written: {error.strerror or error}") from error

    def abandon(self) -> None:
        with contextlib.suppress(OSError):  # a full disk
            self._file.close()


class _Palette:
    """At most 256 colours, and the nearest one to every colour with 6 bits per channel.

    Pillow's search confuses neighbouring colours, and white with tints.
    """

    def __init__(self, colours: NDArray[np.uint8]) -> None:
        self._colours = colours
        levels = np.round(np.arange(64) * (255.0 / 63.0))
        cells = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        self._nearest = cKDTree(colours.astype(np.float64)).query(cells)[1].astype(np.uint8)

    @property
    def table(self) -> bytes:
        """Return 256 colours of three bytes each."""
        return self._colours.tobytes().ljust(3 * _GIF_COLOURS, b"\0")

    def indices(self, picture: Picture) -> NDArray[np.uint8]:
        """Return the index of the nearest colour for each pixel."""
        cell = (picture[..., :3] >> 2).astype(np.int32)
        return self._nearest[(cell[..., 0] << 12) | (cell[..., 1] << 6) | cell[..., 2]]


def _colours_of(view: SwarmView) -> NDArray[np.uint8]:
    """Return the colours of a view's pictures and their mixtures with the white background, shape (n, 3)."""
    colours = np.unique(view.colours[1:], axis=0) if len(view.colours) > 1 else view.colours
    greys = np.linspace(0.08, 1.0, 40)
    tints = np.stack([greys * 0.93, greys * 0.965, greys], axis=1)  # for text, grid and edges, which are bluish
    panes = np.array([[1.0, 1.0, 1.0], [0.980, 0.984, 0.988], [0.953, 0.961, 0.973], [0.918, 0.941, 0.918]])
    shares = np.linspace(0.0, 1.0, max(2, (_GIF_COLOURS - len(panes) - len(tints)) // len(colours) + 1))[1:]
    mixed = (1.0 - shares[:, None, None] * (1.0 - colours)).reshape(-1, 3)
    return np.round(255.0 * np.concatenate([panes, tints, mixed])[:_GIF_COLOURS]).astype(np.uint8)


class _Png:
    """A PNG file of the last picture."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: Picture | None = None

    def add(self, picture: Picture) -> None:
        self._last = picture.copy()

    def finish(self) -> None:
        assert self._last is not None
        try:
            Image.fromarray(self._last[..., :3]).save(self._path, "PNG", optimize=True)
        except OSError as error:
            raise FilmError(f"film {self._path}: cannot be written: {error}") from error

    def abandon(self) -> None:
        self._last = None
