"""Line of sight between the antennas of two vehicles, at a time between two scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose
from xtdrone_sim.lidars.scan_measurement import link_places
from xtdrone_sim.rays.casting import between
from xtdrone_sim.rays.scene import Layout, RayScene, SceneAt, cast
from xtdrone_sim.rays.tree import NOTHING

Array = NDArray[np.float64]


class Moment(NamedTuple):
    """A time between two scenes.

    Attributes:
        before, after: the scenes.
        share: 0..1, fraction of the interval from one to the other.
    """

    before: SceneAt
    after: SceneAt
    share: float

    def pose(self, link: str) -> Pose | None:
        """Return the pose of a link; None if it is missing in a scene. See ``lidars.scan_measurement.cast_scan``."""
        ends = self.before.links.get(link), self.after.links.get(link)
        if ends[0] is None or ends[1] is None:
            return None
        if self.share in (0.0, 1.0):
            return ends[int(self.share)]
        return Pose(*between(*link_places([ends[0], ends[1]]), self.share))


class Sights:
    """Lines of sight at one moment."""

    def __init__(self, rays: RayScene, moment: Moment) -> None:
        """Place all objects."""
        self._rays = rays
        self._share = moment.share
        self._layout, self._places = _place(rays, (moment.before, moment.after))

    def blocked(self, own: str, position: Array, others: Sequence[str], positions: Array) -> NDArray[np.bool_]:
        """Return whether an object other than the two vehicles is between an antenna and each of the others.

        Args:
            own: vehicle of the antenna.
            position: (3,) m, map.
            others: n vehicles.
            positions: (n, 3) m, map, of their antennas.
        """
        offsets = positions - position
        n = len(offsets)
        segments, shares = np.zeros(n, np.int64), np.full(n, self._share)
        blocked = np.zeros(n, bool)
        for k, distance in enumerate(np.sqrt(np.sum(offsets * offsets, axis=1))):
            hits = cast(
                self._layout, self._places, segments[k : k + 1], shares[k : k + 1], position[None], offsets[k : k + 1],
                float(distance), self._rays.number(own),
            )  # fmt: skip
            blocked[k] = hits.owners[0] not in (NOTHING, self._rays.number(others[k]))
        return blocked


def _place(rays: RayScene, scenes: Sequence[SceneAt]) -> tuple[Layout, NDArray[np.void]]:
    """Return layout and places of scenes, recomputed if a model that begins to move has changed the layout."""
    while True:
        layout = rays.layout
        places = np.stack([rays.places(scene) for scene in scenes])
        if rays.layout is layout:
            return layout, places
