"""Gusts: random horizontal wind, equal for all vehicles, that acts through the drag of rotors and body.

roslaunch launch/multi_vehicle.launch effects:="[$PWD/src/xtdrone_sim/examples/gust.py:Gust: {speed: 3.0}]"
"""

import math

import numpy as np


class Gust:
    """First-order Gauss-Markov process of ``speed`` m/s (RMS, each axis) and ``correlation`` s."""

    def __init__(self, speed=2.0, correlation=3.0):
        """Set RMS speed, m/s, and correlation time, s."""
        self.speed, self.correlation = speed, correlation

    def reset(self, models, time_step, random):
        """Restart in still air."""
        self._random, self._air = random, np.zeros(2)
        self._keep = math.exp(-time_step / self.correlation)
        self._noise = self.speed * math.sqrt(1.0 - self._keep**2)

    def __call__(self, time, vehicles, models, force, torque):
        """Push each vehicle by its drag coefficient, N s/m, times the gust, m/s ENU."""
        self._air = self._keep * self._air + self._noise * self._random.standard_normal(2)
        drag = models["drag_coefficient"] * vehicles["rotor_speed"].sum(axis=1) + models["linear_drag"]
        force[:, :2] += drag[:, np.newaxis] * self._air
