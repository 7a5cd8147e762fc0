"""MAVROS's waypoint, geofence and rallypoint against this project's MAVLink server, over real UDP sockets."""

from __future__ import annotations

import math
import threading

import pytest
from autopilot_fakes import FIRST_ID, Flight
from mavros_fakes import FakeRos
from mavros_msgs.msg import Waypoint
from mavros_msgs.srv import WaypointClearRequest, WaypointPullRequest, WaypointPushRequest, WaypointSetCurrentRequest

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_common import modes
from xtdrone_common.fleet import Vehicle
from xtdrone_mavros.lib.plugin_settings import Params
from xtdrone_mavros.link import plan_transfers
from xtdrone_mavros.link.autopilot_links import AutopilotLink, AutopilotReceiver, FcuUrl
from xtdrone_mavros.plugins.waypoint import GeofencePlugin, RallypointPlugin, WaypointPlugin
from xtdrone_mavros.uas import Uas

_SYSTEM = FIRST_ID + 1
_PREFIX = "/iris_0/mavros"


class Layer:
    """A vehicle that is always at its setpoint, its MAVLink server in a thread, and a MAVROS hub with three plugins."""

    def __init__(self) -> None:
        self.flight = Flight(MAV_SYS_ID=_SYSTEM)
        vehicle = Vehicle("iris", 0, FIRST_ID)
        self.server = MavlinkServer([vehicle], self.flight.autopilot, [self.flight.commander])
        ends = FcuUrl("127.0.0.1", vehicle.offboard_remote_port, "127.0.0.1", vehicle.offboard_local_port)
        self.link = AutopilotLink("iris_0", ends, target=(_SYSTEM, 1))
        self.ros = FakeRos()
        plugins = (WaypointPlugin, GeofencePlugin, RallypointPlugin)
        self.uas = Uas("iris_0", _PREFIX, self.link, Params({}), self.ros, plugins)
        self.receiver = AutopilotReceiver([self.link])
        self.receiver.start()
        self.serving = True
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self) -> None:
        while self.serving:
            self.server.receive(0.02)

    def stop_serving(self) -> None:
        """Silence the autopilot; then the test may step it."""
        self.serving = False
        self.thread.join()

    def call(self, name, request):
        return self.ros.services[f"{_PREFIX}/{name}"](request)

    def step(self, seconds=0.2):
        """Advance simulated time, after ``stop_serving``."""
        for _ in range(round(seconds * 10)):
            self.ros.time_ns += 100_000_000
            self.flight.autopilot.time_us += 100_000
            self.flight.follow()
            self.flight.commander.update()
            self.server.send_streams(self.flight.autopilot.time_us)
            self.link.read()
            self.uas.receive(self.ros.time_ns)
            self.uas.step(self.ros.time_ns)

    def published(self, topic):
        publisher = self.ros.publishers[f"{_PREFIX}/{topic}"]
        messages, publisher.messages = publisher.messages, []
        return messages

    def close(self):
        self.stop_serving()
        self.receiver.stop()
        self.server.close()


@pytest.fixture
def layer():
    layer = Layer()
    yield layer
    layer.close()


def waypoint(north=0, command=16, frame=3, **fields):
    place = {"x_lat": 47.397742 + north * 1e-5, "y_long": 8.545594, "z_alt": 10.0}
    return Waypoint(frame=frame, command=command, autocontinue=True, **place, **fields)


MISSION = [waypoint(0, 22), waypoint(10, param1=1.0), waypoint(20)]


def test_push_and_pull(layer):
    answer = layer.call("mission/push", WaypointPushRequest(waypoints=MISSION))
    assert (answer.success, answer.wp_transfered) == (True, 3)
    stored = layer.flight.commander.navigator.plans.mission
    assert [(item.command, item.relative) for item in stored] == [(22, True), (16, True), (16, True)]
    assert stored[1].x == pytest.approx(MISSION[1].x_lat, abs=1e-7)
    answer = layer.call("mission/pull", WaypointPullRequest())
    assert (answer.success, answer.wp_received) == (True, 3)
    layer.stop_serving()
    layer.step()
    shown = layer.published("mission/waypoints")[-1]
    assert [w.command for w in shown.waypoints] == [22, 16, 16]
    assert [w.is_current for w in shown.waypoints] == [True, False, False]
    assert shown.waypoints[1].x_lat == pytest.approx(MISSION[1].x_lat, abs=1e-7)
    assert shown.waypoints[1].param1 == 1.0


