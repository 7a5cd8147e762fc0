"""Figures of a flight: rise, overshoot, settling, speeds, tracking; each of ours is set against the reference's.

Tolerances: 15 % of rise and settling times and of largest speeds, tilts and rates, 5 points of overshoot, 15 % or 5 cm
of tracking errors. Times are allowed another 0.04 s, two samples of the recordings. Where the reference's overshoot
only grazes the band of settling, the settling time is reported but not judged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from validation.compare_px4.reference import Flight, Track

SHARE = 0.15
POINTS = 5.0  # of overshoot
SAMPLES = 0.04  # s
_TRACKING = 0.05  # m
_BAND = 0.05  # of a step: settled within
_GRAZED = 1.0  # points of overshoot around the band; within them the settling time is sensitive, and only reported


@dataclass(frozen=True)
class Figure:
    """One compared figure.

    Attributes:
        flight: name of the flight.
        name: of the figure.
        unit: of both values.
        reference: value of the reference.
        ours: value of this autopilot.
        allowed: largest difference; inf if it is only reported.
        one_sided: whether any value below the reference is within the tolerance.
    """

    flight: str
    name: str
    unit: str
    reference: float
    ours: float
    allowed: float
    one_sided: bool = False

    @property
    def within(self) -> bool:
        """Whether the difference is within the tolerance."""
        difference = self.ours - self.reference
        if self.one_sided and difference < 0.0:
            return True
        return bool(abs(difference) <= self.allowed)


@dataclass(frozen=True)
class Step:
    """A step response.

    Attributes:
        t10, t50, t90: times after the step at which 10, 50, 90 % are first reached, s; NaN if they are not.
        overshoot: % of the step.
        settle: time after which the response stays within 5 % of the step, s.
    """

    t10: float
    t50: float
    t90: float
    overshoot: float
    settle: float


def step_response(time: NDArray[np.float64], value: NDArray[np.float64], start: float, target: float) -> Step:
    """Return the figures of a response from ``start`` to ``target``.

    Args:
        time: s since the step, (n,).
        value: response, (n,).
        start: value before the step.
        target: commanded value.
    """
    share = (value - start) / (target - start)
    outside = np.flatnonzero(np.abs(share - 1.0) > _BAND)
    settled = time[outside[-1]] if len(outside) else 0.0
    return Step(
        t10=_first(time, share >= 0.1),
        t50=_first(time, share >= 0.5),
        t90=_first(time, share >= 0.9),
        overshoot=100.0 * max(0.0, float(share.max()) - 1.0),
        settle=float(settled) if not len(outside) or outside[-1] < len(time) - 1 else math.nan,
    )


def _first(time: NDArray[np.float64], condition: NDArray[np.bool_]) -> float:
    hits = np.flatnonzero(condition)
    return float(time[hits[0]]) if len(hits) else math.nan


def _slope(time: NDArray[np.float64], value: NDArray[np.float64]) -> float:
    """Return the slope of the line through the samples; NaN for fewer than two."""
    return float(np.polyfit(time, value, 1)[0]) if len(time) > 1 else math.nan


def _largest(track: Track, *names: str) -> float:
    return float(np.sqrt(sum(track[name] ** 2 for name in names)).max())


def _tilt(track: Track) -> float:
    """Return the largest tilt, deg."""
    cosine = np.cos(track["roll"]) * np.cos(track["pitch"])
    return float(np.degrees(np.arccos(cosine)).max())


class _Pair:
    """The reference's and our part of one flight, and the figures computed from them."""

    def __init__(self, flight: str, reference: Track, ours: Track, starts: tuple[float, float]) -> None:
        self.flight = flight
        self.tracks = (reference, ours)
        self.starts = starts
        self.figures: list[Figure] = []

    def add(
        self, name: str, unit: str, values: tuple[float, float], allowed: float, *, one_sided: bool = False
    ) -> None:
        self.figures.append(Figure(self.flight, name, unit, values[0], values[1], allowed, one_sided))

    def both(self, function: Callable[[Track], float]) -> tuple[float, float]:
        return function(self.tracks[0]), function(self.tracks[1])

    def share(self, name: str, unit: str, function: Callable[[Track], float], least: float = 0.0) -> None:
        """Add a figure with an allowance of 15 %, at least ``least``."""
        values = self.both(function)
        self.add(name, unit, values, max(SHARE * abs(values[0]), least))

    def step(self, name: str, starts: tuple[float, float], targets: tuple[float, float]) -> None:
        """Add the figures of a step in column ``name``."""
        found = [
            step_response(track["t"] - begin, track[name], start, target)
            for track, begin, start, target in zip(self.tracks, self.starts, starts, targets, strict=True)
        ]
        rise = tuple(step.t90 - step.t10 for step in found)
        for title, values in (
            ("90 % reached", tuple(step.t90 for step in found)),
            ("rise 10-90 %", rise),
        ):
            self.add(title, "s", (values[0], values[1]), max(SHARE * values[0], SAMPLES))
        grazed = abs(found[0].overshoot - 100.0 * _BAND) < _GRAZED
        allowed = math.inf if grazed else max(SHARE * found[0].settle, SAMPLES)
        self.add("settled within 5 %", "s", (found[0].settle, found[1].settle), allowed)
        self.add("overshoot", "%", (found[0].overshoot, found[1].overshoot), POINTS)

    def difference(self, *names: str) -> None:
        """Add the RMS difference of the two curves, each from its own start."""
        reference, ours = self.tracks
        time = reference["t"] - self.starts[0]
        errors = [
            np.interp(time, ours["t"] - self.starts[1], ours[name] - ours[name][0])
            - (reference[name] - reference[name][0])
            for name in names
        ]
        self.add("RMS between the curves", "m", (0.0, float(np.sqrt(np.mean(sum(e**2 for e in errors))))), math.inf)


