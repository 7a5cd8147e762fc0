"""Origin of a local frame on Earth."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.geodesy import projection


@dataclass(frozen=True)
class Datum:
    """Origin of a local frame (WGS84): latitude and longitude in degrees, altitude in metres AMSL."""

    latitude: float
    longitude: float
    altitude: float

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return (latitude, longitude), degrees, of a point ``x``, ``y`` in the local frame, m ENU."""
        return projection.reproject(y, x, self.latitude, self.longitude)

    def local(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return (east, north), m, of a latitude and longitude in degrees."""
        north, east = projection.project(latitude, longitude, self.latitude, self.longitude)
        return east, north
