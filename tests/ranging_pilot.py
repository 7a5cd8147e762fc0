"""A script that flies two vehicles with range sensors: the error of the first one's estimate of the second's position.

``ranging_pilot.py FILE``: the first hovers, the second flies curves about it. FILE (JSON) gets the time until the first
estimate (s of the curves), errors (m), and normalised squared errors for each degree of freedom.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import rospy
from gazebo_msgs.msg import ModelStates
from nav_msgs.msg import Odometry

import xtdrone_lockstep as lockstep
from xtdrone_control.drone import connect_all

NAMES = ("iris_uwb_0", "iris_uwb_1")
CURVES, STEP = 24.0, 0.1  # s
places: dict[str, np.ndarray] = {}
found: list[tuple[float, float, float]] = []  # s, error (m), normalised squared error


def on_models(states: ModelStates) -> None:
    """Keep the true positions."""
    for name, pose in zip(states.name, states.pose, strict=True):
        places[name] = np.array([pose.position.x, pose.position.y, pose.position.z])


def on_estimate(message: Odometry) -> None:
    """Compare an estimate with the truth."""
    p = message.pose.pose.position
    error = np.array([p.x, p.y, p.z]) - (places[NAMES[1]] - places[NAMES[0]])
    covariance = np.array(message.pose.covariance).reshape(6, 6)[:3, :3]
    squared = float(error @ np.linalg.solve(covariance, error)) / 3.0
    found.append((rospy.get_time(), float(np.linalg.norm(error)), squared))


with connect_all() as drones:
    lockstep.Subscriber("/gazebo/model_states", ModelStates, on_models)
    lockstep.Subscriber(f"/xtdrone/{NAMES[0]}/neighbours/{NAMES[1]}", Odometry, on_estimate)
    drones.arm()
    drones.takeoff(3.0)
    begin = rospy.get_time()
    while (time := rospy.get_time() - begin) < CURVES:
        turning = (math.cos(0.5 * time), 1.2 * math.sin(0.4 * time), 0.3 * math.cos(0.9 * time))
        drones.set_velocity([(0.0, 0.0, 0.0), turning])
        drones.wait(STEP)
    rows = np.array(found).reshape(-1, 3)
    late = rows[len(rows) // 2 :]
    report = {
        "first": float(rows[0, 0] - begin) if len(rows) else None,
        "count": len(rows),
        "median": float(np.median(rows[:, 1])) if len(rows) else None,
        "most": float(rows[:, 1].max(initial=0.0)),
        "late": float(late[:, 1].max(initial=0.0)),
        "squared": float(rows[:, 2].mean()) if len(rows) else None,
    }
    Path(sys.argv[1]).write_text(json.dumps(report), encoding="utf-8")
