"""Each plugin between fake ROS and a UDP socket in the autopilot's place."""

from __future__ import annotations

import math
import threading

import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from mavros_fakes import Bench
from mavros_msgs.msg import AttitudeTarget, HomePosition, Mavlink, PositionTarget, StatusText
from mavros_msgs.srv import (
    CommandBoolRequest,
    CommandIntRequest,
    CommandLongRequest,
    CommandTOLRequest,
    CommandTriggerControlRequest,
    CommandTriggerIntervalRequest,
    SetMavFrameRequest,
    SetModeRequest,
)
from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import NavSatFix, NavSatStatus

from xtdrone_common import frames
from xtdrone_mavros.lib.plugin_settings import ParamError
from xtdrone_mavros.link.autopilot_links import Throttle
from xtdrone_mavros.link.raw_frames import fill
from xtdrone_mavros.plugins import PLUGINS

NAN = float("nan")
ROLL, PITCH, HEADING = 0.1, -0.2, 0.7
RATES_FRD = (0.3, 0.2, -0.1)
Q_NED = frames.quaternion_from_rpy(ROLL, PITCH, HEADING)
# The expected ROS attitude: the same roll, opposite pitch, yaw from east.
Q_ENU = frames.quaternion_from_rpy(ROLL, -PITCH, math.pi / 2 - HEADING)

GEOID = 47.27  # m over the ellipsoid at 47.397742, 8.545594

ATTITUDE = mavlink.MAVLink_attitude_quaternion_message(1000, *Q_NED, *RATES_FRD)
POSITION = mavlink.MAVLink_local_position_ned_message(12345, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0x91, 6 << 16, 4, 3)
HIGHRES = mavlink.MAVLink_highres_imu_message(
    20_004_000, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.2, -0.1, 0.4, 955.0, 1.5, 488.0, 25.0, 0x1FFF
)


@pytest.fixture
def bench():
    made = Bench(PLUGINS)
    yield made
    made.close()


def xyz(message):
    return message.x, message.y, message.z


def wxyz(message):
    return message.w, message.x, message.y, message.z


def same_rotation(a, b):
    return abs(abs(sum(x * y for x, y in zip(a, b, strict=True))) - 1.0) < 1e-6


def approx(values, tolerance=1e-6):
    return pytest.approx(values, abs=tolerance)


class TestLocalPosition:
    """local_position/*."""

    def test_pose(self, bench):
        bench.take("local_position/pose")
        bench.send(ATTITUDE, POSITION)
        [pose] = bench.published("local_position/pose")
        assert pose.header.frame_id == "map"
        assert (pose.header.stamp.secs, pose.header.stamp.nsecs) == (12, 345_000_000)
        assert xyz(pose.pose.position) == (2.0, 1.0, 3.0)
        assert same_rotation(wxyz(pose.pose.orientation), Q_ENU)

    def test_velocities(self, bench):
        bench.take("local_position/velocity_local", "local_position/velocity_body")
        bench.send(ATTITUDE, POSITION)
        [local] = bench.published("local_position/velocity_local")
        [body] = bench.published("local_position/velocity_body")
        assert xyz(local.twist.linear) == (0.25, 0.5, 0.125)
        flu = (0.3, -0.2, 0.1)
        assert xyz(body.twist.angular) == approx(flu)
        assert xyz(local.twist.angular) == approx(frames.rotate(Q_ENU, flu))
        assert frames.rotate(Q_ENU, xyz(body.twist.linear)) == approx((0.25, 0.5, 0.125))
        assert local.header.frame_id == body.header.frame_id == "base_link"

    def test_odom(self, bench):
        bench.take("local_position/odom")
        bench.send(ATTITUDE, POSITION)
        [odom] = bench.published("local_position/odom")
        assert (odom.header.frame_id, odom.child_frame_id) == ("map", "base_link")
        assert xyz(odom.pose.pose.position) == (2.0, 1.0, 3.0)
        assert frames.rotate(Q_ENU, xyz(odom.twist.twist.linear)) == approx((0.25, 0.5, 0.125))

    def test_covariances_follow_the_axes(self, bench):
        bench.take("local_position/pose_cov", "local_position/velocity_body_cov", "local_position/accel")
        covariance = [0.0] * 45
        for value, index in enumerate((0, 9, 17, 24, 30, 35, 39, 42, 44), start=1):
            covariance[index] = float(value)
        values = (1.0, 2.0, -3.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
        bench.send(ATTITUDE, mavlink.MAVLink_local_position_ned_cov_message(5_000_000, 0, *values, covariance))
        [pose] = bench.published("local_position/pose_cov")
        [accel] = bench.published("local_position/accel")
        [twist] = bench.published("local_position/velocity_body_cov")
        diagonal = lambda matrix: (matrix[0], matrix[7], matrix[14])  # noqa: E731
        assert diagonal(pose.pose.covariance) == (2.0, 1.0, 3.0)
        assert diagonal(twist.twist.covariance) == (5.0, 4.0, 6.0)
        assert diagonal(accel.accel.covariance) == (8.0, 7.0, 9.0)
        assert xyz(accel.accel.accel.linear) == approx((0.2, 0.1, -0.3))
        assert pose.header.stamp.to_sec() == 5.0

    def test_nothing_before_the_first_attitude(self, bench):
        bench.take("local_position/pose")
        bench.send(POSITION)
        assert bench.published("local_position/pose") == []

    def test_transform_is_sent_on_request(self):
        bench = Bench(PLUGINS, {"local_position": {"tf": {"send": True, "child_frame_id": "iris_0/base_link"}}})
        bench.ros.publishers["/tf"].connections = 1
        bench.uas.refresh()
        bench.send(ATTITUDE, POSITION)
        [message] = bench.ros.publishers["/tf"].messages
        [transform] = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "iris_0/base_link")
        assert xyz(transform.transform.translation) == (2.0, 1.0, 3.0)
        bench.close()


