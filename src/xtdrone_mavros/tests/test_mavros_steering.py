"""The plugins that steer, between fake ROS and a UDP socket in the autopilot's place; see ``test_mavros_plugins``."""

from __future__ import annotations

import math
from contextlib import contextmanager

import pytest
import rospy
from geographic_msgs.msg import GeoPoseStamped
from geometry_msgs.msg import (
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
    Vector3Stamped,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mavros_fakes import Bench
from mavros_msgs.msg import ActuatorControl, GlobalPositionTarget, ManualControl, OverrideRCIn, Thrust, Trajectory
from mavros_msgs.srv import SetMavFrameRequest
from nav_msgs.msg import Path
from pymavlink.dialects.v20 import common as mavlink
from std_srvs.srv import TriggerRequest
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from xtdrone_common import frames
from xtdrone_mavros.plugins import PLUGINS

NAN = float("nan")
MILLISECOND = 1_000_000
LATITUDE, LONGITUDE, ALTITUDE = 47.397742, 8.545594, 488.0
NUMBERS = st.floats(-1e4, 1e4, width=32)
THREE = st.tuples(*[NUMBERS] * 3)
ANGLES = st.floats(-3.1, 3.1)
QUATERNION = {"setpoint_attitude": {"use_quaternion": True}}


@contextmanager
def opened(params=None):
    made = Bench(PLUGINS, {"global_position": {"geoid": "none"}} | (params or {}))
    yield made
    made.close()


@pytest.fixture
def bench():
    with opened() as made:
        yield made


def approx(values, tolerance=1e-6):
    return pytest.approx(values, abs=tolerance)


def xyz(message):
    return message.x, message.y, message.z


def fill(message, values, axes="xyz"):
    for axis, value in zip(axes, values, strict=True):
        setattr(message, axis, value)
    return message


def turned(roll, pitch, yaw):
    """Return the ROS quaternion of roll, pitch and yaw, rad."""
    return fill(Quaternion(), frames.quaternion_from_rpy(roll, pitch, yaw), "wxyz")


def stamped(message, millis):
    message.header.stamp.secs, rest = divmod(millis, 1000)
    message.header.stamp.nsecs = rest * MILLISECOND
    return message


def refused(bench, caplog, topic, message, field):
    """Return whether a message is not forwarded, with a warning that names its topic and field."""
    bench.call(topic, message)
    return bench.received() == [] and f"{topic}: {field}" in caplog.text


class TestAttitude:
    """setpoint_attitude."""

    def attitude(self, millis, *angles):
        pose = stamped(PoseStamped(), millis)
        pose.pose.orientation = turned(*angles)
        return pose

    def test_attitude_and_thrust_of_one_stamp(self):
        with opened(QUATERNION) as bench:
            bench.call("setpoint_attitude/attitude", self.attitude(3021, 0.1, 0.2, 0.3))
            assert bench.received() == []
            bench.call("setpoint_attitude/thrust", stamped(Thrust(thrust=0.55), 3021))
            [sent] = bench.received()
        assert (sent.get_type(), sent.type_mask, sent.time_boot_ms) == ("SET_ATTITUDE_TARGET", 0b111, 3021)
        assert (sent.target_system, sent.target_component) == (1, 1)
        assert sent.thrust == pytest.approx(0.55)
        # roll stays, nose down (+ in FLU) is - in FRD, yaw counts from north
        assert frames.rpy_from_quaternion(sent.q) == approx((0.1, -0.2, math.pi / 2 - 0.3))

    def test_an_attitude_of_any_length_is_one(self):
        with opened(QUATERNION) as bench:
            pose = self.attitude(0, 0.0, 0.0, 0.0)
            pose.pose.orientation.w = 3.0
            bench.call("setpoint_attitude/attitude", pose)
            bench.call("setpoint_attitude/thrust", Thrust(thrust=0.5))
            [sent] = bench.received()
        assert sent.q == approx([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])

    def test_body_rates(self, bench):
        twist = stamped(TwistStamped(), 40)
        fill(twist.twist.angular, (0.1, 0.2, 0.3))
        bench.call("setpoint_attitude/cmd_vel", twist)
        bench.call("setpoint_attitude/thrust", stamped(Thrust(thrust=0.25), 40))
        [sent] = bench.received()
        assert (sent.type_mask, sent.thrust, sent.time_boot_ms) == (0b1000_0000, 0.25, 40)
        assert (sent.body_roll_rate, sent.body_pitch_rate, sent.body_yaw_rate) == approx((0.1, -0.2, -0.3))

    def test_the_setting_selects_the_topic(self, bench):
        assert "/iris_0/mavros/setpoint_attitude/attitude" not in bench.ros.subscribers
        with opened(QUATERNION) as other:
            assert "/iris_0/mavros/setpoint_attitude/cmd_vel" not in other.ros.subscribers

    @pytest.mark.parametrize(
        ("reverse", "thrust", "passes"),
        [(False, 0.0, True), (False, 1.0, True), (False, -0.1, False), (True, -1.0, True), (True, -1.1, False),
         (True, 1.1, False), (False, NAN, False)],
    )  # fmt: skip
    def test_thrust_has_a_range(self, caplog, reverse, thrust, passes):
        with opened({"setpoint_attitude": {"reverse_thrust": reverse}}) as bench:
            bench.call("setpoint_attitude/cmd_vel", TwistStamped())
            bench.call("setpoint_attitude/thrust", Thrust(thrust=thrust))
            assert [m.thrust for m in bench.received()] == ([thrust] if passes else [])
        assert ("setpoint_attitude/thrust: thrust is" in caplog.text) != passes

    @pytest.mark.parametrize("thrust_lag", [-3, 3])
    def test_each_attitude_goes_with_the_nearest_thrust(self, thrust_lag):
        """Attitudes are 20 ms apart, stamps of thrusts 3 ms before or after: each pair but the last is sent."""
        with opened(QUATERNION) as bench:
            for index in range(6):
                bench.call("setpoint_attitude/attitude", self.attitude(100 + 20 * index, 0.0, 0.0, 0.0))
                lagging = stamped(Thrust(thrust=0.1 * index), 100 + 20 * index + thrust_lag)
                bench.call("setpoint_attitude/thrust", lagging)
            sent = bench.received()
        assert [m.time_boot_ms for m in sent] == [100, 120, 140, 160, 180]
        assert [m.thrust for m in sent] == approx([0.0, 0.1, 0.2, 0.3, 0.4])

    def test_queued_messages_are_dropped_with_the_vehicle(self, bench):
        bench.call("setpoint_attitude/cmd_vel", TwistStamped())
        for plugin in bench.uas.plugins:
            plugin.connected(False)
        bench.call("setpoint_attitude/thrust", Thrust())
        assert bench.received() == []

    def test_nan_is_not_forwarded(self, caplog):
        with opened(QUATERNION) as bench:
            pose = self.attitude(0, 0.0, 0.0, 0.0)
            pose.pose.orientation.x = math.inf
            bench.call("setpoint_attitude/thrust", Thrust())
            assert refused(bench, caplog, "setpoint_attitude/attitude", pose, "pose.orientation.x is inf")

    def test_a_zero_rotation_is_not_forwarded(self, caplog):
        with opened(QUATERNION) as bench:
            bench.call("setpoint_attitude/thrust", Thrust())
            assert refused(
                bench,
                caplog,
                "setpoint_attitude/attitude",
                PoseStamped(),
                "pose.orientation is zero, which is not an attitude",
            )

    def test_there_and_back(self):
        """The sent rotation equals the autopilot's target."""
        with opened(QUATERNION) as bench:
            bench.take("setpoint_raw/target_attitude")

            @settings(max_examples=50, deadline=None)
            @given(ANGLES, st.floats(-1.5, 1.5), ANGLES, st.floats(0.0, 1.0, width=32))
            def law(roll, pitch, yaw, thrust):
                bench.call("setpoint_attitude/attitude", self.attitude(0, roll, pitch, yaw))
                bench.call("setpoint_attitude/thrust", Thrust(thrust=thrust))
                [sent] = bench.received()
                bench.send(mavlink.MAVLink_attitude_target_message(0, 0, sent.q, 0.0, 0.0, 0.0, sent.thrust))
                [back] = bench.published("setpoint_raw/target_attitude")
                q = back.orientation
                product = sum(
                    a * b for a, b in zip((q.w, *xyz(q)), frames.quaternion_from_rpy(roll, pitch, yaw), strict=True)
                )
                assert abs(product) == pytest.approx(1.0)
                assert back.thrust == thrust

            law()


class TestAcceleration:
    """setpoint_accel."""

    @pytest.mark.parametrize(("force", "mask"), [(False, 0b1100_0011_1111), (True, 0b1110_0011_1111)])
    def test_acceleration_or_force(self, force, mask):
        with opened({"setpoint_accel": {"send_force": force}}) as bench:
            message = stamped(Vector3Stamped(), 1500)
            fill(message.vector, (1.0, 2.0, 3.0))
            bench.call("setpoint_accel/accel", message)
            [sent] = bench.received()
        assert (sent.coordinate_frame, sent.type_mask, sent.time_boot_ms) == (1, mask, 1500)
        assert (sent.afx, sent.afy, sent.afz) == (2.0, 1.0, -3.0)

    def test_nan_is_not_forwarded(self, bench, caplog):
        message = Vector3Stamped()
        message.vector.z = NAN
        assert refused(bench, caplog, "setpoint_accel/accel", message, "vector.z is nan")


def geo_pose(latitude=LATITUDE, longitude=LONGITUDE, altitude=ALTITUDE, yaw=0.3):
    pose = stamped(GeoPoseStamped(), 3021)
    place = pose.pose.position
    place.latitude, place.longitude, place.altitude = latitude, longitude, altitude
    pose.pose.orientation = turned(0.0, 0.0, yaw)
    return pose


class TestGlobalPosition:
    """setpoint_position/global and global_to_local."""

    HERE = mavlink.MAVLink_global_position_int_message(5000, 473977420, 85455940, 488_000, 0, 0, 0, 0, 0)
    LOCAL = mavlink.MAVLink_local_position_ned_message(5000, 10.0, 20.0, -30.0, 0.0, 0.0, 0.0)

    def test_global(self, bench):
        bench.call("setpoint_position/global", geo_pose())
        [sent] = bench.received()
        assert sent.get_type() == "SET_POSITION_TARGET_GLOBAL_INT"
        assert (sent.coordinate_frame, sent.type_mask, sent.time_boot_ms) == (5, 0b0001_1111_1000, 3021)
        assert (sent.lat_int, sent.lon_int, sent.alt) == (473977420, 85455940, 488.0)
        assert (sent.yaw, sent.yaw_rate) == approx((math.pi / 2 - 0.3, 0.0))

    @pytest.mark.parametrize("topic", ["setpoint_position/global", "setpoint_position/global_to_local"])
    def test_nan_is_not_forwarded(self, bench, caplog, topic):
        assert refused(bench, caplog, topic, geo_pose(latitude=NAN), "pose.position.latitude is nan")

    def test_values_out_of_range_are_not_forwarded(self, bench, caplog):
        assert refused(
            bench,
            caplog,
            "setpoint_position/global",
            geo_pose(latitude=300.0),
            "SET_POSITION_TARGET_GLOBAL_INT.lat_int",
        )

    def test_an_invalid_goal_is_not_forwarded(self, bench, caplog):
        topic = "setpoint_position/global_to_local"
        assert refused(bench, caplog, topic, geo_pose(latitude=91.0), "latitude 91.0")

    def test_a_goal_is_the_vehicles_position_and_the_way_from_it(self, bench):
        """1e-4 deg of latitude are 11.12 m to the north, and 1e-4 deg of longitude 7.55 m to the east."""
        bench.call("setpoint_position/global_to_local", geo_pose(LATITUDE + 1e-4, LONGITUDE + 1e-4, ALTITUDE + 5.0))
        assert bench.received() == []
        bench.send(self.LOCAL, self.HERE)
        [sent] = bench.received()
        assert (sent.get_type(), sent.coordinate_frame) == ("SET_POSITION_TARGET_LOCAL_NED", 1)
        assert (sent.type_mask, sent.time_boot_ms) == (0b1001_1111_1000, 3021)
        assert (sent.x, sent.y, sent.z) == approx((10.0 + 11.118, 20.0 + 7.549, -35.0), 0.01)
        assert sent.yaw == pytest.approx(math.pi / 2 - 0.3)
        bench.send(self.LOCAL, self.HERE)
        assert bench.received() == [], "a goal is sent once"

    def test_the_position_is_requested_while_goals_arrive(self, bench):
        assert not {32, 33} & bench.link.wanted
        bench.call("setpoint_position/global_to_local", geo_pose())
        assert {32, 33} <= bench.link.wanted
        bench.send(self.LOCAL, self.HERE)
        for seconds in range(11):
            assert {32, 33} <= bench.link.wanted
            bench.uas.step(seconds * 1_000_000_000)
        assert not {32, 33} & bench.link.wanted

    def test_a_goal_waits_for_positions_of_one_time(self, bench):
        bench.call("setpoint_position/global_to_local", geo_pose())
        bench.send(mavlink.MAVLink_local_position_ned_message(4000, *[0.0] * 6), self.HERE)
        assert bench.received() == []
        bench.send(self.LOCAL, self.HERE)
        assert len(bench.received()) == 1

    def test_a_pending_goal_is_reported(self, bench, caplog):
        bench.call("setpoint_position/global_to_local", geo_pose())
        bench.uas.step(0)
        assert "a goal is waiting" not in caplog.text
        bench.uas.step(1_000_000_000)
        assert "setpoint_position/global_to_local: a goal is waiting" in caplog.text

    def test_the_frame_becomes_a_parameter(self, bench):
        service = bench.ros.services["/iris_0/mavros/setpoint_position/mav_frame"]
        assert service(SetMavFrameRequest(mav_frame=8)).success
        assert bench.ros.params["/iris_0/mavros/setpoint_position/mav_frame"] == "BODY_NED"


class TestListening:
    """tf/listen of setpoint_position and setpoint_attitude."""

    def tell(self, bench, parent, child, millis, position, yaw, topic="/tf"):
        transform = stamped(TransformStamped(child_frame_id=child), millis)
        transform.header.frame_id = parent
        transform.transform = Transform(fill(Vector3(), position), turned(0.0, 0.0, yaw))
        bench.ros.subscribers[topic](TFMessage([transform]))

    def test_the_position_of_a_frame(self):
        """map -> base is (10, 0, 0) turned left by a right angle; a target 1 m forward of it is at (10, 1, 3)."""
        with opened({"setpoint_position": {"tf": {"listen": True, "rate_limit": 10.0}}}) as bench:
            assert "/iris_0/mavros/setpoint_position/local" not in bench.ros.subscribers
            self.tell(bench, "base", "target_position", 2000, (1.0, 0.0, 3.0), 0.0)
            bench.uas.step(2_000_000_000)
            assert [m for m in bench.received() if m.get_type() != "HEARTBEAT"] == []
            self.tell(bench, "map", "base", 2000, (10.0, 0.0, 0.0), math.pi / 2)
            for millis in range(2000, 3000, 20):
                bench.uas.step(millis * MILLISECOND)
            sent = [m for m in bench.received() if m.get_type() != "HEARTBEAT"]
        assert len(sent) == 9  # from 2.1 s on
        assert (sent[0].x, sent[0].y, sent[0].z) == approx((1.0, 10.0, -3.0))
        assert (sent[0].yaw, sent[0].time_boot_ms, sent[0].type_mask) == approx((0.0, 2000, 0b1001_1111_1000))

    def test_the_attitude_of_a_frame_goes_with_each_thrust(self):
        params = {"tf": {"listen": True, "child_frame_id": "wanted"}}
        with opened({"setpoint_attitude": params}) as bench:
            bench.call("setpoint_attitude/thrust", Thrust(thrust=0.5))
            assert bench.received() == []
            self.tell(bench, "map", "wanted", 2000, (0.0, 0.0, 0.0), 0.3)
            bench.call("setpoint_attitude/thrust", Thrust(thrust=0.6))
            [sent] = bench.received()
        assert (sent.type_mask, sent.thrust, sent.time_boot_ms) == approx((0b111, 0.6, 2000))
        assert frames.rpy_from_quaternion(sent.q) == approx((0.0, 0.0, math.pi / 2 - 0.3))

    @pytest.mark.parametrize(("topic", "kept"), [("/tf", 0), ("/tf_static", 1)])
    def test_transfers_are_dropped_with_the_vehicle(self, topic, kept):
        with opened({"setpoint_attitude": {"tf": {"listen": True}}}) as bench:
            self.tell(bench, "map", "target_attitude", 2000, (0.0, 0.0, 0.0), 0.3, topic)
            for plugin in bench.uas.plugins:
                plugin.connected(False)
            bench.call("setpoint_attitude/thrust", Thrust(thrust=0.6))
            assert len(bench.received()) == kept

    @pytest.mark.parametrize("rate", [0.0, -1.0, math.inf])
    def test_an_invalid_rate_is_rejected(self, rate):
        with pytest.raises(ValueError, match="setpoint_position/tf/rate_limit"):
            Bench(PLUGINS, {"setpoint_position": {"tf": {"listen": True, "rate_limit": rate}}})


def global_target(frame=5, mask=0, **fields):
    values = {"latitude": LATITUDE, "longitude": LONGITUDE, "altitude": ALTITUDE, "yaw": 0.3, "yaw_rate": 0.4, **fields}
    target = stamped(GlobalPositionTarget(coordinate_frame=frame, type_mask=mask), 3021)
    for name, value in values.items():
        setattr(target, name, value)
    fill(target.velocity, (4.0, 5.0, 6.0))
    fill(target.acceleration_or_force, (7.0, 8.0, 9.0))
    return target


class TestRawGlobal:
    """setpoint_raw/global and target_global."""

    @pytest.mark.parametrize("frame", [5, 6, 11])
    def test_global(self, bench, frame):
        bench.call("setpoint_raw/global", global_target(frame))
        [sent] = bench.received()
        assert (sent.coordinate_frame, sent.type_mask, sent.time_boot_ms) == (frame, 0, 3021)
        assert (sent.target_system, sent.target_component) == (1, 1)
        assert (sent.lat_int, sent.lon_int, sent.alt) == (473977420, 85455940, 488.0)
        assert (sent.vx, sent.vy, sent.vz) == (5.0, 4.0, -6.0)
        assert (sent.afx, sent.afy, sent.afz) == (8.0, 7.0, -9.0)
        assert (sent.yaw, sent.yaw_rate) == approx((math.pi / 2 - 0.3, -0.4))

    @pytest.mark.parametrize("field", ["longitude", "altitude", "yaw_rate"])
    def test_nan_is_not_forwarded(self, bench, caplog, field):
        target = global_target(**{field: math.inf})
        assert refused(bench, caplog, "setpoint_raw/global", target, f"{field} is inf")

    def test_masked_fields_may_be_nan(self, bench):
        mask = GlobalPositionTarget.IGNORE_LATITUDE | GlobalPositionTarget.IGNORE_YAW
        bench.call("setpoint_raw/global", global_target(mask=mask, latitude=NAN, yaw=NAN))
        [sent] = bench.received()
        assert sent.type_mask == mask

    def test_unknown_frame_is_rejected(self, bench, caplog):
        assert refused(bench, caplog, "setpoint_raw/global", global_target(1), "coordinate_frame 1 is not allowed")

    def test_an_uncontrolled_yaw_is_returned_as_none(self, bench):
        bench.take("setpoint_raw/target_global")
        bench.send(mavlink.MAVLink_position_target_global_int_message(3021, 5, 0, 0, 0, 0.0, *[0.0] * 6, NAN, NAN))
        [target] = bench.published("setpoint_raw/target_global")
        assert math.isnan(target.yaw)

    def test_there_and_back(self, bench):
        """The sent setpoint equals the autopilot's target in its fields."""
        bench.take("setpoint_raw/target_global")

        @settings(max_examples=50, deadline=None)
        @given(st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), NUMBERS, ANGLES, NUMBERS, st.integers(0, 0xFFF))
        def law(latitude, longitude, altitude, yaw, yaw_rate, mask):
            mask &= ~0b11
            out = global_target(
                mask=mask, latitude=latitude, longitude=longitude, altitude=altitude, yaw=yaw, yaw_rate=yaw_rate
            )
            bench.call("setpoint_raw/global", out)
            [m] = bench.received()
            values = (m.vx, m.vy, m.vz, m.afx, m.afy, m.afz, m.yaw, m.yaw_rate)
            place = (m.lat_int, m.lon_int, m.alt)
            bench.send(mavlink.MAVLink_position_target_global_int_message(3021, 5, m.type_mask, *place, *values))
            [back] = bench.published("setpoint_raw/target_global")
            assert (back.latitude, back.longitude) == approx((latitude, longitude), 1e-7)
            assert (back.coordinate_frame, back.type_mask, back.altitude) == (5, mask, altitude)
            assert (back.velocity, back.acceleration_or_force) == (out.velocity, out.acceleration_or_force)
            assert (back.yaw, back.yaw_rate) == approx((yaw, yaw_rate))
            assert back.header.stamp == out.header.stamp

        law()


