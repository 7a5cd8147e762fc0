"""Actors' motion against closed form."""

import math

import pytest

from xtdrone_common.poses import Pose
from xtdrone_worlds.worlds.actors import STANDING, TURN_RATE, Actors
from xtdrone_worlds.worlds.sdf import SdfActor, Trajectory, Waypoint

STRIDE = 1.25


def facing(x, y, yaw, z=0.0):
    return Pose((x, y, z), (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)))


def make(*actors):
    return Actors(actors, [STRIDE] * len(actors))


def script(loop=True, delay=0.0, auto=True):
    # 4 m east in 2 s, a turn to the north in 1 s, 3 m north in 3 s
    waypoints = (
        Waypoint(0.0, facing(1.0, 1.0, 0.0)),
        Waypoint(2.0, facing(5.0, 1.0, 0.0)),
        Waypoint(3.0, facing(5.0, 1.0, math.pi / 2)),
        Waypoint(6.0, facing(5.0, 4.0, math.pi / 2)),
    )
    return SdfActor("a", pose=facing(9.0, 9.0, 1.0), trajectory=Trajectory(waypoints, loop, delay, auto))


def test_stands_where_the_world_has_it():
    state = make(SdfActor("a", pose=facing(2.0, 3.0, -2.0, z=0.5))).states(7_000_000)[0]
    assert state.position == (2.0, 3.0, 0.5)
    assert state.yaw == pytest.approx(-2.0)
    assert state.phase == STANDING


def test_script_is_walked_in_its_times():
    actors = make(script())
    state = actors.states(500_000)[0]
    assert state.position == pytest.approx((2.0, 1.0, 0.0))
    assert state.phase == pytest.approx(1.0 / STRIDE)
    state = actors.states(2_500_000)[0]
    assert state.position == pytest.approx((5.0, 1.0, 0.0))
    assert state.yaw == pytest.approx(math.pi / 4)
    assert state.phase == STANDING
    state = actors.states(4_000_000)[0]
    assert state.position == pytest.approx((5.0, 2.0, 0.0))
    assert state.phase == pytest.approx(5.0 / STRIDE)
    again = actors.states(6_500_000)[0]  # the second lap; the walk continues from its position
    assert again.position == pytest.approx((2.0, 1.0, 0.0))
    assert again.phase == pytest.approx(8.0 / STRIDE)


def test_script_that_waits_ends_or_is_not_begun():
    actors = make(script(loop=False, delay=1.0), script(auto=False))
    assert actors.states(900_000)[0].position == (1.0, 1.0, 0.0)
    assert actors.states(1_500_000)[0].position == pytest.approx((2.0, 1.0, 0.0))
    end = actors.states(60_000_000)
    assert end[0].position == (5.0, 4.0, 0.0)
    assert end[0].phase == STANDING
    assert end[1].position == (1.0, 1.0, 0.0)
    actors.restart(60_000_000)
    assert actors.states(61_500_000)[0].position == pytest.approx((2.0, 1.0, 0.0))


def test_a_commanded_actor_turns_walks_straight_and_stands():
    actors = make(SdfActor("a", pose=facing(1.0, 2.0, 0.0)), SdfActor("b", pose=facing(0.0, 0.0, 0.0)))
    actors.send(0, 1.0, 5.0, 1.5, 2_000_000)
    turning = (math.pi / 2) / TURN_RATE
    state = actors.states(2_500_000)[0]
    assert state.position == (1.0, 2.0, 0.0)
    assert state.yaw == pytest.approx(0.5 * TURN_RATE)
    assert state.phase == STANDING
    state = actors.states(2_000_000 + round(1e6 * (turning + 1.0)))[0]
    assert state.position == pytest.approx((1.0, 3.5, 0.0), abs=1e-5)
    assert state.yaw == pytest.approx(math.pi / 2)
    assert state.phase == pytest.approx(1.5 / STRIDE, abs=1e-5)
    state = actors.states(2_000_000 + round(1e6 * (turning + 2.0)) + 10)[0]
    assert state.position == (1.0, 5.0, 0.0)
    assert state.phase == STANDING
    assert actors.states(9_000_000)[1].position == (0.0, 0.0, 0.0)


def test_small_turns_are_made_while_walking():
    actors = make(SdfActor("a", pose=facing(0.0, 0.0, 0.0)))
    actors.send(0, 10.0, 0.0, 1.0, 0)
    before = actors.states(3_000_000)[0]
    actors.send(0, 3.0 + 10.0 * math.cos(0.15), 10.0 * math.sin(0.15), 1.0, 3_000_000)
    assert actors.states(3_000_000)[0] == before
    state = actors.states(3_500_000)[0]
    assert state.position == pytest.approx((3.0 + 0.5 * math.cos(0.15), 0.5 * math.sin(0.15), 0.0))
    assert state.yaw == pytest.approx(0.15)
    assert state.phase == pytest.approx(3.5 / STRIDE)


def test_own_speed_stop_and_rejected_commands():
    actors = make(SdfActor("a", pose=facing(0.0, 0.0, 0.0), speed=0.7), script())
    actors.send(0, 7.0, 0.0, -1.0, 0)
    assert actors.states(1_000_000)[0].position == pytest.approx((0.7, 0.0, 0.0))
    for x, speed, text in ((math.nan, 1.0, "a: x: nan is not allowed"), (0.0, 11.0, "a: v: 11.0 is not allowed")):
        with pytest.raises(ValueError, match=text):
            actors.send(0, x, 0.0, speed, 1_000_000)
    actors.send(0, 7.0, 0.0, 0.0, 1_000_000)
    assert actors.states(5_000_000)[0].position == pytest.approx((0.7, 0.0, 0.0))
    assert actors.states(5_000_000)[0].phase == STANDING
    actors.send(1, 2.0, 1.0, 1.0, 500_000)  # is there already, with its script finished
    assert actors.states(5_000_000)[1].position == (2.0, 1.0, 0.0)