class TestSettings:
    """Settings by MAVROS's names."""

    def test_global_transform_is_sent_on_request(self):
        settings = {"tf": {"send": True, "frame_id": "earth_map", "child_frame_id": "iris_0/gps"}}
        bench = Bench(PLUGINS, {"global_position": settings})
        bench.ros.publishers["/tf"].connections = 1
        bench.uas.refresh()
        home = mavlink.MAVLink_home_position_message(475000000, 85000000, 480000, 0.0, 0.0, 0.0, Q_NED, 0.0, 0.0, 0.0)
        bench.send(
            ATTITUDE, home, mavlink.MAVLink_global_position_int_message(7000, 475000000, 85000000, 0, 1500, 0, 0, 0, 0)
        )
        [message] = bench.ros.publishers["/tf"].messages
        [transform] = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("earth_map", "iris_0/gps")
        assert xyz(transform.transform.translation) == approx((0.0, 0.0, 1.5))
        assert same_rotation(wxyz(transform.transform.rotation), Q_ENU)
        bench.close()

    def test_heartbeats_have_the_senders_type(self):
        bench = Bench(PLUGINS, {"conn": {"heartbeat_mav_type": "GCS"}})
        bench.uas.step(0)
        assert [m.type for m in bench.received() if m.get_type() == "HEARTBEAT"] == [mavlink.MAV_TYPE_GCS]
        bench.close()

    def test_time_of_day_outside_simulation(self):
        bench = Bench(PLUGINS, {"time": {"timesync_mode": "NONE"}}, use_sim_time=False)
        bench.ros.time_ns = 1_600_000_000_000_000_000
        bench.uas.step(bench.ros.time_ns)
        sent = {m.get_type(): m for m in bench.received()}
        assert sent["SYSTEM_TIME"].time_unix_usec == 1_600_000_000_000_000
        assert "TIMESYNC" not in sent
        bench.close()

    @pytest.mark.parametrize(("group", "name"), [("conn", "heartbeat_mav_type"), ("time", "timesync_mode")])
    def test_invalid_names_are_reported(self, group, name):
        with pytest.raises(ParamError, match=f"{group}/{name}: 'ROUGH'"):
            Bench(PLUGINS, {group: {name: "ROUGH"}})


class TestImu:
    """imu/*."""

    def test_data(self, bench):
        bench.take("imu/data")
        bench.send(HIGHRES, ATTITUDE)
        [data] = bench.published("imu/data")
        assert data.header.frame_id == "base_link"
        assert data.header.stamp.to_sec() == 1.0
        assert same_rotation(wxyz(data.orientation), Q_ENU)
        assert xyz(data.angular_velocity) == approx((0.3, -0.2, 0.1))
        assert xyz(data.linear_acceleration) == approx((0.1, -0.2, 9.8))
        assert data.linear_acceleration_covariance[0] == pytest.approx(9e-8)
        assert data.orientation_covariance[4] == 1.0

    def test_data_without_an_acceleration_is_flagged(self, bench):
        bench.take("imu/data")
        bench.send(ATTITUDE)
        [data] = bench.published("imu/data")
        assert data.linear_acceleration_covariance[0] == -1.0

    def test_sensors(self, bench):
        bench.take("imu/data_raw", "imu/mag", "imu/static_pressure", "imu/diff_pressure", "imu/temperature_imu")
        bench.send(HIGHRES)
        [raw] = bench.published("imu/data_raw")
        assert xyz(raw.angular_velocity) == approx((0.01, -0.02, -0.03))
        assert xyz(raw.linear_acceleration) == approx((0.1, -0.2, 9.8))
        assert raw.orientation_covariance[0] == -1.0
        [mag] = bench.published("imu/mag")
        assert xyz(mag.magnetic_field) == approx((0.2e-4, 0.1e-4, -0.4e-4), 1e-11)
        assert bench.published("imu/static_pressure")[0].fluid_pressure == pytest.approx(955.0)  # hPa
        assert bench.published("imu/diff_pressure")[0].fluid_pressure == pytest.approx(1.5)
        assert bench.published("imu/temperature_imu")[0].temperature == 25.0
        assert raw.header.stamp.to_sec() == 20.004

    def test_unchanged_values_are_not_published(self, bench):
        bench.take("imu/data_raw", "imu/mag", "imu/static_pressure")
        bench.send(mavlink.MAVLink_highres_imu_message(1, *[0.0] * 13, 0x3F))
        assert len(bench.published("imu/data_raw")) == 1
        assert bench.published("imu/mag") == bench.published("imu/static_pressure") == []

    def test_baro_temperature(self, bench):
        bench.take("imu/temperature_baro")
        bench.send(mavlink.MAVLink_scaled_pressure_message(1000, 955.0, 0.0, 2150))
        assert bench.published("imu/temperature_baro")[0].temperature == pytest.approx(21.5)