def _parts(reference: Flight, ours: Flight, flight: str, first: str, seconds: float) -> _Pair:
    starts = (reference.start_of(first), ours.start_of(first))
    tracks = [
        recording.track.between(start, start + seconds)
        for recording, start in zip((reference, ours), starts, strict=True)
    ]
    return _Pair(flight, tracks[0], tracks[1], starts)


def _takeoff(reference: Flight, ours: Flight) -> list[Figure]:
    pair = _parts(reference, ours, "takeoff", "takeoff", 39.0)
    armed = []
    for recording in (reference, ours):
        armed.append(next(e.time for e in recording.events if e.phase == "takeoff" and "Armed" in e.value))
    final = pair.both(lambda track: float(track["z"][-100:].mean()))

    def reached(level: float) -> tuple[float, float]:
        times = [
            _first(track["t"], -track["z"] >= level) - begin for track, begin in zip(pair.tracks, armed, strict=True)
        ]
        return times[0], times[1]

    for name, level in (("armed to 0.3 m", 0.3), ("armed to 90 % of the height", -0.9 * final[0])):
        values = reached(level)
        pair.add(name, "s", values, SHARE * values[0])
    pair.share("largest climb rate", "m/s", lambda track: float(-track["vz"].min()))
    peak = pair.both(lambda track: 100.0 * (float(track["z"].min()) / float(track["z"][-100:].mean()) - 1.0))
    pair.add("overshoot", "%", peak, POINTS)
    pair.add("final height", "m", (-final[0], -final[1]), 0.15)
    return pair.figures


def _position_step(reference: Flight, ours: Flight) -> list[Figure]:
    pair = _parts(reference, ours, "position step", "offb_pos_step", 12.0)
    starts = pair.both(lambda track: float(track["x"][0]))
    targets = pair.both(lambda track: float(track["sp_x"][-1]))
    pair.step("x", starts, targets)
    pair.share("largest speed", "m/s", lambda track: float(track["vx"].max()))
    pair.share("largest tilt", "deg", _tilt)
    pair.add("sideways", "m", pair.both(lambda t: float(np.abs(t["y"] - t["y"][0]).max())), 0.15, one_sided=True)
    pair.add(
        "height lost or gained", "m", pair.both(lambda t: float(np.abs(t["z"] - t["z"][0]).max())), 0.15, one_sided=True
    )
    pair.difference("x")
    return pair.figures


def _velocity_step(reference: Flight, ours: Flight) -> list[Figure]:
    figures = []
    for title, phase, target, seconds in (
        ("velocity step", "offb_vel_step", 3.0, 8.0),
        ("velocity stop", "offb_vel_stop", 0.0, 6.0),
    ):
        pair = _parts(reference, ours, title, phase, seconds)
        pair.step("vx", (3.0 - target, 3.0 - target), (target, target))
        pair.share("largest tilt", "deg", _tilt)
        figures += pair.figures
    return figures


