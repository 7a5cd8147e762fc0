"""Conversion of the simulator's records to Gazebo's messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3
from numpy.typing import NDArray

from xtdrone_control.frames import to_xyzw
from xtdrone_sim.physics.plant import rotate
from xtdrone_sim.worlds.sdf import SdfModel


def model_states(names: Sequence[str], plant: NDArray[np.void], models: Sequence[SdfModel] = ()) -> ModelStates:
    """Return the true state of the ground plane, of all vehicles, and of the models in the world.

    Args:
        names: model names.
        plant: (n,) ``PLANT``.
        models: static models of the world.

    Returns:
        Poses in the world frame (ENU, quaternion x, y, z, w) and twists in the world frame, as Gazebo gives them.
    """
    message = ModelStates(name=["ground_plane", *names])
    level = Pose(Point(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
    message.pose.append(level)
    message.twist.append(Twist())
    for v in plant:
        w, x, y, z = v["q"].tolist()
        message.pose.append(Pose(Point(*v["position"].tolist()), Quaternion(x, y, z, w)))
        spin = rotate(v["q"], *v["rates"].tolist())
        message.twist.append(Twist(Vector3(*v["velocity"].tolist()), Vector3(*spin)))
    for model in models:
        message.name.append(model.name)
        message.pose.append(Pose(Point(*model.pose.position), Quaternion(*to_xyzw(model.pose.orientation))))
        message.twist.append(Twist())
    return message