class TestSysStatus:
    """state, battery, texts, modes."""

    def test_state(self, bench):
        bench.send(HEARTBEAT)
        [state] = bench.published("state")
        assert (state.connected, state.armed, state.mode, state.system_status) == (True, True, "OFFBOARD", 4)
        assert (state.guided, state.manual_input) == (False, False)

    def test_the_missing_connection_is_published_once_before_the_first_heartbeat(self, bench):
        """Publish it as MAVROS does (sys_status.cpp, initialize)."""
        for second in range(3):
            bench.uas.step(second * 10**9)
        [state] = bench.published("state")
        assert (state.connected, state.armed, state.mode, state.system_status) == (False, False, "", 0)
        bench.send(HEARTBEAT)
        bench.uas.step(3 * 10**9)
        assert [state.connected for state in bench.published("state")] == [True]

    def test_connection_is_lost_after_ten_seconds_of_silence(self, bench):
        bench.send(HEARTBEAT)
        bench.published("state")
        bench.ros.time_ns = 10_000_000_000
        bench.uas.step(bench.ros.time_ns)
        assert bench.published("state") == []
        bench.ros.time_ns = 11_000_000_000
        bench.uas.step(bench.ros.time_ns)
        [state] = bench.published("state")
        assert (state.connected, state.armed, state.mode) == (False, False, "")

    def test_heartbeats_of_others_do_not_count(self, bench):
        for system, component in ((2, 1), (1, 190)):
            packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
            bench.send_raw(bytes(HEARTBEAT.pack(packer)))
        assert bench.published("state") == []

    def test_heartbeat_goes_out_once_a_second(self, bench):
        for millis in range(0, 2000, 20):
            bench.uas.step(millis * 1_000_000)
        beats = [m for m in bench.received() if m.get_type() == "HEARTBEAT"]
        assert len(beats) == 2
        assert (beats[0].type, beats[0].get_srcSystem(), beats[0].get_srcComponent()) == (18, 1, 240)

    def test_extended_state(self, bench):
        bench.take("extended_state")
        bench.send(mavlink.MAVLink_extended_sys_state_message(3, 2))
        [state] = bench.published("extended_state")
        assert (state.vtol_state, state.landed_state) == (3, 2)

    def test_battery(self, bench):
        bench.take("battery")
        cells = [4100, 4000, 3900] + [65535] * 7
        bench.send(mavlink.MAVLink_battery_status_message(0, 0, 1, 32767, cells, 1250, -1, -1, 87))
        [battery] = bench.published("battery")
        assert battery.voltage == pytest.approx(12.0)
        assert battery.current == pytest.approx(-12.5)
        assert battery.percentage == pytest.approx(0.87)
        assert battery.cell_voltage == approx([4.1, 4.0, 3.9])
        assert battery.power_supply_technology == battery.POWER_SUPPLY_TECHNOLOGY_LIPO

    @pytest.mark.parametrize(("current", "published"), [(-1, NAN), (-100, 1.0)], ids=["MAVLink's", "PX4's"])
    def test_battery_with_unknown_values(self, bench, current, published):
        """Publish MAVROS's values (sys_status.cpp, handle_battery_status): PX4's "unknown" is -1 A."""
        bench.take("battery")
        bench.send(mavlink.MAVLink_battery_status_message(0, 0, 1, 32767, [65535] * 10, current, -1, -1, -1))
        [battery] = bench.published("battery")
        assert battery.current == pytest.approx(published, nan_ok=True)
        assert (battery.voltage, battery.cell_voltage) == (0.0, [])
        assert battery.percentage == pytest.approx(-0.01)

    @pytest.mark.parametrize(
        ("voltages", "extension", "cells"),
        [
            ([4100, 0, 3900], [], [4.1, 0.0, 3.9]),
            ([65534, 1000, 4000], [], [66.534, 4.0]),
            ([4100, 65535, 3900], [], [4.1]),
            ([4000] * 10, [3900, 0, 3800], [*[4.0] * 10, 3.9]),
            ([*[4000] * 9, 65534], [466], [*[4.0] * 9, 66.0]),
        ],
    )
    def test_cells_are_mavross(self, bench, voltages, extension, cells):
        bench.take("battery")
        fields = [*voltages, *[65535] * 10][:10], 0, -1, -1, 50, 0, 0, [*extension, *[0] * 4][:4]
        bench.send(mavlink.MAVLink_battery_status_message(0, 0, 1, 32767, *fields))
        [battery] = bench.published("battery")
        assert battery.cell_voltage == approx(cells)
        assert battery.voltage == pytest.approx(sum(cells))

    def test_estimator_flags(self, bench):
        bench.take("estimator_status")
        flags = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_GPS_GLITCH
        bench.send(mavlink.MAVLink_estimator_status_message(1, flags, *[0.0] * 8))
        [status] = bench.published("estimator_status")
        assert status.attitude_status_flag
        assert status.gps_glitch_status_flag
        assert not status.pos_horiz_abs_status_flag

    def test_sys_status(self, bench):
        bench.take("sys_status")
        bench.send(mavlink.MAVLink_sys_status_message(1, 2, 3, 400, 12000, -1, 87, 5, 6, 7, 8, 9, 10))
        [status] = bench.published("sys_status")
        assert (status.sensors_health, status.load, status.voltage_battery, status.errors_count4) == (3, 400, 12000, 10)

    def test_texts_both_ways(self, bench, caplog):
        bench.take("statustext/recv")
        bench.send(mavlink.MAVLink_statustext_message(3, b"Arming denied"))
        [text] = bench.published("statustext/recv")
        assert (text.severity, text.text) == (3, "Arming denied")
        assert "iris_0: FCU: Arming denied" in caplog.text
        bench.call("statustext/send", StatusText(severity=6, text="x" * 60))
        [sent] = bench.received()[-1:]
        assert (sent.severity, sent.text) == (6, "x" * 50)

    @pytest.mark.parametrize(
        ("mode", "number"), [("OFFBOARD", 6 << 16), ("AUTO.RTL", 4 << 16 | 5 << 24), ("65536", 65536)]
    )
    def test_set_mode_goes_out(self, bench, mode, number):
        bench.send(HEARTBEAT)
        bench.received()
        response = bench.ros.services["/iris_0/mavros/set_mode"](SetModeRequest(custom_mode=mode))
        assert response.mode_sent
        [sent] = [m for m in bench.received() if m.get_type() == "SET_MODE"]
        assert (sent.target_system, sent.base_mode, sent.custom_mode) == (1, 0x81, number)

    def test_unknown_mode_is_rejected_with_the_list(self, bench, caplog):
        response = bench.ros.services["/iris_0/mavros/set_mode"](SetModeRequest(custom_mode="OFFBORD"))
        assert not response.mode_sent
        assert bench.received() == []
        assert "'OFFBORD'" in caplog.text
        assert "AUTO.TAKEOFF" in caplog.text