def _yaw_step(reference: Flight, ours: Flight) -> list[Figure]:
    pair = _parts(reference, ours, "yaw step", "yaw_step", 8.0)
    starts = pair.both(lambda track: float(track["yaw"][0]))
    targets = pair.both(lambda track: float(track["sp_yaw"][-1]))
    pair.step("yaw", starts, targets)
    pair.share("largest yaw rate", "deg/s", lambda track: math.degrees(float(np.abs(track["r"]).max())))
    away = pair.both(lambda t: float(np.hypot(t["x"] - t["x"][0], t["y"] - t["y"][0]).max()))
    pair.add("distance from the place", "m", away, 0.15, one_sided=True)
    return pair.figures


def _offboard_loss(reference: Flight, ours: Flight) -> list[Figure]:
    pair = _parts(reference, ours, "offboard loss", "offboard_loss", 9.3)

    def sinking(track: Track) -> float:
        z, t = track["z"], track["t"]
        low = (z > -4.0) & (z < -1.0)
        return _slope(t[low], z[low])

    pair.share("sink rate", "m/s", sinking)
    pair.share("largest sink rate", "m/s", lambda track: float(track["vz"].max()))
    return pair.figures


def _tracking(track: Track) -> float:
    error = sum((track[name] - track["sp_" + name]) ** 2 for name in "xyz")
    return float(np.sqrt(np.nanmean(error)))


def _mission(reference: Flight, ours: Flight) -> list[Figure]:
    bounds = []
    for recording in (reference, ours):
        start = next(e.time for e in recording.events if e.phase == "mission" and "Armed" in e.value)
        end = next((e.time for e in recording.events if e.phase == "mission" and "finished" in e.value), math.nan)
        bounds.append((start, end))
    pair = _Pair(
        "mission",
        reference.track.between(*bounds[0]),
        ours.track.between(bounds[1][0], bounds[1][1] if math.isfinite(bounds[1][1]) else bounds[1][0] + 80.0),
        (bounds[0][0], bounds[1][0]),
    )
    durations = (bounds[0][1] - bounds[0][0], bounds[1][1] - bounds[1][0])
    pair.add("armed to finished", "s", durations, SHARE * durations[0])
    pair.share("largest speed", "m/s", lambda track: _largest(track, "vx", "vy"))
    pair.share("largest climb rate", "m/s", lambda track: float(-track["vz"].min()))
    pair.share("largest tilt", "deg", _tilt)
    in_the_air = pair.both(lambda track: _tracking(Track(track.rows[track["z"] < -5.0])))
    pair.add("tracking RMS", "m", in_the_air, max(SHARE * in_the_air[0], _TRACKING), one_sided=True)
    return pair.figures


def _rtl(reference: Flight, ours: Flight) -> list[Figure]:
    away = _parts(reference, ours, "goto", "goto_away", 14.5)
    distances = [np.hypot(track["x"] - track["x"][0], track["y"] - track["y"][0]) for track in away.tracks]
    target = math.hypot(30.0, 10.0)
    found = [
        step_response(track["t"] - begin, distance, 0.0, target)
        for track, begin, distance in zip(away.tracks, away.starts, distances, strict=True)
    ]
    away.add("90 % reached", "s", (found[0].t90, found[1].t90), SHARE * found[0].t90)
    away.add("overshoot", "%", (found[0].overshoot, found[1].overshoot), POINTS)
    away.share("largest speed", "m/s", lambda track: _largest(track, "vx", "vy"))
    home = _parts(reference, ours, "return", "rtl", 120.0)
    home.share("largest climb rate", "m/s", lambda track: float(-track["vz"].min()))
    home.share("largest speed", "m/s", lambda track: _largest(track, "vx", "vy"))
    home.share("largest sink rate", "m/s", lambda track: float(track["vz"].max()))
    home.add("greatest height", "m", home.both(lambda track: float(-track["z"].min())), 0.5)

    def landing(track: Track) -> float:
        z, t = track["z"], track["t"]
        last = (z > -4.0) & (z < -1.0) & (t > t[np.argmin(z)])
        return _slope(t[last], z[last])

    home.share("sink rate at the end", "m/s", landing)
    return away.figures + home.figures


_BY_FLIGHT = {
    "takeoff": _takeoff,
    "position_step": _position_step,
    "velocity_step": _velocity_step,
    "yaw_step": _yaw_step,
    "offboard_loss": _offboard_loss,
    "mission": _mission,
    "rtl": _rtl,
}


def figures(reference: Flight, ours: Flight, flight: str) -> list[Figure]:
    """Return the figures of ``flight`` (a name of ``flown_scripts.FLIGHTS``)."""
    return _BY_FLIGHT[flight](reference, ours)
