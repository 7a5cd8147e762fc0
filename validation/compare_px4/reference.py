"""Recorded flights of a real PX4 v1.14.3, stored in ``recorded/`` (described in its README)."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

COLUMNS = (
    "t", "x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r", "thrust_sp",
    "sp_x", "sp_y", "sp_z", "sp_vx", "sp_vy", "sp_vz", "sp_yaw",
)  # fmt: skip


@dataclass(frozen=True)
class Event:
    """An event observed on the link.

    Attributes:
        time: s.
        phase: part of the flight.
        kind: phase, ack, text, mode, landed_state, reached, current, setpoints.
        value: ack: command and MAV_RESULT; text: MAV_SEVERITY and text; mode: base_mode, custom_mode and MAV_STATE;
            landed_state: MAV_LANDED_STATE; reached and current: mission item.
    """

    time: float
    phase: str
    kind: str
    value: str


class Track:
    """Time series in the local frame NED, m, m/s, rad, by the names in ``COLUMNS``.

    Attributes:
        rows: (n, len(COLUMNS)).
    """

    def __init__(self, rows: NDArray[np.float64]) -> None:
        """Store the rows, in order of time."""
        self.rows = rows

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the column ``name``, shape (n,)."""
        return self.rows[:, COLUMNS.index(name)]

    def between(self, start: float, end: float) -> Track:
        """Return the part with start <= t < end, s."""
        t = self["t"]
        return Track(self.rows[(t >= start) & (t < end)])


@dataclass(frozen=True)
class Flight:
    """One whole recording.

    Attributes:
        track: the vehicle's motion.
        events: observed on the link, in order of time.
    """

    track: Track
    events: list[Event]

    def start_of(self, phase: str) -> float:
        """Return when ``phase`` began, s.

        Raises:
            KeyError: the phase does not exist.
        """
        for event in self.events:
            if event.kind == "phase" and event.phase == phase:
                return event.time
        raise KeyError(phase)


def folder() -> Path:
    """Return the folder of the recordings."""
    return Path(__file__).resolve().parent / "recorded"


def load(path: Path | None = None) -> Flight:
    """Return the flights recorded in ``path`` (default: those of the project)."""
    path = path or folder()
    with np.load(path / "flights.npz") as data:
        parts = [data[name].astype(float) for name in data.files if name != "columns"]
    rows = np.concatenate(parts)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    with (path / "events.csv").open(newline="") as file:
        events = [Event(float(row["t"]), row["phase"], row["kind"], row["value"]) for row in csv.DictReader(file)]
    return Flight(Track(rows), events)
