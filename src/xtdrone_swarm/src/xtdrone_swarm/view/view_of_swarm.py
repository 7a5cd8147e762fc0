"""Pictures of a :class:`xtdrone_swarm.Swarm`: films of its recorded or current flight, and a live window."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from xtdrone_coordination.leader import Leader
from xtdrone_swarm.swarm_vehicles import FlightRecord, Vehicles
from xtdrone_swarm.view.film import FPS, FilmError, film
from xtdrone_swarm.view.projection_and_zoom import Array
from xtdrone_swarm.view.swarm_picture import Frame, SwarmView
from xtdrone_swarm.view.window_and_mouse import Window


class PicturedSwarm(Protocol):
    """The interface of :class:`xtdrone_swarm.Swarm` used by its pictures."""

    vehicles: Vehicles
    leader: Leader
    record: FlightRecord | None

    @property
    def time(self) -> float:
        """Simulated time, s."""

    @property
    def true_positions(self) -> Array:
        """Positions of all vehicles, shape (N, 3), m ENU."""

    def step(self) -> object:
        """Fly one turn."""


EachTurn = Callable[[Any], object]

_BUDGET = 0.03  # s of wall time for turns between two pictures, or the drawing time of the last picture
_GREATEST_BUDGET = 0.2  # s, so that mouse input is handled in between
_FACTOR_SPAN = 1.0  # s of wall time over which the real-time factor is measured


class Formations:
    """Slots and edges of a swarm, from its leader's decisions; edges are computed once for each topology."""

    def __init__(self) -> None:
        """Create an object without a topology."""
        self._adjacency: NDArray[Any] | None = None
        self._edges: NDArray[np.int64] | None = None

    def edges(self, adjacency: NDArray[Any] | None) -> NDArray[np.int64] | None:
        """Return the pairs (i, j) of a matrix, shape (E, 2), where i listens to j."""
        if adjacency is None:
            return None
        if adjacency is not self._adjacency:
            self._adjacency, self._edges = adjacency, np.argwhere(adjacency > 0)
        return self._edges

    @staticmethod
    def slots(leader: Array, offsets: Array | None) -> Array | None:
        """Return the slots of all vehicles, shape (N, 3), from the leader's position and the followers' offsets."""
        return None if offsets is None else leader + np.vstack([np.zeros(3), offsets])


def film_swarm(
    swarm: PicturedSwarm,
    path: str | Path,
    *,
    seconds: float | None = None,
    start: float | None = None,
    end: float | None = None,
    fps: float = FPS,
    speed: float = 1.0,
    each_turn: EachTurn | None = None,
    progress: bool | Console = True,
    **options: Any,
) -> Path:
    """Write a film of a swarm's flight; see :meth:`Swarm.film`."""
    if not (math.isfinite(speed) and speed > 0.0):
        raise FilmError(f"film {path}: speed {speed} is not allowed, above 0")
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise FilmError(f"film {path}: {seconds} seconds are not allowed, above 0")
    period = speed / fps if fps else math.inf  # film() validates fps
    note = f"{speed:g} x" if speed != 1.0 else ""
    if seconds is not None:
        frames, total = _flying(swarm, seconds, period, note, each_turn), math.floor(seconds / period + 1e-9) + 1
    else:
        times = _film_times(swarm, path, start, end, period)
        frames, total = _replay(swarm, times, note), len(times)
    return film(frames, path, fps, progress, names=swarm.vehicles.names, total=total, **options)


def _flying(
    swarm: PicturedSwarm, seconds: float, period: float, note: str, each_turn: EachTurn | None
) -> Iterator[Frame]:
    """Fly a swarm and yield its frames; positions are interpolated between turns."""
    formations = Formations()
    begin = swarm.time
    before = now = (swarm.time, swarm.true_positions)
    for k in range(math.floor(seconds / period + 1e-9) + 1):
        moment = begin + k * period
        while now[0] < moment - 1e-9:
            if each_turn is not None:
                each_turn(swarm)
            swarm.step()
            before, now = now, (swarm.time, swarm.true_positions)
        share = 1.0 if now[0] <= before[0] else (moment - before[0]) / (now[0] - before[0])
        positions = before[1] + share * (now[1] - before[1])
        leader = swarm.leader
        slots = formations.slots(positions[0], leader.offsets)
        yield Frame(moment, positions, slots, formations.edges(leader.adjacency), leader.pattern, note)


def _film_times(swarm: PicturedSwarm, path: str | Path, start: float | None, end: float | None, period: float) -> Array:
    """Return the times of the frames of a recorded flight."""
    record = swarm.record
    if record is None:
        raise FilmError(f"film {path}: the swarm keeps no record (record=False); seconds=... films while it flies")
    if not len(record.times):
        raise FilmError(f"film {path}: nothing has been flown yet; seconds=... films while the swarm flies")
    first, last = float(record.times[0]), float(record.times[-1])
    begin, stop = first if start is None else start, last if end is None else end
    if not first - 1e-9 <= begin <= stop <= last + 1e-9:
        raise FilmError(f"film {path}: {begin} s to {stop} s; recorded are {first:.3f} s to {last:.3f} s")
    return begin + period * np.arange(math.floor((stop - begin) / period + 1e-9) + 1)