@pytest.mark.parametrize("scaling", [-1.0, NAN, math.inf])
def test_an_invalid_thrust_scaling_is_rejected(scaling):
    with pytest.raises(ValueError, match="setpoint_raw/thrust_scaling"):
        Bench(PLUGINS, {"setpoint_raw": {"thrust_scaling": scaling}})


def point(seconds, position=None, yaw=0.0, velocity=None, yaw_rate=0.0, acceleration=None):
    made = MultiDOFJointTrajectoryPoint(time_from_start=rospy.Duration.from_sec(seconds))
    if position is not None:
        made.transforms = [Transform(fill(Vector3(), position), turned(0.0, 0.0, yaw))]
    if velocity is not None:
        made.velocities = [Twist(fill(Vector3(), velocity), fill(Vector3(), (0.0, 0.0, yaw_rate)))]
    if acceleration is not None:
        made.accelerations = [Twist(fill(Vector3(), acceleration), Vector3())]
    return made


class TestSetpointTrajectory:
    """setpoint_trajectory."""

    START_MS = 10_000

    def fly(self, bench, *points):
        bench.ros.time_ns = self.START_MS * MILLISECOND
        bench.uas.step(bench.ros.time_ns)
        bench.received()
        bench.call("setpoint_trajectory/local", MultiDOFJointTrajectory(points=list(points)))

    def until(self, bench, millis, every=20):
        """Return the messages sent in the next ``millis`` ms, heartbeats excluded."""
        for _ in range(0, millis, every):
            bench.ros.time_ns += every * MILLISECOND
            bench.uas.step(bench.ros.time_ns)
        return [m for m in bench.received() if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]

    def test_points_are_sent_at_their_times(self, bench):
        self.fly(bench, *[point(0.5 * (index + 1), (float(index), 0.0, 0.0)) for index in range(4)])
        assert [(m.y, m.time_boot_ms) for m in self.until(bench, 3000)] == [
            (0.0, 10_500),
            (1.0, 11_000),
            (2.0, 11_500),
            (3.0, 12_000),
        ]

    def test_of_those_that_are_due_together_the_last_is_sent(self, bench):
        self.fly(bench, *[point(0.005 * index, (float(index), 0.0, 0.0)) for index in range(9)])
        assert [m.y for m in self.until(bench, 100)] == [4.0, 8.0]

    @pytest.mark.parametrize(
        ("frame", "vectors", "yaw"),
        [
            (1, ((2.0, 1.0, -3.0), (5.0, 4.0, -6.0), (8.0, 7.0, -9.0)), math.pi / 2 - 0.3),
            (8, ((1.0, -2.0, -3.0), (4.0, -5.0, -6.0), (7.0, -8.0, -9.0)), -0.3),
        ],
    )
    def test_a_whole_point(self, bench, frame, vectors, yaw):
        bench.ros.services["/iris_0/mavros/setpoint_trajectory/mav_frame"](SetMavFrameRequest(mav_frame=frame))
        self.fly(bench, point(0.0, (1.0, 2.0, 3.0), 0.3, (4.0, 5.0, 6.0), 0.4, (7.0, 8.0, 9.0)))
        [sent] = self.until(bench, 20)
        assert (sent.coordinate_frame, sent.type_mask) == (frame, 0)
        got = (sent.x, sent.y, sent.z), (sent.vx, sent.vy, sent.vz), (sent.afx, sent.afy, sent.afz)
        assert got == vectors
        assert (sent.yaw, sent.yaw_rate) == approx((yaw, -0.4))

    @pytest.mark.parametrize(
        ("given_parts", "mask"),
        [
            ({"position": (1.0, 2.0, 3.0)}, 0b1001_1111_1000),
            ({"velocity": (1.0, 2.0, 3.0)}, 0b0101_1100_0111),
            ({"acceleration": (1.0, 2.0, 3.0)}, 0b1100_0011_1111),
        ],
    )
    def test_missing_fields_of_a_point_are_masked(self, bench, given_parts, mask):
        self.fly(bench, point(0.0, **given_parts))
        [sent] = self.until(bench, 20)
        assert sent.type_mask == mask

    def test_the_path_is_published(self, bench):
        bench.take("setpoint_trajectory/desired")
        self.fly(bench, point(0.0, (1.0, 2.0, 3.0), 0.3), point(1.0, velocity=(1.0, 0.0, 0.0)))
        [path] = bench.published("setpoint_trajectory/desired")
        assert path.header.frame_id == "map"
        assert path.header.stamp.to_sec() == 10.0
        [pose] = path.poses
        assert xyz(pose.pose.position) == (1.0, 2.0, 3.0)
        assert pose.pose.orientation == turned(0.0, 0.0, 0.3)

    def test_reset(self, bench):
        reset = bench.ros.services["/iris_0/mavros/setpoint_trajectory/reset"]
        assert not reset(TriggerRequest()).success
        self.fly(bench, point(0.5, (1.0, 2.0, 3.0)))
        assert reset(TriggerRequest()).success
        assert self.until(bench, 1000) == []
        assert not reset(TriggerRequest()).success

    def test_a_new_one_replaces_the_old(self, bench):
        self.fly(bench, point(0.5, (1.0, 0.0, 0.0)))
        self.fly(bench, point(0.2, (2.0, 0.0, 0.0)))
        assert [m.y for m in self.until(bench, 1000)] == [2.0]

    def test_none_flies_on_when_the_vehicle_has_gone(self, bench):
        self.fly(bench, point(0.5, (1.0, 2.0, 3.0)))
        for plugin in bench.uas.plugins:
            plugin.connected(False)
        assert self.until(bench, 1000) == []

    def test_a_fence_without_points_is_rejected(self, bench, caplog):
        self.fly(bench)
        assert "the trajectory has no points" in caplog.text

    def test_nan_is_not_forwarded(self, bench, caplog):
        self.fly(bench, point(0.0, (1.0, 2.0, 3.0)), point(1.0, velocity=(0.0, NAN, 0.0)))
        assert self.until(bench, 2000) == []
        assert "setpoint_trajectory/local: points[1].velocities[0].linear.y is nan" in caplog.text


