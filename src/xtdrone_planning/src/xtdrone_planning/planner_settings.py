"""All settings of the planner: decisions and goals, limits of trajectories, and agreement with other vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting

Array = NDArray[np.float64]

GLOBAL_PLANNERS = ("astar", "rrt_star", "bit_star", "informed_rrt_star")

_LARGEST = 1e5  # m


class GoalError(ValueError):
    """A goal that is not allowed; the message names it, its value and what is allowed."""


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """How the planner decides."""

    lowest: float = setting(0.8, low=0.0, high=1000.0, unit="m", text="lowest height of flight and of goals")
    highest: float = setting(5.0, low=0.5, high=1000.0, unit="m", text="highest height of flight and of goals")
    horizon: float = setting(12.0, low=2.0, high=60.0, unit="m", text="greatest length of a planned path")
    period: float = setting(0.2, low=0.02, high=5.0, unit="s", text="time between two plans in flight")
    patience: float = setting(
        6.0, low=0.5, high=120.0, unit="s", text="time without a trajectory to a goal after which it is unreachable"
    )
    retry: float = setting(2.0, low=0.1, high=60.0, unit="s", text="time between attempts at an unreachable goal")
    voxels: int = setting(
        25000, low=100, high=10_000_000, text="greatest number of voxels that a search expands, which bounds its time"
    )
    global_planner: str = setting("astar", choices=GLOBAL_PLANNERS, text="search for the path: A*, or OMPL's")
    iterations: int = setting(
        400, low=10, high=100_000,
        text="iterations of OMPL's planners in a search: RRT* and Informed RRT* add a sample in each, BIT* examines an "
        "edge between its samples",
    )  # fmt: skip
    sampling_seed: int = setting(1, low=1, high=2**31 - 1, text="seed of each search of OMPL's planners")
    lead: float = setting(
        0.06, low=0.0, high=1.0, unit="s",
        text="time by which setpoints lead the trajectory: their delay to the autopilot",
    )  # fmt: skip
    attitude_lag: float = setting(
        0.1, low=0.0, high=1.0, unit="s", text="time by which accelerations lead positions and velocities"
    )
    drag: float = setting(
        0.3, low=0.0, high=3.0, unit="1/s",
        text="horizontal deceleration by air drag at 1 m/s, which accelerations compensate: that of the iris's rotors",
    )  # fmt: skip
    damping: float = setting(
        0.2, low=0.0, high=2.0,
        text="share of horizontal accelerations that the autopilot's derivative term removes, which they compensate: "
        "MPC_XY_VEL_D_ACC of PX4",
    )  # fmt: skip
    astray: float = setting(
        1.0, low=0.1, high=10.0, unit="m", text="deviation from the trajectory beyond which the vehicle replans"
    )
    yaw_rate: float = setting(1.5, low=0.1, high=6.0, unit="rad/s", text="greatest yaw rate")
    carry: float = setting(
        0.0, low=0.0, high=10.0, unit="s",
        text="time by which velocities on /xtdrone/VEHICLE/cmd_vel_enu, as of a follower, keep the goal ahead of the "
        "vehicle; 0: they are not used",
    )  # fmt: skip
    offboard: bool = setting(True, text="request OFFBOARD for a new goal; false: wait for the pilot to do so")

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest flight, m in map."""
        return self.lowest, self.highest

    def check_goal(self, goal: Array) -> None:
        """Check a goal, (3,) m in map.

        Raises:
            GoalError: not finite, too far, or outside of the allowed heights.
        """
        if not all(math.isfinite(value) and abs(value) <= _LARGEST for value in goal.tolist()):
            raise GoalError(f"goal: {_text(goal)} is not allowed, finite numbers within +-{_LARGEST:g} m")
        if not self.lowest <= goal[2] <= self.highest:
            raise GoalError(
                f"goal: height {goal[2]:.2f} is not allowed, {self.lowest:g} to {self.highest:g} m (lowest, highest)"
            )


def _text(values: Array) -> str:
    return f"({', '.join(f'{value:g}' for value in values.tolist())})"


@dataclass(frozen=True)
class TrajectorySettings(Settings):
    """Limits of trajectories, and the vehicle's size."""

    speed: float = setting(4.0, low=0.2, high=15.0, unit="m/s", text="greatest speed")
    acceleration: float = setting(3.0, low=0.3, high=8.0, unit="m/s²", text="greatest acceleration")
    radius: float = setting(0.4, low=0.1, high=3.0, unit="m", text="radius of the vehicle, rotors included")
    margin: float = setting(0.15, low=0.0, high=2.0, unit="m", text="clearance to obstacles, beyond the radius")
    comfort: float = setting(
        0.35, low=0.0, high=3.0, unit="m", text="additional clearance to obstacles where space allows"
    )

    def clearance(self, resolution: float) -> float:
        """Return the minimum distance, m, between the vehicle's centre and that of an occupied voxel."""
        return self.radius + self.margin + 0.5 * resolution


@dataclass(frozen=True)
class AgreementSettings(Settings):
    """Coordination of trajectories between vehicles."""

    check: float = setting(
        0.4, low=0.0, high=5.0, unit="s",
        text="time for which a proposed trajectory is open to objections: at least the radio delay, plus 0.1 s for "
        "each message that may be lost",
    )  # fmt: skip
    separation: float = setting(
        0.4, low=0.0, high=10.0, unit="m", text="clearance between two planned vehicles, beyond their radii"
    )
    pause: float = setting(0.3, low=0.0, high=10.0, unit="s", text="time between a decision and the next proposal")
