"""Recordings in the folder ``runs``: listed, opened and played by pages; one is started and stopped."""

from __future__ import annotations

import base64
import contextlib
from collections import OrderedDict
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.recording.flight_from_ulog import LogError
from xtdrone_interaction.recording.open_recording import open_recording
from xtdrone_interaction.recording.recorded_flight import RecordError, Recording
from xtdrone_interaction.server_port import instance_here
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.recordings.playable_flight import PlayableFlight, playable
from xtdrone_interaction.web.recordings.recorder_process import PROFILES, RecorderProcess
from xtdrone_interaction.web.recordings.results import MOST_PICTURE, PICTURES, Results, read_results, results_folder
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session

ENDINGS = (".bag", ".ulg", ".npz", ".csv")
_MOST_LISTED = 500
_MOST_OPEN = 3
_MOST_FRAMES = 1 << 20  # bytes of one answer


class RecordingRoom:
    """Answers a page's questions on recordings."""

    def __init__(self, context: StationContext, folder: Path) -> None:
        """Offer the recordings of a folder and the folders in it."""
        self._context = context
        self._folder = folder
        self._recorder = RecorderProcess(folder, context.master)
        self._open_flights: OrderedDict[str, PlayableFlight] = OrderedDict()

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("recordings.list", self._list),
            Method("recordings.open", self._open),
            Method("recordings.frames", self._frames),
            Method("recordings.picture", self._picture),
            Method("recordings.state", self._state),
            Method("recordings.start", self._start, "operate", "nothing"),
            Method("recordings.stop", self._stop, "operate", "nothing"),
        ]

    async def _list(self, _session: Session, _params: Params) -> dict[str, Any]:
        return {"files": await self._context.blocking(listed, self._folder), "profiles": PROFILES}

    async def _open(self, _session: Session, params: Params) -> dict[str, Any]:
        name = needed(params, "file", str, "a file of recordings.list")
        path = allowed_file(self._folder, name)
        try:
            recording, flight, results = await self._context.blocking(_read, path)
        except (BagError, LogError, RecordError, OSError) as error:
            raise CallError(str(error)) from error
        self._open_flights[name] = flight
        self._open_flights.move_to_end(name)
        while len(self._open_flights) > _MOST_OPEN:
            self._open_flights.popitem(last=False)
        return {
            "vehicles": flight.names,
            "start": flight.start,
            "period": flight.period,
            "frames": len(flight.frames),
            "events": flight.events,
            "cut": bool(recording.cut),
            "notes": list(recording.notes),
            "results": None if results is None else self._about(results),
        }

    def _about(self, results: Results) -> dict[str, Any]:
        """Return results for the page, pictures by their names below the folder of recordings."""
        root = self._folder.resolve()
        pictures = [path.resolve().relative_to(root).as_posix() for path in results.pictures]
        folder = results.folder.resolve().relative_to(root).as_posix()
        return {"folder": folder, "pictures": pictures, "figures": results.figures, "trouble": results.trouble}

    async def _picture(self, _session: Session, params: Params) -> dict[str, Any]:
        path = allowed_file(self._folder, needed(params, "file", str, "a picture of recordings.open"), (PICTURES,))
        size = path.stat().st_size
        if size > MOST_PICTURE:
            raise CallError(f"file: {path.name!r} of {size} bytes is not allowed, at most {MOST_PICTURE}")
        data = await self._context.blocking(path.read_bytes)
        return {"png": base64.b64encode(data).decode("ascii")}

    def _frames(self, _session: Session, params: Params) -> dict[str, Any]:
        flight = self._open_flights.get(needed(params, "file", str, "a file that is open"))
        if flight is None:
            raise CallError(f"file: {params['file'][:100]!r} is no longer open, open it again")
        first = needed(params, "first", int, "number of a frame")
        if not 0 <= first < len(flight.frames):
            raise CallError(f"first: {first} is not allowed, an integer from 0 to {len(flight.frames) - 1}")
        part = flight.frames[first : first + max(1, _MOST_FRAMES // flight.frames[0].nbytes)]
        return {"count": len(part), "rows": base64.b64encode(part.astype("<f4").tobytes()).decode("ascii")}

    async def _state(self, _session: Session, _params: Params) -> dict[str, Any]:
        return await self._context.blocking(self._recorder.state)

    async def _start(self, session: Session, params: Params) -> dict[str, Any]:
        profile = needed(params, "profile", str, f"one of {', '.join(PROFILES)}")
        try:
            self._recorder.start(profile, await self._context.blocking(instance_here))
        except (OptionError, OSError) as error:
            raise CallError(str(error)) from error
        return await self._state(session, {})

    async def _stop(self, _session: Session, _params: Params) -> dict[str, Any]:
        try:
            return {"name": await self._context.blocking(self._recorder.stop)}
        except OptionError as error:
            raise CallError(str(error)) from error


def listed(folder: Path) -> list[dict[str, Any]]:
    """Return the recordings below a folder, the newest first, with size in bytes and time of change in s."""
    found = []
    for path in folder.rglob("*") if folder.is_dir() else ():
        if path.suffix in ENDINGS and path.is_file() and not path.is_symlink():
            with contextlib.suppress(FileNotFoundError):  # it has been renamed or removed since
                status = path.stat()
                found.append((status.st_mtime, path.relative_to(folder).as_posix(), status.st_size))
    found.sort(reverse=True)
    return [
        {"file": name, "bytes": size, "changed": changed, "report": results_folder(folder / name) is not None}
        for changed, name, size in found[:_MOST_LISTED]
    ]


def allowed_file(folder: Path, name: str, endings: tuple[str, ...] = ENDINGS) -> Path:
    """Return the path of a recording, or of a picture of its report.

    Raises:
        CallError: it is not below the folder, not there, or no recording.
    """
    path = folder / name
    inside = "\0" not in name and path.resolve().is_relative_to(folder.resolve())
    if not inside or path.suffix not in endings or not path.is_file():
        kind = "a recording" if endings == ENDINGS else "a picture"
        raise CallError(f"file: {name[:100]!r} is not allowed, {kind} below {folder.name} ({', '.join(endings)})")
    return path


def _read(path: Path) -> tuple[Recording, PlayableFlight, Results | None]:
    recording = open_recording([path])
    return recording, playable(recording), read_results(path)