class TestTrajectory:
    """trajectory: way points around obstacles."""

    def trajectory(self, points, kind=0):
        made = stamped(Trajectory(type=kind), 2000)
        made.point_valid = [index < len(points) for index in range(5)]
        for index, (position, velocity, acceleration, yaw, yaw_rate) in enumerate(points):
            target = getattr(made, f"point_{index + 1}")
            fill(target.position, position)
            fill(target.velocity, velocity)
            fill(target.acceleration_or_force, acceleration)
            target.yaw, target.yaw_rate = yaw, yaw_rate
        return made

    POINT = ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0), 0.3, 0.4)

    def test_generated(self, bench):
        bench.call("trajectory/generated", self.trajectory([self.POINT]))
        [sent] = bench.received()
        assert sent.get_type() == "TRAJECTORY_REPRESENTATION_WAYPOINTS"
        assert (sent.time_usec, sent.valid_points, sent.command) == (2_000_000, 1, [65535] * 5)
        assert (sent.pos_x[0], sent.pos_y[0], sent.pos_z[0]) == (2.0, 1.0, -3.0)
        assert (sent.vel_x[0], sent.vel_y[0], sent.vel_z[0]) == (5.0, 4.0, -6.0)
        assert (sent.acc_x[0], sent.acc_y[0], sent.acc_z[0]) == (8.0, 7.0, -9.0)
        assert (sent.pos_yaw[0], sent.vel_yaw[0]) == approx((math.pi / 2 - 0.3, -0.4))
        assert math.isnan(sent.pos_x[1])
        assert math.isnan(sent.vel_yaw[4])

    def test_valid_points_have_no_gaps(self, bench):
        message = self.trajectory([self.POINT, self.POINT])
        message.point_2.position.x = 11.0
        message.point_valid = [False, True, False, False, False]
        bench.call("trajectory/generated", message)
        [sent] = bench.received()
        assert (sent.valid_points, sent.pos_y[0]) == (1, 11.0)

    def test_bezier(self, bench):
        message = self.trajectory([self.POINT], kind=1)
        message.time_horizon = [0.5, 0.0, 0.0, 0.0, 0.0]
        bench.call("trajectory/generated", message)
        [sent] = bench.received()
        assert (sent.get_type(), sent.valid_points) == ("TRAJECTORY_REPRESENTATION_BEZIER", 1)
        assert (sent.pos_x[0], sent.pos_y[0], sent.pos_z[0], sent.delta[0]) == (2.0, 1.0, -3.0, 0.5)
        assert sent.pos_yaw[0] == pytest.approx(math.pi / 2 - 0.3)

    def test_path(self, bench):
        path = stamped(Path(), 2000)
        for index in range(7):
            pose = PoseStamped()
            fill(pose.pose.position, (1.0 + index, 2.0, 3.0))
            pose.pose.orientation = turned(0.0, 0.0, 0.3)
            path.poses.append(pose)
        bench.call("trajectory/path", path)
        path.poses = path.poses[:1]
        bench.call("trajectory/path", path)
        long, short = bench.received()
        assert (long.valid_points, long.pos_y) == (5, [1.0, 2.0, 3.0, 4.0, 5.0])
        assert (short.valid_points, short.pos_x[0], short.pos_z[0]) == (1, 2.0, -3.0)
        assert short.pos_yaw[0] == pytest.approx(math.pi / 2 - 0.3)
        assert math.isnan(short.pos_y[1])
        assert math.isnan(short.vel_x[0])

    def test_unused_values_are_allowed_and_infinite_ones_are_not(self, bench, caplog):
        unused = (self.POINT[0], (NAN, NAN, NAN), (NAN, NAN, NAN), 0.3, NAN)
        bench.call("trajectory/generated", self.trajectory([unused]))
        assert len(bench.received()) == 1
        message = self.trajectory([self.POINT])
        message.point_1.position.z = math.inf
        assert refused(bench, caplog, "trajectory/generated", message, "point_1.position.z is inf")

    def test_too_many_points_are_dropped(self, bench):
        bench.take("trajectory/desired")
        columns = [[0.0] * 5] * 11
        bench.send(mavlink.MAVLink_trajectory_representation_waypoints_message(0, 6, *columns, [0] * 5))
        assert bench.published("trajectory/desired") == []

    def test_there_and_back(self, bench):
        bench.take("trajectory/desired")

        @settings(max_examples=50, deadline=None)
        @given(st.lists(st.tuples(THREE, THREE, THREE, ANGLES, NUMBERS), max_size=5))
        def law(points):
            out = self.trajectory(points)
            bench.call("trajectory/generated", out)
            [m] = bench.received()
            bench.send(m)
            [back] = bench.published("trajectory/desired")
            assert list(back.point_valid) == list(out.point_valid)
            assert (back.header.frame_id, back.header.stamp) == ("local_origin", out.header.stamp)
            for index in range(len(points)):
                got, put = (getattr(message, f"point_{index + 1}") for message in (back, out))
                assert (got.position, got.velocity) == (put.position, put.velocity)
                assert got.acceleration_or_force == put.acceleration_or_force
                assert (got.yaw, got.yaw_rate) == approx((put.yaw, put.yaw_rate))

        law()


