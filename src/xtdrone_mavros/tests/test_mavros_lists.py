"""Loaded plugins, and reports of topics and services without a counterpart."""

from __future__ import annotations

import pytest
from mavros_fakes import Bench

from xtdrone_common.fleet import FleetError
from xtdrone_mavros.lib.plugin_settings import ParamError, Params, PluginLists
from xtdrone_mavros.mavros_node import connections
from xtdrone_mavros.plugins import PLUGINS
from xtdrone_mavros.unsubscribed_topics import GraphWatch, LeftOut

NAMES = ["sys_status", "sys_time", "setpoint_raw", "setpoint_velocity", "imu"]


@pytest.mark.parametrize(
    ("settings", "loaded"),
    [
        ({}, NAMES),
        ({"plugin_denylist": ["setpoint_*"]}, ["sys_status", "sys_time", "imu"]),
        ({"plugin_blacklist": ["SETPOINT_*", "imu"]}, ["sys_status", "sys_time"]),
        ({"plugin_allowlist": ["sys_*"]}, ["sys_status", "sys_time"]),
        ({"plugin_denylist": ["*"], "plugin_whitelist": ["imu"]}, ["imu"]),
        ({"plugin_denylist": ["setpoint_*"], "plugin_allowlist": ["setpoint_ra?"]}, [*NAMES[:3], "imu"]),
        ({"plugin_denylist": ["i[lm]u"], "plugin_blacklist": ["*_time"]}, ["sys_status", *NAMES[2:4]]),
    ],
)
def test_lists_as_mavros_evaluates_them(settings, loaded):
    lists = PluginLists(Params(settings))
    assert [name for name in NAMES if lists.loads(name)] == loaded


def test_patterns_without_an_effect_are_complained_of():
    settings = {"plugin_denylist": ["imu_pub", "px4flow", "imu"], "plugin_whitelist": ["px4*", "setpoint_*"]}
    complaints = list(PluginLists(Params(settings)).complaints(NAMES, {"px4flow": "has none"}))
    assert complaints == [
        "plugin_denylist: no plugin matches 'imu_pub'",
        "plugin_whitelist: 'px4*' is not offered here (px4flow: has none)",
    ]


def test_a_pattern_that_is_not_a_text_is_reported():
    with pytest.raises(ParamError, match="plugin_denylist: 3 is not a pattern"):
        PluginLists(Params({"plugin_denylist": [3]}))


def test_features_of_the_node_itself_are_not_listed():
    bench = Bench(PLUGINS, {"plugin_allowlist": ["imu"]})
    assert {plugin.name for plugin in bench.uas.plugins if plugin.listed} == {"imu"}
    assert "/iris_0/mavlink/to" in bench.ros.subscribers
    bench.close()


class TestWatch:
    """Publishers without a subscriber here."""

    OWN = "/mavros"
    SUBSCRIBERS = {"/iris_0/mavros/setpoint_raw/local": [OWN], "/iris_1/mavros/setpoint_raw/local": [OWN]}  # noqa: RUF012

    def watch(self, publishers, subscribers=None):
        left_out = {"setpoint_accel/accel": LeftOut("not yet", "setpoint_raw/local")}
        state = publishers, self.SUBSCRIBERS | (subscribers or {})
        return GraphWatch(self.OWN, ["/iris_0/mavros", "/iris_1/mavros"], left_out, lambda: state, ["iris_0", "iris_1"])

    def test_a_skipped_topic_is_reported_once(self, caplog):
        watch = self.watch({"/iris_1/mavros/setpoint_accel/accel": ["/leader"]})
        watch.check()
        watch.check()
        assert [record.getMessage() for record in caplog.records] == [
            "/iris_1/mavros/setpoint_accel/accel, on which /leader publishes, is not supported here: not yet; "
            "use setpoint_raw/local"
        ]

    @pytest.mark.parametrize(
        ("topic", "said"),
        [
            ("/iris_0/mavros/setpoint_raw/locl", "has no subscriber; is /iris_0/mavros/setpoint_raw/local meant?"),
            ("/mavros/setpoint_raw/local", "belongs to no vehicle"),
            ("/iris_0/mavros/gps_input/gps_input", "no loaded plugin subscribes to it; plugin_denylist may exclude"),
            ("/iris_0/setpoint_accel/accel", None),
            ("/xtdrone/iris_1/cmd", "has no subscriber: XTDrone's commands need the vehicle's communication node: "
             "rosrun xtdrone_control multirotor_communication.py iris 1"),
            ("/xtdrone/iris_0/cmd_accel_flu", "multirotor_communication.py iris 0"),
            ("/xtdrone/iris_2/cmd", None),
            ("/xtdrone/iris_0/avoid_vel", None),
            ("/iris_0/mavros/setpoint_raw/local", None),
        ],
    )  # fmt: skip
    def test_suspicious_topics_are_reported(self, caplog, topic, said):
        self.watch({topic: ["/leader"]}).check()
        if said is None:
            assert caplog.text == ""
        else:
            assert said in caplog.text

    def test_topics_with_other_ends_are_theirs(self, caplog):
        here = {
            "/iris_0/mavros/setpoint_raw/locl": ["/leader"],
            "/iris_0/mavros/setpoint_accel/accel": [self.OWN],
            "/xtdrone/iris_0/cmd": ["/keys"],
        }
        others = {"/iris_0/mavros/setpoint_raw/locl": ["/viewer"], "/xtdrone/iris_0/cmd": ["/iris_0_communication"]}
        self.watch(here, others).check()
        assert caplog.text == ""

    def test_commands_that_a_leader_relays_are_lost_only_if_it_receives_some(self, caplog):
        relayed, received = {"/xtdrone/iris_0/cmd": ["/leader"]}, {"/xtdrone/leader/cmd": ["/leader"]}
        self.watch(relayed, received).check()
        assert caplog.text == ""
        self.watch({**relayed, "/xtdrone/leader/cmd": ["/keys"]}, received).check()
        assert "/xtdrone/iris_0/cmd, on which /leader publishes, has no subscriber" in caplog.text


def test_a_node_serves_one_vehicle_of_the_fleet():
    (only,) = connections({"vehicle": "typhoon_h480_0"}, "iris:2,typhoon_h480:1", "/typhoon_h480_0/mavros")
    assert (only.prefix, only.url.bind_port, only.target) == ("/typhoon_h480_0/mavros", 24542, (3, 1))
    with pytest.raises(FleetError, match="vehicle: 'iris_2' is not in the fleet, iris_0 to iris_1"):
        connections({"vehicle": "iris_2"}, "iris:2", "/iris_2/mavros")


def test_the_target_has_mavros_names():
    (link,) = connections({"fcu_url": "udp://:1@", "target_system_id": 7, "tgt_component": 2}, "", "/mavros")
    assert link.target == (7, 2)
