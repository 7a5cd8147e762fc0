"""Services of Gazebo's ROS API that have no meaning here; each responds with the reason and an alternative."""

from __future__ import annotations

from typing import Any

import rospy
from gazebo_msgs import srv

_JOINTS = (
    "joints of vehicles are moved by their autopilots (gimbal: mavros/mount_control/command, landing gear: no command) "
    "and set by /gazebo/set_model_configuration"
)
_LIGHT = "the world has one sun, which is that of the world file (docs/worlds.md)"
_MASS = "mass and inertia are those of a vehicle's or a model's description; delete the model and spawn another one"

REFUSED = {
    "apply_joint_effort": (srv.ApplyJointEffort, f"joints have no efforts here: {_JOINTS}"),
    "clear_joint_forces": (srv.JointRequest, f"joints have no efforts here: {_JOINTS}"),
    "get_joint_properties": (srv.GetJointProperties, "angles and rates of joints are on /VEHICLE/joint_states"),
    "set_joint_properties": (srv.SetJointProperties, f"joints have no engine parameters here: {_JOINTS}"),
    "set_link_properties": (srv.SetLinkProperties, _MASS),
    "get_light_properties": (srv.GetLightProperties, _LIGHT),
    "set_light_properties": (srv.SetLightProperties, _LIGHT),
    "delete_light": (srv.DeleteLight, _LIGHT),
}
"""Type and reason by the name of the service below /gazebo."""


def advertise_refused() -> None:
    """Advertise the services, so that their callers get the reason."""
    for name, (kind, reason) in REFUSED.items():
        rospy.Service(f"/gazebo/{name}", kind, _Refusal(kind, f"/gazebo/{name} is not supported: {reason}"))


class _Refusal:
    """The handler of one such service."""

    def __init__(self, kind: Any, text: str) -> None:
        self._kind, self._text = kind, text

    def __call__(self, _request: Any) -> Any:
        response = self._kind._response_class()
        if not hasattr(response, "success"):
            raise rospy.ServiceException(self._text)
        response.success, response.status_message = False, self._text
        return response