class TestPilot:
    """manual_control and rc."""

    def test_sticks_go_out_as_mavlink_has_them(self, bench):
        bench.call("manual_control/send", ManualControl(x=100.0, y=-200.4, z=500.0, r=1000.0, buttons=5))
        [sent] = bench.received()
        assert (sent.target, sent.x, sent.y, sent.z, sent.r, sent.buttons) == (1, 100, -200, 500, 1000, 5)

    @pytest.mark.parametrize("value", [NAN, math.inf, 40_000.0])
    def test_sticks_out_of_range_are_not_forwarded(self, bench, caplog, value):
        assert refused(bench, caplog, "manual_control/send", ManualControl(y=value), "")
        assert "-32768 to 32767 is allowed" in caplog.text

    def test_sticks_are_returned_as_fractions(self, bench):
        bench.take("manual_control/control")
        bench.ros.time_ns = 5_000_000_000
        bench.send(mavlink.MAVLink_manual_control_message(1, 100, -200, 500, 1000, 5))
        [control] = bench.published("manual_control/control")
        assert (control.x, control.y, control.z, control.r) == (0.1, -0.2, 0.5, 1.0)
        assert (control.buttons, control.header.stamp.to_sec()) == (5, 5.0)

    def test_override(self, bench):
        bench.call("rc/override", OverrideRCIn(channels=[1000 + i for i in range(17)] + [65535]))
        [sent] = bench.received()
        assert (sent.get_type(), sent.target_system, sent.target_component) == ("RC_CHANNELS_OVERRIDE", 1, 1)
        got = [getattr(sent, f"chan{i}_raw") for i in range(1, 19)]
        assert got == [*range(1000, 1017), 65535]

    @pytest.mark.parametrize("count", [0, 5, 18, 20])
    def test_rc_in_has_the_radios_channels(self, bench, count):
        bench.take("rc/in")
        bench.send(mavlink.MAVLink_rc_channels_message(1500, count, *range(1001, 1019), 100))
        [radio] = bench.published("rc/in")
        assert (radio.rssi, radio.channels) == (100, list(range(1001, 1001 + min(count, 18))))
        assert radio.header.stamp.to_sec() == 1.5