def test_what_is_pulled_and_pushed_again_is_the_same_in_the_vehicle(layer):
    nan = math.nan
    jump = Waypoint(frame=2, command=177, autocontinue=True, param1=0.0, param2=-1.0)
    items = [
        waypoint(0, 22, param1=15.0, param4=nan),
        waypoint(10, 16, 0, param1=2.5, param2=3.0, param4=-90.0),
        waypoint(20, 31, param1=1.0, param2=-40.0),
        Waypoint(frame=2, command=93, autocontinue=True, param1=10.0),
        jump,
        waypoint(30, 21, param2=1.9, param4=nan),
    ]
    assert layer.call("mission/push", WaypointPushRequest(waypoints=items)).success
    navigator = layer.flight.commander.navigator
    flown = navigator.plans.mission
    assert [flown[4].params[1], flown[5].params[1]] == [65535.0, 1.0]
    pulled = layer.uas.plans.pull(0)
    assert layer.call("mission/push", WaypointPushRequest(waypoints=pulled)).success
    again = navigator.plans.mission
    assert [item.params[0] for item in again] == [0.0, 2.5, 1.0, 10.0, 0.0, 0.0]  # a takeoff's pitch is not stored
    for before, after in zip(flown, again, strict=True):
        assert (before.command, before.relative, before.z) == (after.command, after.relative, after.z)
        assert (before.x, before.y) == pytest.approx((after.x, after.y), abs=1e-9)
        assert before.time_inside == after.time_inside
        assert math.cos(before.yaw) == pytest.approx(math.cos(after.yaw), abs=1e-6, nan_ok=True)
    assert repr(layer.uas.plans.pull(0)) == repr(pulled)


def test_a_rejected_item_reports_the_progress(layer):
    bad = [*MISSION[:2], waypoint(20, 9999), waypoint(30)]
    answer = layer.call("mission/push", WaypointPushRequest(waypoints=bad))
    assert (answer.success, answer.wp_transfered) == (False, 3)
    answer = layer.call("mission/pull", WaypointPullRequest())
    assert (answer.success, answer.wp_received) == (True, 0)


def test_part_of_a_list_cannot_be_pushed(layer):
    answer = layer.call("mission/push", WaypointPushRequest(start_index=1, waypoints=MISSION))
    assert (answer.success, answer.wp_transfered) == (False, 0)


def test_clear_and_empty_push(layer):
    layer.call("mission/push", WaypointPushRequest(waypoints=MISSION))
    assert layer.call("mission/clear", WaypointClearRequest()).success
    assert layer.flight.commander.navigator.plans.mission == ()
    answer = layer.call("mission/push", WaypointPushRequest(waypoints=[]))
    assert (answer.success, answer.wp_transfered) == (True, 0)


def test_set_current(layer, monkeypatch):
    layer.call("mission/push", WaypointPushRequest(waypoints=MISSION))
    assert layer.call("mission/set_current", WaypointSetCurrentRequest(wp_seq=2)).success
    assert layer.flight.commander.navigator.plans.current == 2
    monkeypatch.setattr(plan_transfers, "LIMIT", 0.02)
    assert not layer.call("mission/set_current", WaypointSetCurrentRequest(wp_seq=7)).success
    layer.stop_serving()
    layer.step()
    assert [w.is_current for w in layer.published("mission/waypoints")[-1].waypoints] == [False, False, True]


def test_geofence_and_rally_points(layer):
    fence = [waypoint(n, 5001, param1=3.0) for n in (0, 100, 200)]
    assert layer.call("geofence/push", WaypointPushRequest(waypoints=fence)).success
    assert layer.call("rallypoint/push", WaypointPushRequest(waypoints=[waypoint(50, 5100)])).success
    assert [len(items) for items in layer.flight.commander.navigator.plans.items] == [0, 3, 1]
    assert layer.call("geofence/pull", WaypointPullRequest()).wp_received == 3
    assert layer.call("rallypoint/clear", WaypointClearRequest()).success
    layer.stop_serving()
    layer.step()
    assert len(layer.published("geofence/waypoints")[-1].waypoints) == 3
    assert layer.published("rallypoint/waypoints")[-1].waypoints == []
    assert layer.published("mission/waypoints") == []


