"""State of vehicles from the topics of a MAVROS other than this project's."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Self

from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_interaction.doctor.findings import ESTIMATES, SETPOINT_TOPICS, Vehicle

_PREARM_CHECK = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK
_WARNING = 4  # MAV_SEVERITY
_TEXTS = 3


class Listener:
    """Subscriptions to the topics of some vehicles; a context manager that ends this process's node."""

    def __init__(self, uri: str, prefixes: Sequence[str], publishers: Mapping[str, Sequence[str]]) -> None:
        """Join the ROS graph, out of the lockstep and without simulated time.

        Args:
            uri: of the master.
            prefixes: namespaces, as ``/iris_0/mavros``.
            publishers: nodes by topic.
        """
        os.environ["ROS_MASTER_URI"] = uri
        import rospy
        from mavros_msgs.msg import EstimatorStatus, State, StatusText, SysStatus

        self._rospy = rospy
        self._latest: dict[str, Any] = {}
        self._texts: dict[str, list[str]] = defaultdict(list)
        self._setpoints: dict[str, int] = defaultdict(int)
        init_plain_node("xtdrone_doctor", anonymous=True, disable_signals=True, disable_rostime=True)
        for prefix in prefixes:
            for name, kind in (("state", State), ("sys_status", SysStatus), ("estimator_status", EstimatorStatus)):
                rospy.Subscriber(f"{prefix}/{name}", kind, self._keep, f"{prefix}/{name}")
            rospy.Subscriber(f"{prefix}/statustext/recv", StatusText, self._on_text, prefix)
            for name in SETPOINT_TOPICS:
                if f"{prefix}/{name}" in publishers:
                    rospy.Subscriber(f"{prefix}/{name}", rospy.AnyMsg, self._on_setpoint, prefix)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._rospy.signal_shutdown("the doctor has finished")

    def vehicle(self, prefix: str, seconds: float) -> Vehicle:
        """Return what was received of a vehicle; ``seconds``: of its time in which setpoints were counted, or 0."""
        state = self._latest.get(f"{prefix}/state")
        status = self._latest.get(f"{prefix}/sys_status")
        estimator = self._latest.get(f"{prefix}/estimator_status")
        name = prefix.strip("/").rpartition("/")[0] or "mavros"
        missing = [] if estimator is None else [word for flag, _, word in ESTIMATES if not getattr(estimator, flag)]
        return Vehicle(
            name=name,
            prefix=prefix,
            served=True,
            heard=state is not None,
            connected=bool(state and state.connected),
            armed=bool(state and state.armed),
            mode=str(state.mode) if state else "",
            system_status=int(state.system_status) if state else 0,
            ready_to_arm=None if status is None else _ready(status),
            missing_estimates=tuple(missing),
            texts=tuple(dict.fromkeys(self._texts[prefix]))[-_TEXTS:],
            setpoint_rate=self._setpoints[prefix] / seconds if seconds > 0.0 else None,
        )

    def _keep(self, message: Any, topic: str) -> None:
        self._latest[topic] = message

    def _on_text(self, text: Any, prefix: str) -> None:
        if text.severity <= _WARNING:
            self._texts[prefix].append(text.text.strip())

    def _on_setpoint(self, _message: Any, prefix: str) -> None:
        self._setpoints[prefix] += 1


def _ready(status: Any) -> bool | None:
    """Return the prearm check of SYS_STATUS; None if the autopilot does not report it."""
    if not status.sensors_present & _PREARM_CHECK:
        return None
    return bool(status.sensors_health & _PREARM_CHECK)
