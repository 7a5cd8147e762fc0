"""Complete searches by the mission control in a point-mass world: finds, false finds, losses, failed cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from search_world import Thing, World, decoy, person

from xtdrone_autopilot.navigator import plan
from xtdrone_coordination.search.people.candidates import Candidate, Sighting
from xtdrone_coordination.search.search_settings import MissionSettings
from xtdrone_coordination.search.searching_vehicle import State

MODES = ("hold", "return", "continue")


def _finished(world: World) -> dict[str, Any]:
    world.run()
    assert world.events[-1]["event"] == "finished"
    return world.events[-1]


def test_a_search_without_a_person_covers_the_region_and_returns() -> None:
    world = World()
    end = _finished(world)
    assert (end["outcome"], end["reason"], end["vehicle"]) == ("not found", "all paths are flown", None)
    assert end["covered_fraction"] > 0.99
    assert end["covered_area"] == pytest.approx(120.0 * 80.0, rel=0.01)
    assert end["possible"] == end["lost"] == []
    assert [event["event"] for event in world.events] == ["started", *["returning"] * 3, "finished"]
    assert all(not body.armed and body.z == 0.0 for body in world.bodies.values())
    assert world.nearest > 0.9


@pytest.mark.parametrize("on_find", MODES)
def test_a_find_is_confirmed_by_a_second_look_and_followed(on_find: str) -> None:
    world = World(things=[person(100.0, 10.0)], on_find=on_find, follow_time=20.0)
    world.run(lambda w: w.named("following"))
    (confirmed,) = world.named("confirmed")
    finder = confirmed["vehicle"]
    assert math.dist(confirmed["position"], (100.0, 10.0)) < 0.5
    assert confirmed["found_time"] <= confirmed["time"]
    assert [e["event"] for e in world.events if e.get("vehicle") == finder][:3] == [
        "candidate",
        "second_look",
        "confirmed",
    ]
    world.run(lambda w: w.time > confirmed["time"] + 5.0)
    others = [v.state for name, v in world.control.vehicles.items() if name != finder]
    wanted = {"hold": State.HOLDING, "return": State.RETURNING, "continue": State.SEARCHING}
    assert set(others) <= {wanted[on_find], State.RETURNING, State.LANDED}
    assert world.bodies[finder].z < 12.0  # lower than any path
    end = _finished(world)
    assert (end["outcome"], end["vehicle"], end["position"]) == ("found", finder, confirmed["position"])
    (ended,) = world.named("follow_ended")
    assert (ended["reason"], ended["duration"]) == ("time", pytest.approx(20.0, abs=0.2))
    if on_find == "continue":
        assert world.bodies[finder].pitch == -60.0  # as before the following
        assert end["covered_fraction"] > 0.99
        assert len(world.named("second_look")) == 1
    assert world.nearest > 0.9


def test_a_false_candidate_is_rejected_and_the_search_continues() -> None:
    world = World(things=[decoy(80.0, 12.0)], look_pitch=-60.0)
    end = _finished(world)
    assert end["outcome"] == "not found"
    rejected = world.named("rejected")
    assert 1 <= len(rejected) <= 2  # found again by another vehicle, at most
    assert len({event["vehicle"] for event in rejected}) == len(rejected)
    (possible,) = end["possible"]
    assert math.dist(possible["position"], (80.0, 12.0)) < 1.0
    assert possible["status"] == "rejected"
    assert end["covered_fraction"] > 0.99
    assert not world.named("lost_vehicle")


def _kill(index: int) -> Any:
    return lambda world: setattr(world[index], "dead", True)


def test_the_path_of_a_lost_vehicle_is_flown_by_the_others() -> None:
    world = World(at={30.0: _kill(1)})
    end = _finished(world)
    (lost,) = world.named("lost_vehicle")
    assert (lost["vehicle"], lost["reason"]) == ("typhoon_h480_1", "no state received for 3 s")
    (given,) = world.named("reassigned")
    assert given["vehicle"] == "typhoon_h480_1"
    assert given["to"]
    assert (end["outcome"], end["lost"]) == ("not found", ["typhoon_h480_1"])
    assert end["covered_fraction"] > 0.98


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ({"mode": "AUTO.RTL"}, "left AUTO.MISSION for AUTO.RTL"),
        ({"mode": "POSCTL"}, "left AUTO.MISSION for POSCTL"),
        ({"armed": False, "z": 6.0}, "disarmed at 6.0 m"),
        ({"z": 0.5, "mode": "STABILIZED"}, "fell to 0.5 m"),
    ],
)
def test_vehicles_that_no_longer_search_are_lost(what: dict[str, Any], reason: str) -> None:
    def happens(world: World) -> None:
        for name, value in what.items():
            setattr(world[2], name, value)

    world = World(at={25.0: happens})
    world.run(lambda w: w.named("reassigned"), limit=40.0)
    (lost,) = world.named("lost_vehicle")
    assert (lost["vehicle"], lost["reason"]) == ("typhoon_h480_2", reason)


def test_landed_vehicles_take_off_again_when_no_other_is_available() -> None:
    world = World(count=2)
    world[1].items = world[1].items[:4] + world[1].items[-1:]  # a short path: it has landed long before the other
    world.control.on_mission("typhoon_h480_1", world[1].items)
    world.run(lambda w: w.state(1) is State.LANDED)
    assert world.state(0) is State.SEARCHING
    world[0].no_camera = True
    end = _finished(world)
    (given,) = world.named("reassigned")
    assert (given["vehicle"], list(given["to"])) == ("typhoon_h480_0", ["typhoon_h480_1"])
    assert world.named("returning")[-1]["vehicle"] == "typhoon_h480_1"
    assert end["outcome"] == "not found"


def test_a_failed_camera_is_reported_and_its_path_is_flown_by_others() -> None:
    world = World(at={30.0: lambda w: setattr(w[0], "no_camera", True)})
    end = _finished(world)
    (silent,) = world.named("camera_silent")
    assert silent["vehicle"] == "typhoon_h480_0"
    assert silent["time"] == pytest.approx(35.0, abs=1.0)
    assert world.named("reassigned")[0]["to"]
    assert end["covered_fraction"] > 0.98
    assert end["lost"] == []


def test_unchanging_pictures_are_ignored() -> None:
    world = World(at={30.0: lambda w: w.control.on_camera("typhoon_h480_0", False)})
    end = _finished(world)
    (silent,) = world.named("camera_silent")
    assert silent["vehicle"] == "typhoon_h480_0"
    assert silent["time"] == pytest.approx(35.0, abs=1.0)
    assert end["covered_fraction"] > 0.98


def test_without_any_camera_the_search_has_failed() -> None:
    def dark(world: World) -> None:
        for body in world.bodies.values():
            body.no_camera = True

    end = _finished(World(at={0.0: dark}))
    assert (end["outcome"], end["reason"], end["covered_fraction"]) == ("failed", "no camera works", 0.0)


def test_two_finders_of_two_persons() -> None:
    things = [person(60.0, -25.0), person(110.0, 28.0)]
    hold = World(things=things, follow_time=10.0)
    assert _finished(hold)["outcome"] == "found"
    assert len(hold.named("confirmed")) == 1
    both = World(things=things, follow_time=10.0, on_find="continue")
    end = _finished(both)
    assert len(both.named("confirmed")) == 2
    assert len(both.named("following")) == 2
    assert end["covered_fraction"] > 0.98
    assert hold.nearest > 0.9
    assert both.nearest > 0.9


def test_a_walking_person_is_found_and_followed() -> None:
    world = World(things=[person(70.0, -10.0, 0.3, 0.4)], follow_time=40.0)
    end = _finished(world)
    assert end["outcome"] == "found"
    at = end["found_time"]
    assert math.dist(end["position"], (70.0 + 0.3 * at, -10.0 + 0.4 * at)) < 0.5
    assert world.named("follow_ended")[0]["reason"] == "time"


def test_a_person_near_the_followed_one_is_not_followed() -> None:
    """The track is followed even if the person runs farther than ``same_place`` between two pictures."""
    world = World(things=[person(100.0, 10.0)], follow_time=20.0)
    world.run(lambda w: w.named("following"))
    (begun,) = world.named("following")
    ran = {"at": begun["time"] + 5.0}
    world.things[0].at = lambda t: (100.0, 10.0) if t < ran["at"] else (100.0, 17.0)
    world.things.append(Thing(lambda t: (world.things[0].at(t)[0] + 2.0, world.things[0].at(t)[1])))
    world.run(lambda w: w.named("follow_ended"))
    (ended,) = world.named("follow_ended")
    assert (ended["reason"], ended["duration"]) == ("time", pytest.approx(20.0, abs=0.2))
    assert len(world.named("following")) == len(world.named("second_look")) == 1
    (followed,) = world.control.candidates
    assert followed.track[begun["vehicle"]] == begun["track"]


def test_of_two_tracks_in_one_place_the_more_probable_is_the_person() -> None:
    candidate = Candidate((0.0, 0.0), (0.0, 0.0), (1.0, 0.0, 0.0, 1.0), 0.0)
    walker, post = Sighting(6, (0.0, 0.0), probability=0.8), Sighting(9, (1.3, 0.0), probability=0.5)
    candidate.see("a", 0.0, post, {9})
    for k in range(1, 8):
        for sighting in (walker, post) if k != 6 else (post,):  # one picture misses the person
            candidate.see("a", 0.5 * k, sighting, {6, 9})
    assert (candidate.track, candidate.position, candidate.seen_at) == ({"a": 6}, (0.0, 0.0), 3.5)
    candidate.see("a", 4.0, post, {9})  # the person's track has ended
    assert (candidate.track, candidate.position) == ({"a": 9}, (1.3, 0.0))


def test_sightings_of_other_vehicles_do_not_delay_the_loss_of_the_person() -> None:
    world = World(things=[person(100.0, 10.0)], on_find="hold", lose_time=4.0)
    world.run(lambda w: w.named("following"))
    finder = world.named("following")[0]["vehicle"]
    begun = world.time
    see = world.control.on_picture

    def blinded(name: str, time: float, position: Any, rotation: Any, sightings: Any, now: float) -> None:
        see(name, time, position, rotation, [] if name == finder else [Sighting(1, (100.0, 10.0))], now)

    world.control.on_picture = blinded  # type: ignore[method-assign]
    world.run(lambda w: w.named("follow_ended"))
    assert world.named("follow_ended")[0]["reason"] == "lost"
    assert world.time - begun == pytest.approx(4.0, abs=0.5)


def test_pictures_before_the_camera_is_pointed_are_ignored() -> None:
    world = World(count=1)
    name, body, first = "typhoon_h480_0", world[0], world.control.vehicles["typhoon_h480_0"].mission.first_waypoint
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    while body.seq < first:
        world.step()
        if world.state(0) is State.TAKING_OFF:
            place = np.array([body.x, body.y, body.z])
            world.control.on_picture(name, world.time - 0.01, place, level, [Sighting(1, (40.0, 3.0))], world.time)
    assert body.z > 0.8 * world.control.vehicles[name].mission.takeoff_height
    assert (world.control.candidates, world.control.coverage.fraction) == ([], 0.0)
    world.run(lambda w: w.state(0) is State.SEARCHING, limit=world.time + 1.0)


def test_a_path_that_climbs_is_flown() -> None:
    world = World(count=1)
    body = world[0]
    takeoff = [k for k, item in enumerate(body.items) if item.command == plan.TAKEOFF]
    body.items = tuple(replace(item, z=3.0) if k in takeoff else item for k, item in enumerate(body.items))
    world.control.on_mission("typhoon_h480_0", body.items)
    end = _finished(world)
    assert (end["lost"], end["outcome"]) == ([], "not found")


def test_a_vehicle_that_falls_in_a_second_look_is_lost() -> None:
    world = World(things=[person(100.0, 10.0)])
    world.run(lambda w: w.named("second_look"))
    (look,) = world.named("second_look")
    body = world.bodies[look["vehicle"]]
    body.z, body.no_offboard, body.goal = 0.4, True, None
    body.move = lambda target, speed: False  # type: ignore[method-assign]
    end = _finished(world)
    assert world.named("lost_vehicle")[0]["reason"] == "fell to 0.4 m"
    assert (end["outcome"], end["lost"]) == ("found", [look["vehicle"]])


def test_a_path_is_reallocated_once() -> None:
    def vanish(world: World) -> None:
        assert world.state(0) is State.RETURNING
        world[0].dead = True

    world = World(at={30.0: lambda w: setattr(w[0], "no_camera", True), 37.0: vanish})
    end = _finished(world)
    assert [event["vehicle"] for event in world.named("reassigned")] == ["typhoon_h480_0"]
    assert (end["lost"], end["covered_fraction"] > 0.98) == (["typhoon_h480_0"], True)


def test_another_takes_over_when_the_follower_loses_the_person() -> None:
    world = World(things=[person(100.0, 10.0)], follow_time=60.0)
    world.run(lambda w: w.named("following"))
    world.run(lambda w: w.time > w.named("following")[0]["time"] + 10.0)
    finder = world.named("confirmed")[0]["vehicle"]
    body = world.bodies[finder]
    body.no_camera = True
    end = _finished(world)
    first, second = world.named("following")
    assert first["vehicle"] == finder != second["vehicle"]
    assert world.named("second_look")[-1]["takes_over"]
    assert [event["reason"] for event in world.named("follow_ended")] == ["the camera has failed", "time"]
    total = sum(event["duration"] for event in world.named("follow_ended"))
    assert total == pytest.approx(60.0, abs=1.0)
    assert len(world.named("confirmed")) == 1
    assert end["possible"] == []


def test_a_takeover_finds_a_person_that_has_moved_unseen() -> None:
    world = World(things=[person(100.0, 10.0)], follow_time=60.0)
    world.run(lambda w: w.named("following"))
    world.run(lambda w: w.time > w.named("following")[0]["time"] + 5.0)
    finder, blind = world.named("confirmed")[0]["vehicle"], world.time
    world.bodies[finder].no_camera = True
    world.things[0].at = lambda t: (100.0, 10.0 - min(max(1.2 * (t - blind), 0.0), 14.0))
    _finished(world)
    first, second = world.named("following")
    assert first["vehicle"] == finder != second["vehicle"]
    assert math.dist(second["position"], (100.0, -4.0)) < 1.0
    assert [event["reason"] for event in world.named("follow_ended")] == ["the camera has failed", "time"]
    assert not world.named("rejected")


def test_the_follower_looks_again_when_no_other_is_available() -> None:
    hidden = {"now": False}
    hiding = person(100.0, 10.0)
    hiding.probability = lambda distance: 0.0 if hidden["now"] else 0.9
    world = World(count=1, things=[hiding], follow_time=60.0, lose_time=4.0)
    world.run(lambda w: w.named("following"))
    hidden["now"] = True
    world.run(lambda w: w.named("follow_ended"))
    assert world.named("follow_ended")[0]["reason"] == "lost"
    hidden["now"] = False
    end = _finished(world)
    assert [event["takes_over"] for event in world.named("second_look")] == [False, True]
    assert len(world.named("following")) == 2
    assert end["outcome"] == "found"


def test_a_rejected_second_look_loses_the_vehicle_but_not_the_candidate() -> None:
    world = World(things=[person(100.0, 10.0)])
    world.run(lambda w: w.named("candidate"))
    finder = world.named("candidate")[0]["vehicle"]
    world.bodies[finder].no_offboard = True
    end = _finished(world)
    (lost,) = world.named("lost_vehicle")
    assert (lost["vehicle"], lost["reason"]) == (finder, "does not enter OFFBOARD: no setpoints")
    assert end["outcome"] == "found"
    assert end["vehicle"] != finder


def test_the_time_limit_ends_the_search() -> None:
    end = _finished(World(time_limit=20.0))
    assert (end["outcome"], end["reason"]) == ("not found", "the time limit of 20 s is over")
    assert 0.0 < end["covered_fraction"] < 0.9


def test_a_vehicle_that_never_becomes_ready_is_lost_and_the_others_cover_its_part() -> None:
    world = World(start_timeout=20.0)
    world[1].dead = True
    end = _finished(world)
    assert world.named("lost_vehicle")[0]["reason"] == "has no connection after 20 s"
    assert end["covered_fraction"] > 0.98


def test_a_search_is_deterministic() -> None:
    runs = []
    for _ in range(2):
        world = World(things=[person(100.0, 10.0), decoy(50.0, 0.0)], follow_time=5.0)
        world.run()
        runs.append(world.events)
    assert runs[0] == runs[1]


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"on_find": "wait"}, "on_find: 'wait' is not allowed, hold, return or continue"),
        ({"look_speed": 50.0}, "look_speed: 50.0 is not allowed, 0.5 to 10 m/s"),
        ({"reject_log_odds": 1.0}, "reject_log_odds: 1.0 is not allowed, -100 to -1"),
    ],
)
def test_settings_that_are_not_allowed(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(ValueError, match=what.replace(".", r"\.")):
        MissionSettings(**changes)
