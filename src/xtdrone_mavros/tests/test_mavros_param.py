"""MAVROS's param plugin against an autopilot's parameter service."""

from __future__ import annotations

import pytest
from mavros_msgs.msg import ParamValue
from mavros_msgs.srv import ParamGetRequest, ParamPullRequest, ParamPushRequest, ParamSetRequest
from mavros_pair import Pair

from xtdrone_autopilot.parameters.parameters import NAMES
from xtdrone_mavros.plugins.param import ParamPlugin


@pytest.fixture
def pair():
    pair = Pair(ParamPlugin)
    yield pair
    pair.bench.close()


def test_get(pair):
    answer = pair.call("param/get", ParamGetRequest("MPC_XY_CRUISE"))
    assert (answer.success, answer.value.integer, answer.value.real) == (True, 0, 5.0)
    answer = pair.call("param/get", ParamGetRequest("COM_DL_LOSS_T"))
    assert (answer.success, answer.value.integer, answer.value.real) == (True, 10, 0.0)


def test_unknown_names_fail_at_once(pair, monkeypatch):
    monkeypatch.setattr("xtdrone_mavros.plugins.param._TRY_LIMIT", 1e6)  # the reply does not wait for a timeout
    assert not pair.call("param/get", ParamGetRequest("NO_SUCH")).success
    assert not pair.call("param/get", ParamGetRequest("")).success
    assert not pair.call("param/get", ParamGetRequest("A_NAME_THAT_IS_TOO_LONG")).success
    assert not pair.call("param/set", ParamSetRequest("NO_SUCH", ParamValue(1, 0.0))).success


def test_a_lost_answer_does_not_make_a_name_unknown(pair):
    pair.lost = 1
    assert pair.call("param/get", ParamGetRequest("MPC_XY_CRUISE")).success


def test_former_names_are_explained(pair, caplog):
    assert not pair.call("param/get", ParamGetRequest("EKF2_HGT_MODE")).success
    assert "EKF2_HGT_MODE does not exist: PX4 v1.14 has EKF2_HGT_REF in its place" in caplog.text
    assert not pair.call("param/set", ParamSetRequest("MIS_ALTMODE", ParamValue(1, 0.0))).success
    assert "MIS_ALTMODE does not exist: PX4 v1.11 had it, v1.14 has nothing in its place" in caplog.text
    assert pair.call("param/set", ParamSetRequest("EKF2_AID_MASK", ParamValue(24, 0.0))).success
    assert "EKF2_AID_MASK is out of use: PX4 v1.14 has EKF2_GPS_CTRL, EKF2_EV_CTRL, " in caplog.text


@pytest.mark.parametrize(
    ("name", "value", "stored"),
    [
        ("MPC_XY_CRUISE", ParamValue(0, 7.5), 7.5),
        ("MPC_XY_CRUISE", ParamValue(8, 0.0), 8.0),
        ("COM_DL_LOSS_T", ParamValue(20, 0.0), 20),
        ("RTL_CONE_ANG", ParamValue(0, 0.0), 0),
    ],
)
def test_set_uses_the_parameters_type(pair, name, value, stored):
    answer = pair.call("param/set", ParamSetRequest(name, value))
    assert answer.success
    assert pair.served.parameters.get(name) == stored
    assert stored in (answer.value.integer, answer.value.real)
    assert pair.bench.ros.params[f"/iris_0/mavros/param/{name}"] == stored


def test_set_out_of_the_types_range_fails(pair):
    answer = pair.call("param/set", ParamSetRequest("COM_DL_LOSS_T", ParamValue(1 << 40, 0.0)))
    assert not answer.success
    assert answer.value.integer == 10


def test_pull_mirrors_all(pair):
    answer = pair.call("param/pull", ParamPullRequest(False))
    assert (answer.success, answer.param_received) == (True, len(NAMES))
    mirrored = pair.bench.ros.params["/iris_0/mavros/param"]
    assert sorted(mirrored) == sorted(NAMES)
    assert mirrored["COM_DL_LOSS_T"] == 10
    pair.served.parameters.set("COM_DL_LOSS_T", 11)
    pair.call("param/pull", ParamPullRequest(False))
    assert pair.bench.ros.params["/iris_0/mavros/param"]["COM_DL_LOSS_T"] == 10, "known already"
    pair.call("param/pull", ParamPullRequest(True))
    assert pair.bench.ros.params["/iris_0/mavros/param"]["COM_DL_LOSS_T"] == 11


def test_pull_over_a_lossy_line(pair, monkeypatch):
    monkeypatch.setattr("xtdrone_mavros.plugins.param._TRY_LIMIT", 0.1)
    pair.lost = 30
    answer = pair.call("param/pull", ParamPullRequest(True))
    assert (answer.success, answer.param_received) == (True, len(NAMES))


def test_push_writes_changed_parameters(pair):
    pair.call("param/pull", ParamPullRequest(True))
    pair.bench.ros.params["/iris_0/mavros/param"]["MPC_XY_CRUISE"] = 6.5
    pair.bench.ros.params["/iris_0/mavros/param"]["NOBODYS"] = 1
    answer = pair.call("param/push", ParamPushRequest())
    assert (answer.success, answer.param_transfered) == (True, len(NAMES)), "MAVROS counts the unchanged ones, too"
    assert pair.served.parameters.get("MPC_XY_CRUISE") == 6.5


def test_values_are_published(pair):
    pair.bench.take("param/param_value")
    pair.call("param/get", ParamGetRequest("MPC_XY_CRUISE"))
    (message,) = pair.bench.published("param/param_value")
    assert (message.param_id, message.value.real, message.param_count) == ("MPC_XY_CRUISE", 5.0, len(NAMES))


@pytest.mark.parametrize("subscribed", [True, False])
def test_all_are_published_ten_seconds_after_the_connection(pair, subscribed):
    """Publish them as MAVROS does (param.cpp, shedule_cb), which costs nothing without a subscriber."""
    if subscribed:
        pair.bench.take("param/param_value")
    pair.bench.uas.step(0)
    pair.bench.uas.set_connected(True)
    names = []
    for second in range(1, 21):
        pair.bench.uas.step(second * 10**9)
        for _ in range(20):
            pair.turn()
        if second == 9:
            assert pair.bench.published("param/param_value") == []
    names = {message.param_id for message in pair.bench.published("param/param_value")}
    assert names == (set(NAMES) if subscribed else set())


def test_a_value_of_the_wrong_type_is_named(pair, caplog):
    pair.call("param/set", ParamSetRequest("MPC_XY_CRUISE", ParamValue(8, 0.0)))
    assert "MPC_XY_CRUISE is given as an integer, which a real PX4 rejects: use value.real" in caplog.text
    pair.call("param/set", ParamSetRequest("COM_DL_LOSS_T", ParamValue(0, 20.0)))
    assert "COM_DL_LOSS_T is given as a real number, which a real PX4 rejects: use value.integer" in caplog.text
