"""A goal that moves: the flight to it is planned in its frame, in which it stands still.

PX4 v1.14 flies to each new position of a landing target as to a goal at rest, and therefore lags behind a moving one;
its later vision_target_estimator also provides the target's velocity, as here.
"""

from __future__ import annotations

from xtdrone_control.kernel import kernel


@kernel
def move_with_goal(c, s, dt):
    """Move goal, legs and smoothed path with the goal's motion; the path's velocity is then relative to the goal.

    A change of the goal's velocity leaves the velocity over ground unchanged.
    """
    for i in range(2):
        if s.goal_velocity[i] != c.goal_velocity[i]:
            c.path.velocity[i] -= s.goal_velocity[i] - c.goal_velocity[i]
            c.goal_velocity[i] = s.goal_velocity[i]
        if c.goal_velocity[i] != 0.0:
            moved = c.goal_velocity[i] * dt
            s.goal_position[i] += moved
            c.path.position[i] += moved
            c.leg_start[i] += moved
            c.leg_goal[i] += moved
            c.leg_onward[i] += moved
            c.way_start[i] += moved
            c.way_goal[i] += moved
            c.way_onward[i] += moved


@kernel
def add_goal_velocity(c):
    """Convert the velocity of the trajectory setpoint back to a velocity over ground."""
    for i in range(2):
        if c.goal_velocity[i] != 0.0:
            c.task_velocity[i] += c.goal_velocity[i]