def _replay(swarm: PicturedSwarm, times: Array, note: str) -> Iterator[Frame]:
    """Yield the frames of a recorded flight; positions are interpolated between turns."""
    record = swarm.record
    assert record is not None
    formations = Formations()
    turns, places = record.times, record.positions
    said = np.array([choice.time for choice in record.choices])
    for moment in times.tolist():
        after = min(int(np.searchsorted(turns, moment)), len(turns) - 1)
        before = max(0, after - 1)
        span = turns[after] - turns[before]
        share = 1.0 if span == 0.0 else min(1.0, (moment - turns[before]) / span)
        positions = places[before] + share * (places[after] - places[before])
        number = int(np.searchsorted(said, moment + 1e-9)) - 1
        if number < 0:
            yield Frame(moment, positions, note=note)
            continue
        choice = record.choices[number]
        slots = formations.slots(positions[0], choice.offsets)
        yield Frame(moment, positions, slots, formations.edges(choice.adjacency), choice.pattern, note)


def watch_swarm(
    swarm: PicturedSwarm,
    *,
    speed: float = 1.0,
    seconds: float = math.inf,
    each_turn: EachTurn | None = None,
    **options: Any,
) -> None:
    """Fly a swarm in a live window; see :meth:`Swarm.watch`."""
    if not speed > 0.0:
        raise ValueError(f"watch: speed {speed} is not allowed, above 0, or infinite for as fast as it can")
    if not seconds > 0.0:
        raise ValueError(f"watch: {seconds} seconds are not allowed, above 0")

    def turn() -> bool:
        if each_turn is not None:
            each_turn(swarm)
        swarm.step()
        return True

    play(swarm, turn, speed=speed, end=swarm.time + seconds, **options)


def play(
    swarm: PicturedSwarm, turn: Callable[[], bool], *, speed: float = 1.0, end: float = math.inf, **options: Any
) -> None:
    """Show a swarm in a live window until the window is closed.

    Args:
        swarm: swarm to show.
        turn: runs one turn of the swarm; a result of False ends the flight and closes the window.
        speed: simulated seconds per second of wall time; infinite for as fast as possible.
        end: simulated time at which the swarm stops, s.
        **options: options of ``SwarmView``.
    """
    view = SwarmView(swarm.vehicles.names, **options)
    window = Window(view, f"XTDrone: {len(view.names)} UAVs")
    window.run(_Player(swarm, window, turn, speed, end))


class RealTimeFactor:
    """The ratio of simulated to wall time over approximately the last second of wall time."""

    def __init__(self) -> None:
        """Start without a measurement."""
        self._factor = 0.0
        self._since: tuple[float, float] | None = None

    def restart(self) -> None:
        """Restart the measurement at the next update; the last result remains valid until then."""
        self._since = None

    def update(self, sim_time: float) -> str:
        """Return the factor as text, given the simulated time, s; "" before the first measurement."""
        wall = time.monotonic()
        if self._since is None or sim_time < self._since[1]:
            self._since = (wall, sim_time)
        elif wall - self._since[0] >= _FACTOR_SPAN:
            self._factor = (sim_time - self._since[1]) / (wall - self._since[0])
            self._since = (wall, sim_time)
        return f"{self._factor:.3g} x real time" if self._factor else ""


class _Player:
    """Advances simulated time with wall time before each picture, and reports the real-time factor."""

    def __init__(
        self, swarm: PicturedSwarm, window: Window, turn: Callable[[], bool], speed: float, end: float
    ) -> None:
        self._swarm = swarm
        self._window = window
        self._speed = speed
        self._end = end
        self._turn = turn
        self._formations = Formations()
        self._factor = RealTimeFactor()
        self._shown = -math.inf
        self._left = time.monotonic()
        self._set_off()

    def _set_off(self) -> None:
        """Set the origin of both times to now."""
        self._origin = (time.monotonic(), self._swarm.time)

    def __call__(self) -> Frame | None:
        """Advance the flight to the wall time or within the budget; return the state if it is new."""
        away = time.monotonic() - self._left
        frame = self._next(max(_BUDGET, min(away, _GREATEST_BUDGET)))
        self._left = time.monotonic()
        return frame

    def _next(self, budget: float) -> Frame | None:
        if self._window.paused or self._swarm.time >= self._end:
            self._set_off()
            self._factor.restart()
        else:
            self._fly(budget)
        if self._swarm.time == self._shown:
            return None
        self._shown = self._swarm.time
        leader, positions = self._swarm.leader, self._swarm.true_positions
        slots = self._formations.slots(positions[0], leader.offsets)
        edges = self._formations.edges(leader.adjacency)
        return Frame(self._swarm.time, positions, slots, edges, leader.pattern, self._factor.update(self._swarm.time))

    def _fly(self, budget: float) -> None:
        wall, sim = self._origin
        now = time.monotonic()
        goal = min(self._end, sim + self._speed * (now - wall))
        deadline = now + budget
        while self._swarm.time < goal:
            if not self._turn():
                self._window.close()
                break
            if time.monotonic() >= deadline:
                self._origin = (time.monotonic(), self._swarm.time)  # a delay is not made up for
                break
