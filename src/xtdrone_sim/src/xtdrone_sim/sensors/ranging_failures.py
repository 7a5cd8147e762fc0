"""Failures of lidars and UWB sensors, which users inject by the service ``TOPIC/failure``."""

from __future__ import annotations

from dataclasses import dataclass

import rospy
from xtdrone_msgs.srv import SetLidarFailure, SetLidarFailureRequest, SetLidarFailureResponse

from xtdrone_common.settings import check_choice, check_range

FAILURES = ("ok", "off", "frozen", "biased", "dropouts")
MOST_BIAS = 100.0  # m


@dataclass(frozen=True)
class RangingFailure:
    """Failure of a lidar or a UWB sensor.

    Attributes:
        kind: kind of ``FAILURES``.
        value: m of a bias, 0..1 of dropouts.
    """

    kind: str = "ok"
    value: float = 0.0

    def __str__(self) -> str:
        """Return the kind, and the value if the kind has one."""
        return f"{self.kind} {self.value:g}" if self.kind in ("biased", "dropouts") else self.kind

    @property
    def bias(self) -> float:
        """Error of all ranges, m."""
        return self.value if self.kind == "biased" else 0.0

    @property
    def dropouts(self) -> float:
        """Share of the ranges that the failure loses, 0..1."""
        return self.value if self.kind == "dropouts" else 0.0

    @classmethod
    def checked(cls, kind: str, value: float) -> RangingFailure:
        """Return a failure.

        Raises:
            ValueError: kind or value is not allowed.
        """
        check_choice("failure", kind, FAILURES)
        if kind == "biased":
            check_range("value", value, -MOST_BIAS, MOST_BIAS, "m")
        if kind == "dropouts":
            check_range("value", value, 0.0, 1.0)
        return cls(kind, value)


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