class TestActuators:
    """actuator_control."""

    CONTROLS = [0.125 * i for i in range(8)]  # noqa: RUF012

    def test_controls_go_out_as_they_are(self, bench):
        bench.call("actuator_control", stamped(ActuatorControl(group_mix=3, controls=self.CONTROLS), 1500))
        [sent] = bench.received()
        assert (sent.get_type(), sent.time_usec, sent.group_mlx) == ("SET_ACTUATOR_CONTROL_TARGET", 1_500_000, 3)
        assert (sent.target_system, sent.target_component, sent.controls) == (1, 1, self.CONTROLS)

    def test_controls_are_passed_unchanged(self, bench):
        bench.take("target_actuator_control")
        bench.send(mavlink.MAVLink_actuator_control_target_message(1_500_000, 0, self.CONTROLS))
        [target] = bench.published("target_actuator_control")
        assert (target.group_mix, list(target.controls)) == (0, self.CONTROLS)
        assert target.header.stamp.to_sec() == 1.5

    def test_nan_is_not_forwarded(self, bench, caplog):
        message = ActuatorControl(controls=[0.0] * 7 + [NAN])
        assert refused(bench, caplog, "actuator_control", message, "controls[7] is nan")


def test_streams_that_px4_does_not_send_by_default_are_requested_at_a_rate(bench):
    """PX4 has no default rate for these on a companion's link: a rate of 0 would leave them off."""
    bench.send(mavlink.MAVLink_heartbeat_message(2, 12, 0x91, 6 << 16, 4, 3))
    bench.received()
    bench.take("manual_control/control", "target_actuator_control", "rc/in")
    asked = {m.param1: m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG"}
    assert asked == {69: 200_000.0, 140: 100_000.0, 65: 0.0}


def test_a_target_without_a_subscriber_is_not_decoded(bench):
    local = mavlink.MAVLink_position_target_global_int_message(3021, 5, 0, 0, 0, 0.0, *[0.0] * 8)
    bench.send(local, mavlink.MAVLink_rc_channels_message(0, 0, *range(18), 0))
    assert bench.link.seen == {87: 1, 65: 1}
