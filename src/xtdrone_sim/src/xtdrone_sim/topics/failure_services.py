"""The services ``TOPIC/failure`` of lidars and UWB sensors."""

from __future__ import annotations

import rospy
from xtdrone_msgs.srv import SetLidarFailure, SetLidarFailureRequest, SetLidarFailureResponse

from xtdrone_sim.sensors.ranging_failures import RangingFailure


class FailureServices:
    """Injects failures into the sensors of a node; the failure of each is found by its topic."""

    def __init__(self) -> None:
        """Start without sensors."""
        self._failures: dict[str, RangingFailure] = {}
        self._services: dict[str, rospy.Service] = {}

    def add(self, topic: str) -> None:
        """Advertise the service of a sensor, initially without a failure."""
        self._failures[topic] = RangingFailure()
        self._services[topic] = rospy.Service(
            f"{topic}/failure", SetLidarFailure, lambda request: self._fail(topic, request)
        )

    def remove(self, topic: str) -> None:
        """End the service of a sensor."""
        self._services.pop(topic).shutdown()
        del self._failures[topic]

    def __getitem__(self, topic: str) -> RangingFailure:
        return self._failures[topic]

    def _fail(self, topic: str, request: SetLidarFailureRequest) -> SetLidarFailureResponse:
        try:
            failure = RangingFailure.checked(request.failure, request.value)
        except ValueError as error:
            return SetLidarFailureResponse(False, f"{topic}: {error}")
        self._failures[topic] = failure
        rospy.loginfo(f"{topic}: {failure}")
        return SetLidarFailureResponse(True, f"{topic}: {failure}")

    def close(self) -> None:
        """End the services."""
        for service in self._services.values():
            service.shutdown()
