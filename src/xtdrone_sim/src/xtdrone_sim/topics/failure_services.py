"""The services ``TOPIC/failure`` of lidars and UWB sensors."""

from __future__ import annotations

from collections.abc import Sequence

import rospy
from xtdrone_msgs.srv import SetLidarFailure, SetLidarFailureRequest, SetLidarFailureResponse

from xtdrone_sim.sensors.ranging_failures import RangingFailure


class FailureServices:
    """Lets the sensors of a node fail; index k gives the failure of sensor k."""

    def __init__(self, topics: Sequence[str]) -> None:
        """Advertise the services; all sensors are well.

        Args:
            topics: of the sensors.
        """
        self._topics = tuple(topics)
        self._failures = [RangingFailure() for _ in self._topics]
        self._services = [
            rospy.Service(f"{topic}/failure", SetLidarFailure, lambda request, k=k: self._fail(k, request))
            for k, topic in enumerate(self._topics)
        ]

    def __getitem__(self, k: int) -> RangingFailure:
        return self._failures[k]

    def _fail(self, k: int, request: SetLidarFailureRequest) -> SetLidarFailureResponse:
        topic = self._topics[k]
        try:
            failure = RangingFailure.checked(request.failure, request.value)
        except ValueError as error:
            return SetLidarFailureResponse(False, f"{topic}: {error}")
        self._failures[k] = failure
        rospy.loginfo(f"{topic}: {failure}")
        return SetLidarFailureResponse(True, f"{topic}: {failure}")

    def close(self) -> None:
        """End the services."""
        for service in self._services:
            service.shutdown()