def test_reached_waypoints_are_published(layer):
    layer.call("mission/push", WaypointPushRequest(waypoints=[waypoint(0, 22), waypoint(2), waypoint(4)]))
    layer.stop_serving()
    assert layer.flight.commander.request(modes.AUTO_MISSION) == 0
    assert layer.flight.commander.arm_disarm(True) == 0
    layer.step(2.0)
    assert list(dict.fromkeys(m.wp_seq for m in layer.published("mission/reached"))) == [0, 1, 2]
    currents = [message.current_seq for message in layer.published("mission/waypoints")]
    assert currents == [0, 1, 2]


def test_an_autopilot_that_does_not_answer(layer, monkeypatch):
    layer.stop_serving()
    monkeypatch.setattr(plan_transfers, "LIMIT", 0.02)
    assert not layer.call("mission/pull", WaypointPullRequest()).success
    answer = layer.call("mission/push", WaypointPushRequest(waypoints=MISSION))
    assert (answer.success, answer.wp_transfered) == (False, 0)
    assert not layer.call("mission/clear", WaypointClearRequest()).success


class TestFirstPull:
    """The lists are fetched 15 s after the connection, as MAVROS does (mission_protocol_base.h, scheduled_pull_cb)."""

    TOPICS = ("mission/waypoints", "geofence/waypoints", "rallypoint/waypoints")

    def connect(self, layer):
        layer.stop_serving()
        layer.step(0.1)
        layer.uas.set_connected(True)

    def fly(self, layer, seconds):
        for _ in range(round(seconds * 10)):
            layer.server.receive(0.0)
            layer.step(0.1)

    def test_empty_lists_are_published(self, layer):
        self.connect(layer)
        self.fly(layer, 14.8)
        assert [layer.published(topic) for topic in self.TOPICS] == [[], [], []]
        self.fly(layer, 3.0)
        assert [[m.waypoints for m in layer.published(topic)] for topic in self.TOPICS] == [[[]], [[]], [[]]]
        self.fly(layer, 20.0)
        assert [layer.published(topic) for topic in self.TOPICS] == [[], [], []], "once"

    def test_what_another_program_has_uploaded_is_published(self, layer):
        fence = [waypoint(n, 5001, param1=3.0) for n in (0, 100, 200)]
        layer.call("mission/push", WaypointPushRequest(waypoints=MISSION))
        layer.call("geofence/push", WaypointPushRequest(waypoints=fence))
        self.connect(layer)
        assert [layer.published(topic) for topic in self.TOPICS[2:]] == [[]]
        layer.published("mission/waypoints")
        self.fly(layer, 20.0)
        [mission] = layer.published("mission/waypoints")
        assert [w.command for w in mission.waypoints] == [22, 16, 16]
        assert len(layer.published("geofence/waypoints")[-1].waypoints) == 3

    def test_lost_answers_are_asked_for_again_and_a_silent_autopilot_is_named(self, layer, caplog):
        self.connect(layer)
        layer.step(15.0)
        layer.server.receive(0.0)  # the request is answered after a second without an answer
        self.fly(layer, 4.0)
        assert len(layer.published("mission/waypoints")) == 1
        layer.uas.set_connected(False)
        layer.uas.set_connected(True)
        layer.link.send = lambda *_: None
        layer.step(40.0)
        for space in ("mission", "geofence", "rallypoint"):
            assert f"the autopilot does not send the list of {space}/waypoints" in caplog.text

    def test_a_service_waits_for_it_and_a_lost_connection_ends_it(self, layer):
        self.connect(layer)
        layer.step(15.1)
        answers = []
        thread = threading.Thread(target=lambda: answers.append(layer.call("mission/pull", WaypointPullRequest())))
        thread.start()
        layer.uas.set_connected(False)
        while thread.is_alive():
            layer.server.receive(0.01)
            thread.join(0.001)
        assert answers[0].success
