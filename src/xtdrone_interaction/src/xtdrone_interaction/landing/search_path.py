"""The path of a search for a target whose place is known roughly: a spiral with turns at a fixed distance."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class Spiral:
    """A point that moves outwards on an Archimedean spiral at a fixed speed.

    Attributes:
        x, y: middle, m.
        pitch: distance of two turns, m.
        speed: m/s.
        widest: radius at which it begins again, m.
        angle: turned so far, rad.
    """

    x: float
    y: float
    pitch: float
    speed: float
    widest: float
    angle: float = 0.0

    @property
    def point(self) -> tuple[float, float]:
        """The current point, m."""
        radius = self.pitch * self.angle / math.tau
        return self.x + radius * math.cos(self.angle), self.y + radius * math.sin(self.angle)

    def advance(self, dt: float) -> tuple[float, float]:
        """Move on by ``dt`` s and return the velocity, m/s.

        With r = c phi the speed is c sqrt(1 + phi^2) times the rate of phi.
        """
        slope = self.pitch / math.tau
        if slope * self.angle > self.widest:
            self.angle = 0.0
        rate = self.speed / (slope * math.hypot(1.0, self.angle))
        rate = min(rate, 2.0)  # rad/s, in the middle
        radius, phi = slope * self.angle, self.angle
        self.angle += rate * dt
        return (
            rate * (slope * math.cos(phi) - radius * math.sin(phi)),
            rate * (slope * math.sin(phi) + radius * math.cos(phi)),
        )