class TestGlobalPosition:
    """global_position/* and home."""

    GPS = mavlink.MAVLink_gps_raw_int_message(
        3_000_000, 3, 473977420, 85455940, 488_000, 90, 120, 500, 9000, 11, 535_000, 800, 1500, 200, 0
    )

    def test_raw(self, bench):
        bench.take("global_position/raw/fix", "global_position/raw/gps_vel", "global_position/raw/satellites")
        bench.send(self.GPS)
        [fix] = bench.published("global_position/raw/fix")
        assert (fix.latitude, fix.longitude, fix.altitude) == approx((47.397742, 8.545594, 488.0 + GEOID), 0.05)
        assert (fix.status.status, fix.position_covariance_type) == (0, NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN)
        assert (fix.position_covariance[0], fix.position_covariance[8]) == approx((0.64, 2.25))
        [velocity] = bench.published("global_position/raw/gps_vel")
        assert xyz(velocity.twist.linear) == approx((5.0, 0.0, 0.0))  # course 90 deg: east
        assert bench.published("global_position/raw/satellites")[0].data == 11

    def test_global_has_status_and_accuracy_of_the_receiver(self, bench):
        bench.take("global_position/global", "global_position/rel_alt", "global_position/compass_hdg")
        position = mavlink.MAVLink_global_position_int_message(
            4000, 473977420, 85455940, 490_000, 2_000, 100, 200, -300, 4500
        )
        bench.send(self.GPS, position)
        [fix] = bench.published("global_position/global")
        assert (fix.latitude, fix.altitude, fix.status.status) == approx((47.397742, 490.0 + GEOID, 0), 0.05)
        assert fix.position_covariance[0] == pytest.approx(0.64)
        assert bench.published("global_position/rel_alt")[0].data == 2.0
        assert bench.published("global_position/compass_hdg")[0].data == 45.0

    def test_global_has_no_fix_before_a_receivers_message(self, bench):
        bench.take("global_position/global")
        bench.send(mavlink.MAVLink_global_position_int_message(1000, 473977420, 85455940, 500_000, 0, 0, 0, 0, 0))
        [fix] = bench.published("global_position/global")
        assert (fix.status.status, fix.status.service) == (NavSatStatus.STATUS_NO_FIX, NavSatStatus.SERVICE_GPS)
        assert fix.position_covariance[0] == -1.0

    def test_local_is_relative_to_home(self, bench):
        bench.take("global_position/local")
        home = mavlink.MAVLink_home_position_message(
            473977420, 85455940, 488_000, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0
        )
        position = mavlink.MAVLink_global_position_int_message(
            4000, 473977420 + 1000, 85455940, 490_000, 2_000, 100, 200, -300, 4500
        )
        bench.send(ATTITUDE, home, self.GPS, position)
        [odom] = bench.published("global_position/local")
        assert xyz(odom.pose.pose.position) == approx((0.0, 11.12, 2.0), 0.02)  # 1e-4 deg of latitude
        assert xyz(odom.twist.twist.linear) == approx((2.0, 1.0, 3.0))
        assert same_rotation(wxyz(odom.pose.pose.orientation), Q_ENU)

    def test_home(self, bench):
        message = mavlink.MAVLink_home_position_message(
            473977420, 85455940, 488_000, 1.0, 2.0, -3.0, list(Q_NED), 0.0, 0.0, -1.0, 7_000_000
        )
        bench.send(message)
        [home] = bench.published("home_position/home")
        assert (home.geo.latitude, home.geo.altitude) == approx((47.397742, 488.0 + GEOID), 0.05)
        assert xyz(home.position) == (2.0, 1.0, 3.0)
        assert xyz(home.approach) == (0.0, 0.0, 1.0)
        assert same_rotation(wxyz(home.orientation), Q_ENU)
        assert home.header.stamp.to_sec() == 7.0

    def test_a_missing_home_is_asked_for_every_ten_seconds(self, bench):
        """Ask as MAVROS does (home_position.cpp, timeout_cb)."""

        def asked(until):
            times = []
            for second in range(bench.ros.time_ns // 10**9 + 1, until + 1):
                bench.ros.time_ns = second * 10**9
                bench.send(HEARTBEAT)
                bench.uas.step(bench.ros.time_ns)
                commands = [m.command for m in bench.received() if m.get_type() == "COMMAND_LONG"]
                times += [second] * commands.count(mavlink.MAV_CMD_GET_HOME_POSITION)
            return times

        assert asked(35) == [11, 21, 31]
        bench.send(mavlink.MAVLink_home_position_message(0, 0, 0, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0))
        assert asked(60) == []

    def test_home_is_set_in_the_autopilots_frame(self, bench):
        home = HomePosition()
        home.geo.latitude, home.geo.longitude, home.geo.altitude = 47.397742, 8.545594, 400.0 + GEOID
        home.position.x, home.position.y, home.position.z = 2.0, 1.0, 3.0
        home.orientation.w = 1.0
        bench.call("home_position/set", home)
        [sent] = bench.received()
        assert (sent.latitude, sent.longitude) == (473977420, 85455940)
        assert sent.altitude == pytest.approx(400_000, abs=50)
        assert (sent.x, sent.y, sent.z) == (1.0, 2.0, -3.0)

    @pytest.mark.parametrize("model", ["none", "egm2008"])
    def test_amsl_heights_are_requested_by_name(self, model):
        params = {"global_position": {"geoid": model}}
        if model != "none":
            with pytest.raises(ValueError, match="'egm2008' is not allowed, egm96 and none are"):
                Bench(PLUGINS, params)
            return
        bench = Bench(PLUGINS, params)
        bench.take("global_position/raw/fix")
        bench.send(self.GPS)
        assert bench.published("global_position/raw/fix")[0].altitude == 488.0
        bench.close()


class TestSmallTopics:
    """altitude, vfr_hud, rc/out, time_reference."""

    def test_altitude(self, bench):
        bench.take("altitude")
        bench.send(mavlink.MAVLink_altitude_message(1_000_000, 1.0, 2.0, 3.0, 4.0, NAN, 6.0))
        [altitude] = bench.published("altitude")
        assert (altitude.monotonic, altitude.amsl, altitude.local, altitude.relative) == (1.0, 2.0, 3.0, 4.0)
        assert math.isnan(altitude.terrain)

    def test_hud(self, bench):
        bench.take("vfr_hud")
        bench.send(mavlink.MAVLink_vfr_hud_message(1.0, 2.0, 90, 56, 490.0, 0.5))
        [hud] = bench.published("vfr_hud")
        assert (hud.groundspeed, hud.heading, hud.throttle, hud.climb) == (2.0, 90, 0.56, 0.5)

    def test_servos(self, bench):
        bench.take("rc/out")
        bench.send(mavlink.MAVLink_servo_output_raw_message(1_000_000, 0, *range(1001, 1009), *range(1, 9)))
        [out] = bench.published("rc/out")
        assert list(out.channels) == [*range(1001, 1009), *range(1, 9)]

    def test_time_reference(self, bench):
        bench.take("time_reference")
        bench.send(mavlink.MAVLink_system_time_message(1_700_000_000_500_000, 4000))
        [reference] = bench.published("time_reference")
        assert (reference.time_ref.secs, reference.time_ref.nsecs) == (1_700_000_000, 500_000_000)
        assert reference.header.stamp.to_sec() == 4.0


class TestTime:
    """Stamps outside simulation."""

    def test_offset_is_that_of_timesync(self):
        bench = Bench(PLUGINS, use_sim_time=False)
        bench.take("local_position/pose")
        bench.ros.time_ns = 1_000_000_000_000
        bench.uas.step(bench.ros.time_ns)
        [request] = [m for m in bench.received() if m.get_type() == "TIMESYNC"]
        bench.ros.time_ns += 20_000_000  # the reply took 20 ms, so its time is 10 ms after the request
        bench.send(mavlink.MAVLink_timesync_message(5_000_000_000, request.ts1))
        bench.send(ATTITUDE, POSITION)
        [pose] = bench.published("local_position/pose")
        assert pose.header.stamp.to_nsec() == 1_000_010_000_000 - 5_000_000_000 + 12_345_000_000
        bench.close()

    def test_autopilots_request_is_answered(self):
        bench = Bench(PLUGINS, use_sim_time=False)
        bench.ros.time_ns = 77
        bench.uas.step(77)
        bench.received()
        bench.send(mavlink.MAVLink_timesync_message(0, 1234))
        [answer] = [m for m in bench.received() if m.get_type() == "TIMESYNC"]
        assert (answer.tc1, answer.ts1) == (77, 1234)
        bench.close()


def raw_target(frame, mask):
    target = PositionTarget(coordinate_frame=frame, type_mask=mask, yaw=0.3, yaw_rate=0.4)
    target.header.stamp.secs, target.header.stamp.nsecs = 3, 21_000_000
    target.position.x, target.position.y, target.position.z = 1.0, 2.0, 3.0
    target.velocity.x, target.velocity.y, target.velocity.z = 4.0, 5.0, 6.0
    target.acceleration_or_force.x, target.acceleration_or_force.y, target.acceleration_or_force.z = 7.0, 8.0, 9.0
    return target


class TestSetpoints:
    """ENU and FLU to NED and FRD."""

    @pytest.mark.parametrize(
        ("frame", "position", "velocity", "acceleration", "yaw"),
        [
            (1, (2.0, 1.0, -3.0), (5.0, 4.0, -6.0), (8.0, 7.0, -9.0), math.pi / 2 - 0.3),
            (8, (1.0, -2.0, -3.0), (4.0, -5.0, -6.0), (7.0, -8.0, -9.0), -0.3),
            (9, (1.0, -2.0, -3.0), (4.0, -5.0, -6.0), (7.0, -8.0, -9.0), -0.3),
        ],
    )
    def test_raw_local(self, bench, frame, position, velocity, acceleration, yaw):
        bench.call("setpoint_raw/local", raw_target(frame, 0))
        [sent] = bench.received()
        assert (sent.coordinate_frame, sent.type_mask, sent.time_boot_ms) == (frame, 0, 3021)
        assert (sent.target_system, sent.target_component) == (1, 1)
        assert (sent.x, sent.y, sent.z) == position
        assert (sent.vx, sent.vy, sent.vz) == velocity
        assert (sent.afx, sent.afy, sent.afz) == acceleration
        assert (sent.yaw, sent.yaw_rate) == approx((yaw, -0.4))

    @pytest.mark.parametrize("value", [NAN, math.inf, -math.inf])
    @pytest.mark.parametrize("field", ["velocity.y", "yaw_rate"])
    def test_non_finite_values_are_reported_and_not_forwarded(self, bench, caplog, value, field):
        target = raw_target(1, PositionTarget.IGNORE_PX)
        parent, _, leaf = field.rpartition(".")
        setattr(target.velocity if parent else target, leaf, value)
        bench.call("setpoint_raw/local", target)
        assert bench.received() == []
        assert f"/iris_0/mavros/setpoint_raw/local: {field} is" in caplog.text

    def test_masked_fields_may_be_non_finite(self, bench):
        target = raw_target(1, PositionTarget.IGNORE_PX | PositionTarget.IGNORE_YAW)
        target.position.x = target.yaw = NAN
        bench.call("setpoint_raw/local", target)
        assert len(bench.received()) == 1

    def test_warnings_are_throttled(self, bench, caplog):
        target = raw_target(1, 0)
        target.position.x = NAN
        for _ in range(50):
            bench.call("setpoint_raw/local", target)
        assert caplog.text.count("not forwarded") == 1

    @pytest.mark.parametrize("frame", [3, 7])
    def test_frames_that_the_autopilot_rejects_are_rejected(self, bench, caplog, frame):
        bench.call("setpoint_raw/local", raw_target(frame, 0))
        assert bench.received() == []
        assert f"coordinate_frame {frame} is not allowed, (1, 8, 9) are" in caplog.text

    def test_an_unset_frame_is_local_with_one_warning(self, bench, caplog, monkeypatch):
        monkeypatch.setattr(Throttle, "passes", lambda *_: True)
        for _ in range(3):
            bench.call("setpoint_raw/local", raw_target(0, 0))
        assert [(sent.coordinate_frame, sent.x, sent.y) for sent in bench.received()] == [(1, 2.0, 1.0)] * 3
        assert caplog.text.count("setpoint_raw/local: coordinate_frame is 0, unset; it counts as 1 (LOCAL_NED)") == 1

    def test_raw_attitude(self, bench):
        target = AttitudeTarget(type_mask=7, thrust=0.55)
        q = target.orientation
        q.w, q.x, q.y, q.z = Q_ENU
        target.body_rate.x, target.body_rate.y, target.body_rate.z = 0.1, 0.2, 0.3
        bench.call("setpoint_raw/attitude", target)
        [sent] = bench.received()
        assert same_rotation(sent.q, Q_NED)
        rates = sent.body_roll_rate, sent.body_pitch_rate, sent.body_yaw_rate
        assert rates == approx((0.1, -0.2, -0.3))
        assert (sent.type_mask, sent.thrust) == approx((7, 0.55))

    @pytest.mark.parametrize(("thrust", "sent_thrust"), [(0.4, 0.8), (0.9, 1.0), (-1.0, 0.0)])
    def test_thrust_is_scaled_and_limited(self, thrust, sent_thrust):
        bench = Bench(PLUGINS, {"setpoint_raw": {"thrust_scaling": 2.0}})
        bench.call("setpoint_raw/attitude", AttitudeTarget(type_mask=128, thrust=thrust))
        assert bench.received()[0].thrust == pytest.approx(sent_thrust)
        bench.close()

    def test_position_as_pose(self, bench):
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = 1.0, 2.0, 3.0
        q = pose.pose.orientation
        q.w, q.x, q.y, q.z = frames.quaternion_from_rpy(0.0, 0.0, 0.3)
        bench.call("setpoint_position/local", pose)
        [sent] = bench.received()
        assert (sent.coordinate_frame, sent.type_mask) == (1, 0b1001_1111_1000)
        assert (sent.x, sent.y, sent.z) == (2.0, 1.0, -3.0)
        assert sent.yaw == pytest.approx(math.pi / 2 - 0.3)

    def test_velocity_as_twist(self, bench):
        stamped = TwistStamped()
        stamped.twist.linear.x, stamped.twist.linear.y, stamped.twist.linear.z = 1.0, 2.0, 3.0
        stamped.twist.angular.z = 0.5
        bench.ros.time_ns = 4_000_000_000
        bench.call("setpoint_velocity/cmd_vel", stamped)
        bench.call("setpoint_velocity/cmd_vel_unstamped", stamped.twist)
        first, second = bench.received()
        for sent in (first, second):
            assert (sent.coordinate_frame, sent.type_mask) == (1, 0b0101_1100_0111)
            assert (sent.vx, sent.vy, sent.vz, sent.yaw_rate) == (2.0, 1.0, -3.0, -0.5)
        assert (first.time_boot_ms, second.time_boot_ms) == (0, 4000)

    def test_velocity_frame_is_changed_by_service(self, bench):
        service = bench.ros.services["/iris_0/mavros/setpoint_velocity/mav_frame"]
        assert not service(SetMavFrameRequest(mav_frame=3)).success
        assert service(SetMavFrameRequest(mav_frame=8)).success
        twist = Twist()
        twist.linear.x, twist.linear.y = 1.0, 2.0
        bench.call("setpoint_velocity/cmd_vel_unstamped", twist)
        [sent] = bench.received()
        assert (sent.coordinate_frame, sent.vx, sent.vy) == (8, 1.0, -2.0)

    def test_targets_are_published_in_enu(self, bench):
        bench.take("setpoint_raw/target_local", "setpoint_raw/target_attitude")
        numbers = (2.0, 1.0, -3.0, 5.0, 4.0, -6.0, 8.0, 7.0, -9.0, math.pi / 2 - 0.3, -0.4)
        bench.send(
            mavlink.MAVLink_position_target_local_ned_message(3021, 1, 0, *numbers),
            mavlink.MAVLink_attitude_target_message(3021, 0, list(Q_NED), 0.1, -0.2, -0.3, 0.5),
        )
        [local] = bench.published("setpoint_raw/target_local")
        expected = raw_target(1, 0)
        assert xyz(local.position) == xyz(expected.position)
        assert xyz(local.velocity) == xyz(expected.velocity)
        assert xyz(local.acceleration_or_force) == xyz(expected.acceleration_or_force)
        assert (local.yaw, local.yaw_rate) == approx((0.3, 0.4))
        [attitude] = bench.published("setpoint_raw/target_attitude")
        assert same_rotation(wxyz(attitude.orientation), Q_ENU)
        assert xyz(attitude.body_rate) == approx((0.1, 0.2, 0.3))


class TestCommandServices:
    """Services and acks, with a thread that plays the autopilot."""

    @pytest.fixture
    def answered(self, bench):
        """Return a function that calls a service while the autopilot replies ``result``, and returns its messages."""

        def call(service, request, result):
            got = []

            def autopilot():
                bench.fcu.settimeout(5.0)
                while not got:
                    got.extend(m for m in bench._parser.parse_buffer(bench.fcu.recv(1000)) or [])
                ack = mavlink.MAVLink_command_ack_message(got[0].command, result)
                bench.fcu.sendto(bench.frame(ack), ("127.0.0.1", bench.link.port))
                bench.link.socket.settimeout(5.0)
                bench.link._dispatch(bench.link.socket.recv(1000), 1)

            thread = threading.Thread(target=autopilot)
            thread.start()
            response = bench.ros.services[f"/iris_0/mavros/{service}"](request)
            thread.join()
            return response, got[0]

        return call

    @pytest.mark.parametrize(("result", "success"), [(0, True), (1, False), (4, False)])
    def test_arming(self, answered, result, success):
        response, sent = answered("cmd/arming", CommandBoolRequest(value=True), result)
        assert (response.success, response.result) == (success, result)
        assert (sent.command, sent.param1, sent.target_system, sent.target_component) == (400, 1.0, 1, 1)

    def test_takeoff(self, answered):
        request = CommandTOLRequest(min_pitch=0.1, yaw=90.0, latitude=47.5, longitude=8.5, altitude=500.0)
        response, sent = answered("cmd/takeoff", request, 0)
        assert response.success
        assert (sent.command, sent.param4, sent.param5, sent.param6, sent.param7) == (22, 90.0, 47.5, 8.5, 500.0)

    def test_camera_trigger(self, answered):
        request = CommandTriggerControlRequest(trigger_enable=True, sequence_reset=False, trigger_pause=True)
        response, sent = answered("cmd/trigger_control", request, 3)
        assert (response.success, response.result) == (False, 3)
        assert (sent.command, sent.param1, sent.param2, sent.param3) == (2003, 1.0, 0.0, 1.0)
        request = CommandTriggerIntervalRequest(cycle_time=250.0, integration_time=5.0)
        response, sent = answered("cmd/trigger_interval", request, 0)
        assert response.success
        assert (sent.command, sent.param1, sent.param2) == (214, 250.0, 5.0)


class TestDemand:
    """Only messages of topics with subscribers are decoded and requested."""

    def test_messages_without_a_subscriber_are_not_decoded(self, bench):
        bench.send(HEARTBEAT)
        bench.send(ATTITUDE, POSITION)
        assert bench.link.wanted == {mavlink.MAVLINK_MSG_ID_HEARTBEAT, 253, 242, 42, 46, 49, 410, 118, 120}
        assert bench.link.seen == {31: 1, 32: 1}

    def test_streams_follow_the_subscribers(self, bench):
        bench.send(HEARTBEAT)
        bench.send(ATTITUDE, POSITION)
        bench.received()
        bench.take("local_position/pose")
        asked = {m.param1: m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG"}
        assert asked == {31: 0.0, 32: 0.0}
        bench.ros.publishers["/iris_0/mavros/local_position/pose"].connections = 0
        bench.uas.refresh()
        bench.send(ATTITUDE, POSITION)
        bench.uas.refresh()
        asked = {m.param1: m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG"}
        assert asked == {31: -1.0, 32: -1.0}

    def test_changes_are_noticed_within_half_a_second(self, bench):
        def asked():
            return {m.param1: m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG"}

        bench.send(HEARTBEAT)
        bench.uas.step(0)
        bench.received()
        bench.ros.publishers["/iris_0/mavros/local_position/pose"].connections = 1
        bench.uas.step(480_000_000)
        assert asked() == {}
        bench.uas.step(500_000_000)
        assert asked() == {31: 0.0, 32: 0.0}
        bench.send(mavlink.MAVLink_vfr_hud_message(*[0] * 6))
        bench.uas.step(980_000_000)
        assert asked() == {}
        bench.uas.step(1_000_000_000)
        assert asked() == {74: -1.0}

    @pytest.mark.parametrize("way", ["cmd/command", "broadcast", "cmd/command_int", "mavlink/to"])
    def test_a_rate_set_by_a_users_command_stays(self, bench, way):
        """Leave the stream alone, with and without subscribers, until the autopilot restarts; MAVROS sets no rates."""

        def asked():
            bench.uas.refresh()
            return [m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG" and m.param1 == 105]

        bench.send(HEARTBEAT)
        command, number, interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 105.0, 5000.0
        if way == "mavlink/to":
            frame = mavlink.MAVLink_command_long_message(1, 1, command, 0, number, interval, 0, 0, 0, 0, 0)
            message = Mavlink()
            fill(message, bytes(frame.pack(mavlink.MAVLink(None))))
            bench.ros.subscribers["/iris_0/mavlink/to"](message)
        elif way == "cmd/command_int":
            request = CommandIntRequest(command=command, param1=number, param2=interval)
            bench.ros.services["/iris_0/mavros/cmd/command_int"](request)
        else:
            bench.uas.commands.call = lambda *_, **__: mavlink.MAV_RESULT_ACCEPTED
            request = CommandLongRequest(command=command, param1=number, param2=interval)
            request.broadcast = way == "broadcast"
            bench.ros.services["/iris_0/mavros/cmd/command"](request)
        bench.received()
        bench.take("imu/data_raw")
        assert asked() == []
        bench.ros.publishers["/iris_0/mavros/imu/data_raw"].connections = 0
        bench.send(HIGHRES)
        assert asked() == []
        bench.uas.set_connected(False)
        bench.send(HEARTBEAT, HIGHRES)
        assert asked() == [], "the autopilot keeps its rates while a link is lost"
        bench.uas.on_reboot()
        bench.take("imu/data_raw")
        assert asked() == [0.0]

    def test_streams_are_left_alone_on_request(self):
        bench = Bench(PLUGINS, {"manage_streams": False})
        bench.send(HEARTBEAT)
        bench.send(POSITION)
        bench.take("local_position/pose")
        assert [m for m in bench.received() if m.get_type() == "COMMAND_LONG"] == []
        bench.close()

    def test_bad_crc_is_dropped_with_a_warning(self, bench, caplog):
        bench.take("local_position/pose")
        frame = bytearray(bench.frame(POSITION))
        frame[12] ^= 1
        bench.send(ATTITUDE)
        bench.send_raw(bytes(frame))
        assert bench.published("local_position/pose") == []
        assert "iris_0: MAVLink frame dropped: LOCAL_POSITION_NED: CRC" in caplog.text

    def test_garbage_is_dropped_with_a_warning_and_counted(self, bench, caplog):
        bench.send_raw(b"\x01\x02\x03")
        assert bench.link.malformed == 1
        assert "iris_0: MAVLink datagram of 3 bytes dropped" in caplog.text

    def test_plugins_can_be_disabled(self):
        bench = Bench(PLUGINS, {"plugin_blacklist": ["setpoint_*", "imu"]})
        names = [plugin.name for plugin in bench.uas.plugins]
        assert "imu" not in names
        assert "setpoint_raw" not in names
        assert "local_position" in names
        bench.close()


class TestExternalPoses:
    """vision_pose, mocap and odometry: ENU in ROS, NED to the autopilot."""

    POSE = ((1.0, 2.0, 3.0), Q_ENU)
    # variances and one covariance, x with y; of the rotation only yaw's
    COVARIANCE = (0.1, 0.01, 0, 0, 0, 0, 0.01, 0.2, 0, 0, 0, 0, 0, 0, 0.3, *[0] * 20, 0.6)

    def fill(self, pose):
        (pose.position.x, pose.position.y, pose.position.z), q = self.POSE
        o = pose.orientation
        o.w, o.x, o.y, o.z = q

    def test_vision_pose(self, bench):
        pose = PoseStamped()
        self.fill(pose.pose)
        pose.header.stamp.secs = 7
        bench.call("vision_pose/pose", pose)
        [sent] = bench.received()
        assert sent.get_type() == "VISION_POSITION_ESTIMATE"
        assert (sent.usec, sent.x, sent.y, sent.z) == (7_000_000, 2.0, 1.0, -3.0)
        assert (sent.roll, sent.pitch, sent.yaw) == approx((ROLL, PITCH, HEADING))
        assert sent.covariance == [0.0] * 21

    def test_vision_pose_with_covariance(self, bench):
        pose = PoseWithCovarianceStamped()
        self.fill(pose.pose.pose)
        pose.pose.covariance = self.COVARIANCE
        bench.call("vision_pose/pose_cov", pose)
        [sent] = bench.received()
        variances = [sent.covariance[i] for i in (0, 6, 11, 20)]
        assert variances == approx((0.2, 0.1, 0.3, 0.6))
        assert sent.covariance[1] == pytest.approx(0.01)

    def test_mocap(self, bench):
        pose = PoseStamped()
        self.fill(pose.pose)
        bench.call("mocap/pose", pose)
        [sent] = bench.received()
        assert sent.get_type() == "ATT_POS_MOCAP"
        assert (sent.x, sent.y, sent.z) == (2.0, 1.0, -3.0)
        assert same_rotation(sent.q, Q_NED)

    def test_odometry_out(self, bench):
        odometry = Odometry()
        self.fill(odometry.pose.pose)
        v = odometry.twist.twist.linear
        v.x, v.y, v.z = 0.5, 0.25, 0.125
        odometry.pose.covariance = self.COVARIANCE
        bench.call("odometry/out", odometry)
        [sent] = bench.received()
        assert (sent.frame_id, sent.child_frame_id) == (20, 12)
        assert (sent.x, sent.y, sent.z, sent.vx, sent.vy, sent.vz) == (2.0, 1.0, -3.0, 0.5, -0.25, -0.125)
        assert same_rotation(sent.q, Q_NED)
        assert [sent.pose_covariance[i] for i in (0, 6, 11)] == approx((0.2, 0.1, 0.3))

    def test_odometry_in(self, bench):
        bench.take("odometry/in")
        pose = [0.0] * 21
        pose[0], pose[1], pose[6] = 0.1, 0.01, 0.2
        bench.send(
            mavlink.MAVLink_odometry_message(
                2_000_000, 1, 12, 1.0, 2.0, -3.0, Q_NED, 0.5, 0.25, -0.125, *RATES_FRD, pose, [0.0] * 21, 0, 8, 0
            )
        )
        [got] = bench.published("odometry/in")
        assert xyz(got.pose.pose.position) == (2.0, 1.0, 3.0)
        assert same_rotation(wxyz(got.pose.pose.orientation), Q_ENU)
        assert xyz(got.twist.twist.linear) == (0.5, -0.25, 0.125)
        assert [got.pose.covariance[i] for i in (0, 1, 6, 7)] == approx((0.2, 0.01, 0.01, 0.1))
        assert got.header.frame_id == "map"
