"""Transforms that others broadcast, for plugins whose ``tf/listen`` says so."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

import rospy
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from xtdrone_control.mavros.uas import Uas

Take = Callable[[TransformStamped], None]

_MEMORY = 10.0  # s
_TELLER = "mavros"  # for tf2's warnings


class TfListener:
    """Where one frame lies in another, by all that is told on /tf and /tf_static.

    The settings are MAVROS's: ``<plugin>/tf/frame_id``, ``child_frame_id``, ``rate_limit`` (Hz).
    """

    def __init__(self, uas: Uas, plugin: str, child: str, take: Take | None = None) -> None:
        """Subscribe.

        Args:
            uas: the vehicle's hub.
            plugin: whose settings hold.
            child: the child frame where the settings name none.
            take: called at the rate with the latest transform, also when it is the same as before, as in MAVROS; None
                when the plugin asks by ``latest`` alone.

        Raises:
            ValueError: a rate that is not positive and finite.
        """
        import tf2_py  # a node that does not listen starts without it

        get = uas.params.get
        self._frame = get(f"{plugin}/tf/frame_id", "map")
        self._child = get(f"{plugin}/tf/child_frame_id", child)
        rate = get(f"{plugin}/tf/rate_limit", 50.0)
        if not 0.0 < rate < inf:
            raise ValueError(f"{plugin}/tf/rate_limit: {rate} Hz is not allowed; more than 0 is")
        self._unknown: Any = tf2_py.TransformException
        self._buffer = tf2_py.BufferCore(rospy.Duration.from_sec(_MEMORY))
        self._static: dict[str, TransformStamped] = {}  # by child; told once
        uas.subscribe("/tf", TFMessage, self._learn)
        uas.subscribe("/tf_static", TFMessage, self._learn_static)
        if take is not None:
            uas.timer(1.0 / rate, lambda: self._look(take))

    def clear(self) -> None:
        """Forget what was told on /tf, for the clock has been set back."""
        self._buffer.clear()
        for transform in self._static.values():
            self._buffer.set_transform_static(transform, _TELLER)

    def latest(self) -> TransformStamped | None:
        """Return the latest transform, None while there is none."""
        try:
            return self._buffer.lookup_transform_core(self._frame, self._child, rospy.Time())
        except self._unknown:
            return None

    def _learn(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self._buffer.set_transform(transform, _TELLER)

    def _learn_static(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self._static[transform.child_frame_id] = transform
            self._buffer.set_transform_static(transform, _TELLER)

    def _look(self, take: Take) -> None:
        transform = self.latest()
        if transform is not None:
            take(transform)
