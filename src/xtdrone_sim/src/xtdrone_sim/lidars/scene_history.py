"""The most recent scenes, for scans that take time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_sim.lidars.scan_measurement import Motion, link_places
from xtdrone_sim.rays.scene import Layout, RayScene, SceneAt

_MARGIN_US = 100_000  # several periods of the scenes


@dataclass
class _Sample:
    time_us: int
    scene: SceneAt
    layout: Layout | None = None
    places: NDArray[np.void] | None = None


class SceneHistory:
    """The most recent scenes, in order of time."""

    def __init__(self, longest_us: int) -> None:
        """Start without a scene.

        Args:
            longest_us: duration for which scenes are kept for a scan, microseconds.
        """
        self._longest_us = longest_us
        self._samples: deque[_Sample] = deque()

    def reach_back(self, longest_us: int) -> None:
        """Keep scenes for scans of this duration, microseconds; scenes already dropped are not restored."""
        self._longest_us = max(self._longest_us, longest_us)

    def first_with(self, link: str) -> int | None:
        """Return the time of the earliest scene with a link, microseconds; None without one."""
        return next((sample.time_us for sample in self._samples if link in sample.scene.links), None)

    def clear(self) -> None:
        """Discard all scenes after a reset of simulated time."""
        self._samples.clear()

    def add(self, time_us: int, scene: SceneAt) -> None:
        """Add a scene; one that is not later than the last is ignored."""
        if self._samples and time_us <= self._samples[-1].time_us:
            return
        self._samples.append(_Sample(time_us, scene))
        while len(self._samples) > 2 and self._samples[1].time_us <= time_us - self._longest_us - _MARGIN_US:
            self._samples.popleft()

    @property
    def first_us(self) -> int | None:
        """Time of the earliest scene, microseconds; None without one."""
        return self._samples[0].time_us if self._samples else None

    @property
    def last_us(self) -> int | None:
        """Time of the latest scene, microseconds; None without one."""
        return self._samples[-1].time_us if self._samples else None

    def motion(self, rays: RayScene, link: str, begin_us: int, end_us: int) -> Motion | None:
        """Return the poses of all objects from one time to another.

        Args:
            rays: the scene of the rays; updated with the models that have moved.
            link: Gazebo's name of the lidar's link.
            begin_us, end_us: within the times of the scenes, microseconds.

        Returns:
            The motion; None if the link is missing in a scene.
        """
        samples = list(self._samples)
        first = max((k for k, s in enumerate(samples) if s.time_us <= begin_us), default=0)
        last = next((k for k, s in enumerate(samples) if s.time_us >= end_us), len(samples) - 1)
        chosen = samples[first : last + 1]
        if any(link not in sample.scene.links for sample in chosen):
            return None
        while any(sample.layout is not rays.layout for sample in chosen):  # repeated if a model has just begun to move
            for sample in chosen:
                if sample.layout is not rays.layout:
                    sample.places = rays.places(sample.scene)
                    sample.layout = rays.layout
        return Motion(
            np.array([sample.time_us for sample in chosen]),
            np.stack([sample.places for sample in chosen if sample.places is not None]),
            link_places([sample.scene.links[link] for sample in chosen]),
            rays.layout,
        )
