"""The models' true states for programs that show them, by the wall clock.

=====================  =======================  ======================================================================
/xtdrone/live_states   gazebo_msgs/ModelStates  as /gazebo/model_states; at most 30 in a wall second, while subscribed
=====================  =======================  ======================================================================

At full speed /gazebo/model_states, which keeps a rate in simulated time, has some hundred messages in a wall second:
far more than a browser draws. This topic is not part of the lockstep: the simulation waits for no subscriber, digests
leave it out, and which ticks it shows depends on the machine. While time stands still it is published once a second,
for subscribers that come then; the world may then be one tick ahead of /clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from gazebo_msgs.msg import ModelStates

from xtdrone_control import lockstep

TOPIC = "/xtdrone/live_states"
PERIOD = 1.0 / 30.0
"""Wall seconds between two messages, at least."""
STANDING_PERIOD = 1.0
"""Likewise while simulated time stands still."""


class LiveStates:
    """Publishes the states of the tick at which they are due."""

    def __init__(self, states: Callable[[], ModelStates], clock: Callable[[], float] = time.monotonic) -> None:
        """Advertise the topic.

        Args:
            states: returns the current states.
            clock: wall time, s.
        """
        self._states = states
        self._clock = clock
        self._publisher = lockstep.UncountedPublisher(TOPIC, ModelStates, queue_size=1)
        self._published = -STANDING_PERIOD
        self._is_last = False  # whether the states of the latest tick have been published

    def ticked(self) -> None:
        """Publish the states of a new tick if they are due."""
        self._is_last = False
        self._publish(PERIOD)

    def stands(self) -> None:
        """Publish, while time stands still, the states of the last tick, and again for new subscribers."""
        self._publish(STANDING_PERIOD if self._is_last else PERIOD)

    def _publish(self, period: float) -> None:
        if not self._publisher.get_num_connections():
            return
        now = self._clock()
        if now - self._published < period:
            return
        self._published, self._is_last = now, True
        self._publisher.publish(self._states())
