"""Transforms received on /tf, for plugins with ``tf/listen``."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

import rospy
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from xtdrone_mavros.uas import Uas

Take = Callable[[TransformStamped], None]

_MEMORY = 10.0  # s
_AUTHORITY = "mavros"  # authority in tf2's warnings


class TfListener:
    """Pose of one frame in another, from all transforms on /tf and /tf_static.

    The settings are MAVROS's: ``<plugin>/tf/frame_id``, ``child_frame_id``, ``rate_limit`` (Hz).
    """

    def __init__(self, uas: Uas, plugin: str, child: str, take: Take | None = None) -> None:
        """Subscribe.

        Args:
            uas: the vehicle's hub.
            plugin: plugin whose settings apply.
            child: default of the child frame.
            take: called at the rate limit with the latest transform, even if it is unchanged, as in MAVROS; None if the
                plugin only calls ``latest``.

        Raises:
            ValueError: the rate is not positive and finite.
        """
        import tf2_py  # imported here, so that a node without listeners starts without it

        get = uas.params.get
        self._frame = get(f"{plugin}/tf/frame_id", "map")
        self._child = get(f"{plugin}/tf/child_frame_id", child)
        rate = get(f"{plugin}/tf/rate_limit", 50.0)
        if not 0.0 < rate < inf:
            raise ValueError(f"{plugin}/tf/rate_limit: {rate} Hz is not allowed; more than 0 is")
        self._unknown: Any = tf2_py.TransformException
        self._buffer = tf2_py.BufferCore(rospy.Duration.from_sec(_MEMORY))
        self._static: dict[str, TransformStamped] = {}  # by child; published once
        uas.subscribe("/tf", TFMessage, self._store)
        uas.subscribe("/tf_static", TFMessage, self._store_static)
        if take is not None:
            uas.timer(1.0 / rate, lambda: self._pass_latest(take))

    def clear(self) -> None:
        """Drop the transforms from /tf, after the clock was set back."""
        self._buffer.clear()
        for transform in self._static.values():
            self._buffer.set_transform_static(transform, _AUTHORITY)

    def latest(self) -> TransformStamped | None:
        """Return the latest transform, None if there is none."""
        try:
            return self._buffer.lookup_transform_core(self._frame, self._child, rospy.Time())
        except self._unknown:
            return None

    def _store(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self._buffer.set_transform(transform, _AUTHORITY)

    def _store_static(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self._static[transform.child_frame_id] = transform
            self._buffer.set_transform_static(transform, _AUTHORITY)

    def _pass_latest(self, take: Take) -> None:
        transform = self.latest()
        if transform is not None:
            take(transform)
