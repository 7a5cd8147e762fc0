"""The services of move_base: ``make_plan`` (nav_msgs/GetPlan) and ``clear_costmaps`` (std_srvs/Empty).

Services run in threads of their own; both hold a lock that the node's turns and messages hold too. Unlike move_base,
``make_plan`` answers while a goal is pursued, too, for its search has a work space of its own.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np
import rospy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan, GetPlanRequest, GetPlanResponse
from numpy.typing import NDArray
from std_srvs.srv import Empty, EmptyResponse

from xtdrone_planning.mapping.map_messages import FRAME
from xtdrone_planning.navigation.global_path import GlobalSearch, PathError
from xtdrone_planning.navigation.level_map import LevelMap

Array = NDArray[np.float64]


class MoveBaseServices:
    """Both services of one vehicle.

    Attributes:
        lock: is held while a service reads or changes the map.
    """

    def __init__(
        self,
        base: str,
        level: LevelMap,
        clearance: Callable[[], float],
        present: Callable[[], Array | None],
        answer: Callable[[Array], GetPlanResponse],
    ) -> None:
        """Declare the services.

        Args:
            base: prefix of their names, as ``/iris_2d_lidar_0/move_base``.
            level: the map.
            clearance: returns the least distance of paths to obstacles, m.
            present: returns where the vehicle is, (2,) or longer, m in map; None while that is unknown.
            answer: returns the response with a path (n, 2), m in map.
        """
        self.lock = threading.RLock()
        self._level, self._clearance, self._present, self._answer = level, clearance, present, answer
        self._search = GlobalSearch()
        rospy.Service(f"{base}/make_plan", GetPlan, self._on_plan)
        rospy.Service(f"{base}/clear_costmaps", Empty, self._on_clear)

    def _on_plan(self, request: GetPlanRequest) -> GetPlanResponse:
        """Return a path from start to goal, or to within the tolerance of it; an empty one if there is none.

        A start without a frame is where the vehicle is, as in move_base.
        """
        try:
            if not 0.0 <= request.tolerance < math.inf:
                raise ValueError(f"tolerance: {request.tolerance:g} is not allowed, at least 0 and finite, m")
            goal = _place_of(request.goal, "goal")
            with self.lock:
                start = _place_of(request.start, "start") if request.start.header.frame_id else self._present()
                if start is None or not self._level.is_ready:
                    raise ValueError(f"no {'position of the vehicle' if start is None else 'map'} has been received")
                self._level.update_distance()
                found = self._search.find_near(
                    self._level, start[:2], goal, self._clearance(), float(request.tolerance)
                )
                return self._answer(found)
        except PathError as error:
            rospy.loginfo(f"make_plan: {error}")
            return self._answer(np.empty((0, 2)))
        except ValueError as error:
            raise rospy.ServiceException(str(error)) from error

    def _on_clear(self, _: object) -> EmptyResponse:
        """Forget what was seen, on the global and the local costmap, which are one map here."""
        with self.lock:
            if self._level.is_ready:
                self._level.forget_all()
        return EmptyResponse()


def _place_of(pose: PoseStamped, name: str) -> Array:
    """Return the place (2,) of a pose, m in map.

    Raises:
        ValueError: another frame, or numbers that are not finite.
    """
    frame = pose.header.frame_id.lstrip("/")
    if frame not in ("", FRAME):
        raise ValueError(f"{name}: frame {frame!r} is not allowed, {FRAME!r}")
    place = np.array([pose.pose.position.x, pose.pose.position.y])
    if not np.isfinite(place).all():
        raise ValueError(f"{name}: ({place[0]:g}, {place[1]:g}) is not allowed, finite numbers")
    return place
