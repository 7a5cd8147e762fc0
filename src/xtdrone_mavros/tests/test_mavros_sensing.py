"""Sensors and information between fake ROS and a UDP socket in the autopilot's place, as rows of tables."""

from __future__ import annotations

import bisect
import io
import math
import random
import re
import struct
import threading
from operator import attrgetter
from pathlib import Path

import pytest
import yaml
from geographic_msgs.msg import GeoPointStamped
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistStamped,
    TwistWithCovarianceStamped,
    Vector3Stamped,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mavros_fakes import Bench
from mavros_msgs import msg, srv
from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import LaserScan, Range, Temperature
from std_msgs.msg import UInt8

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES, message
from xtdrone_common import frames
from xtdrone_mavros.extras.distance_sensor import turn
from xtdrone_mavros.extras.obstacle_distance import bins
from xtdrone_mavros.plugins import PLUGINS

CONFIG = Path(__file__).parents[1] / "mavros" / "launch"
NAN, INF = math.nan, math.inf
Q_NED = frames.quaternion_from_rpy(0.1, -0.2, 0.7)
Q_ENU = frames.quaternion_from_rpy(0.1, 0.2, math.pi / 2 - 0.7)  # the same roll, opposite pitch, yaw from east
SENSORS = {
    "down": {"id": 0, "frame_id": "lidar", "field_of_view": 0.5, "orientation": "PITCH_270", "send_tf": True,
             "sensor_position": {"z": -0.1}},
    "sonar": {"id": 2, "subscriber": True, "orientation": "PITCH_270", "horizontal_fov_ratio": 2.0},
    "odd": {"id": 3, "subscriber": True, "orientation": "CUSTOM", "covariance": 9,
            "custom_orientation": {"yaw": 90.0}},
}  # fmt: skip


@pytest.fixture(scope="module")
def shared():
    made = Bench(PLUGINS, {"distance_sensor": SENSORS, "global_position": {"geoid": "none"}})
    yield made
    made.close()


@pytest.fixture
def bench(shared):
    """Yield one bench for all tests that change no state: no subscribers, no pending datagrams."""
    for publisher in shared.ros.publishers.values():
        publisher.connections = 0
        publisher.messages.clear()
    shared.ros.time_ns += 10_000_000_000
    shared.uas._throttle = type(shared.uas._throttle)()
    shared.uas.refresh()
    shared.received()
    return shared


def made(name, /, **values):
    """Return a MAVLink message; fields that are not named are 0."""
    kind = MESSAGES[MESSAGE_ID[name]]
    lengths = dict(zip(kind.ordered_fieldnames, kind.lengths, strict=True))
    fields = {
        field: b"" if type_ == "char" else [0] * lengths[field] if lengths[field] > 1 else 0
        for field, type_ in zip(kind.fieldnames, kind.fieldtypes, strict=True)
    }
    return message(name, fields | values)


def filled(kind, **values):
    """Return a ROS message with fields by path, ``__`` for a dot; vectors are tuples (quaternions w first)."""
    ros = kind()
    for path, value in values.items():
        names = path.split("__")
        parent = attrgetter(".".join(names[:-1]))(ros) if names[1:] else ros
        slots = getattr(getattr(parent, names[-1]), "__slots__", ())
        if isinstance(value, tuple) and slots:
            for axis, number in zip("wxyz" if len(value) == 4 else "xyz", value, strict=True):
                setattr(getattr(parent, names[-1]), axis, number)
        else:
            setattr(parent, names[-1], value)
    return ros


def plain(value):
    """Return vectors and quaternions as tuples."""
    slots = tuple(getattr(value, "__slots__", ()))
    if slots in (("x", "y", "z"), ("x", "y", "z", "w")):
        return tuple(getattr(value, axis) for axis in ("wxyz" if len(slots) == 4 else "xyz"))
    if hasattr(value, "to_sec"):
        return value.to_sec()
    return list(value) if isinstance(value, (bytes, tuple)) else value


def agrees(got, expected):
    if isinstance(expected, (int, str)):
        return got == expected
    if isinstance(got, tuple) and len(got) == 4:
        return abs(abs(sum(a * b for a, b in zip(got, expected, strict=True))) - 1.0) < 1e-6
    return got == pytest.approx(expected, rel=1e-5, abs=1e-6, nan_ok=True)


US = 5_000_000
GPS = dict(fix_type=3, lat=473977420, lon=-85455940, alt=488_000, eph=90, epv=120, vel=500, cog=9000)
RTK = dict(time_last_baseline_ms=7000, rtk_receiver_id=1, wn=40000, tow=5, rtk_health=6, rtk_rate=7, nsats=8,
           baseline_a_mm=-9, baseline_b_mm=10, baseline_c_mm=11, accuracy=12, iar_num_hypotheses=-13)  # fmt: skip
OUT = [
    (made("WIND_COV", time_usec=US, wind_x=1.0, wind_y=2.0, wind_z=-3.0, var_horiz=0.5, var_vert=0.25),
     "wind_estimation", TwistWithCovarianceStamped,
     {"header.stamp": 5.0, "twist.twist.linear": (2.0, 1.0, 3.0),
      "twist.covariance": [0.5, *[0.0] * 13, 0.25, *[0.0] * 21]}),
    (made("GPS_RAW_INT", time_usec=US, satellites_visible=11, alt_ellipsoid=535, h_acc=800, v_acc=1500, vel_acc=2,
          hdg_acc=2**32 - 1, yaw=9, **GPS), "gpsstatus/gps1/raw", msg.GPSRAW,
     {"header.stamp": 5.0, "header.frame_id": "/wgs84", **GPS, "satellites_visible": 11, "alt_ellipsoid": 535,
      "h_acc": 800, "hdg_acc": -1, "yaw": 9, "dgps_numch": 255, "dgps_age": 2**32 - 1}),
    (made("GPS2_RAW", time_usec=US, dgps_numch=3, dgps_age=4, **GPS), "gpsstatus/gps2/raw", msg.GPSRAW,
     {"header.stamp": 5.0, **GPS, "dgps_numch": 3, "dgps_age": 4}),
    (made("GPS_RTK", baseline_coords_type=0, **RTK), "gpsstatus/gps1/rtk", msg.GPSRTK,
     {"header.stamp": 7.0, "header.frame_id": "earth", "wn": 40000 - 65536, "tow": 5, "baseline_a": -9,
      "baseline_c": 11, "accuracy": 12, "iar_num_hypotheses": -13}),
    (made("GPS2_RTK", baseline_coords_type=1, **RTK), "gpsstatus/gps2/rtk", msg.GPSRTK, {"header.frame_id": "map"}),
    (made("GPS_RTK", baseline_coords_type=1, **RTK), "gps_rtk/rtk_baseline", msg.RTKBaseline,
     {**RTK, "baseline_coords_type": 1}),
    (made("DEBUG", time_boot_ms=5000, ind=7, value=0.5), "debug_value/debug", msg.DebugValue,
     {"header.stamp": 5.0, "type": 0, "index": 7, "array_id": -1, "value_float": 0.5}),
    (made("DEBUG_VECT", time_usec=US, name=b"abc", x=1.0, y=2.0, z=3.0), "debug_value/debug_vector", msg.DebugValue,
     {"header.stamp": 5.0, "type": 1, "index": -1, "name": "abc", "data": [1.0, 2.0, 3.0]}),
    (made("DEBUG_FLOAT_ARRAY", time_usec=US, name=b"abc", array_id=4, data=[0.5] * 58), "debug_value/debug_float_array",
     msg.DebugValue, {"type": 2, "name": "abc", "array_id": 4, "data": [0.5] * 58}),
    (made("NAMED_VALUE_FLOAT", time_boot_ms=5000, name=b"ten_letter", value=0.5), "debug_value/named_value_float",
     msg.DebugValue, {"header.stamp": 5.0, "type": 3, "name": "ten_letter", "value_float": 0.5}),
    (made("NAMED_VALUE_INT", name=b"abc", value=-5), "debug_value/named_value_int", msg.DebugValue,
     {"type": 4, "name": "abc", "value_int": -5, "value_float": 0.0}),
    (made("NAV_CONTROLLER_OUTPUT", nav_roll=1.0, nav_pitch=2.0, nav_bearing=-3, target_bearing=4, wp_dist=5,
          alt_error=6.0, aspd_error=7.0, xtrack_error=8.0), "nav_controller_output", msg.NavControllerOutput,
     {"nav_roll": 1.0, "nav_bearing": -3, "wp_dist": 5, "xtrack_error": 8.0}),
    (made("LANDING_TARGET", time_usec=US, target_num=3, x=1.0, y=2.0, z=-3.0, q=list(Q_NED)), "landing_target/pose_in",
     PoseStamped, {"header.stamp": 5.0, "header.frame_id": "landing_target_1", "pose.position": (2.0, 1.0, 3.0),
                   "pose.orientation": Q_ENU}),
    (made("LANDING_TARGET", time_usec=US, q=[1, 0, 0, 0]), "landing_target/lt_marker", Vector3Stamped,
     {"header.stamp": 5.0, "vector": (1.0, 1.0, 0.0)}),
    (made("DISTANCE_SENSOR", time_boot_ms=5000, min_distance=20, max_distance=4000, current_distance=123, type=0, id=0,
          orientation=25), "distance_sensor/down", Range,
     {"header.stamp": 5.0, "header.frame_id": "lidar", "radiation_type": Range.INFRARED, "field_of_view": 0.5,
      "min_range": 0.2, "max_range": 40.0, "range": 1.23}),
    (made("ADSB_VEHICLE", ICAO_address=77, lat=473977420, lon=-85455940, altitude_type=1, altitude=-1500, heading=9000,
          hor_velocity=1234, ver_velocity=-250, callsign=b"HB-ABC", emitter_type=2, tslc=3, flags=4, squawk=5),
     "adsb/vehicle", msg.ADSBVehicle,
     {"ICAO_address": 77, "callsign": "HB-ABC", "latitude": 47.397742, "longitude": -8.545594, "altitude": -1.5,
      "heading": 90.0, "hor_velocity": 12.34, "ver_velocity": -2.5, "altitude_type": 1, "emitter_type": 2,
      "tslc": 3.0, "flags": 4, "squawk": 5}),
    (made("HIL_CONTROLS", time_usec=US, roll_ailerons=0.1, throttle=0.5, aux4=-1.0, mode=3, nav_mode=4),
     "hil/controls", msg.HilControls, {"header.stamp": 5.0, "throttle": 0.5, "aux4": -1.0, "mode": 3, "nav_mode": 4}),
    (made("HIL_ACTUATOR_CONTROLS", time_usec=US, controls=[0.5] * 16, mode=129, flags=1), "hil/actuator_controls",
     msg.HilActuatorControls, {"header.stamp": 5.0, "controls": [0.5] * 16, "mode": 129, "flags": 1}),
    (made("RADIO_STATUS", rssi=190, remrssi=19, txbuf=1, noise=2, remnoise=3, rxerrors=4, fixed=5), "radio_status",
     msg.RadioStatus, {"rssi": 190, "rssi_dbm": -27.0, "remrssi_dbm": -117.0, "rxerrors": 4, "fixed": 5}),
    (made("OPTICAL_FLOW_RAD", time_usec=US, integration_time_us=9, integrated_x=1.0, integrated_y=2.0,
          integrated_xgyro=3.0, integrated_ygyro=4.0, integrated_zgyro=5.0, temperature=2150, quality=200,
          time_delta_distance_us=8, distance=1.5), "px4flow/raw/optical_flow_rad", msg.OpticalFlowRad,
     {"header.stamp": 5.0, "header.frame_id": "px4flow", "integration_time_us": 9, "integrated_x": 1.0,
      "integrated_y": -2.0, "integrated_xgyro": 3.0, "integrated_ygyro": -4.0, "integrated_zgyro": -5.0,
      "temperature": 21, "quality": 200, "time_delta_distance_us": 8, "distance": 1.5}),
    (made("OPTICAL_FLOW_RAD", temperature=2150), "px4flow/temperature", Temperature, {"temperature": 21.5}),
    (made("OPTICAL_FLOW_RAD", distance=1.5), "px4flow/ground_distance", Range,
     {"range": 1.5, "radiation_type": Range.ULTRASOUND, "min_range": 0.3, "max_range": 5.0}),
    (made("MAG_CAL_REPORT", compass_id=2, cal_mask=7, cal_status=4, fitness=0.5, orientation_confidence=0.75,
          ofs_y=3.0), "mag_calibration/report", msg.MagnetometerReporter,
     {"header.frame_id": "2", "report": 4, "confidence": 0.75, "cal_mask": 7, "fitness": 0.5, "ofs_y": 3.0}),
    (made("TERRAIN_REPORT", lat=473977420, lon=85455940, spacing=100, terrain_height=1.0, current_height=2.0, pending=3,
          loaded=4), "terrain/report", msg.TerrainReport,
     {"header.frame_id": "terrain", "latitude": 47.397742, "spacing": 100, "current_height": 2.0, "loaded": 4}),
    (made("CAMERA_TRIGGER", time_usec=US, seq=9), "cam_imu_sync/cam_imu_stamp", msg.CamIMUStamp,
     {"frame_stamp": 5.0, "frame_seq_id": 9}),
    (made("CAMERA_IMAGE_CAPTURED", time_boot_ms=5000, lat=473977420, lon=85455940, alt=488_000, relative_alt=2500,
          q=list(Q_NED), image_index=3, capture_result=1, file_url=b"a.jpg"), "camera/image_captured",
     msg.CameraImageCaptured,
     {"header.stamp": 5.0, "geo.latitude": 47.397742, "geo.altitude": 488.0, "relative_alt": 2.5, "orientation": Q_NED,
      "image_index": 3, "capture_result": 1, "file_url": "a.jpg"}),
    (made("VIBRATION", time_usec=US, vibration_x=1.0, vibration_y=2.0, vibration_z=3.0, clipping_1=5),
     "vibration/raw/vibration", msg.Vibration,
     {"header.stamp": 5.0, "header.frame_id": "base_link", "vibration": (2.0, 1.0, -3.0), "clipping": [0.0, 5.0, 0.0]}),
    (made("TUNNEL", target_system=1, target_component=2, payload_type=3, payload_length=2, payload=[9] * 128),
     "tunnel/out", msg.Tunnel,
     {"target_component": 2, "payload_type": 3, "payload_length": 2, "payload": [9, 9, *[0] * 126]}),
    (made("GPS_GLOBAL_ORIGIN", latitude=473977420, longitude=85455940, altitude=488_000, time_usec=US),
     "global_position/gp_origin", GeoPointStamped,
     {"header.frame_id": "earth", "position.latitude": 47.397742, "position.longitude": 8.545594,
      "position.altitude": 488.0}),
    (made("LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET", time_boot_ms=5000, x=1.0, y=2.0, z=-3.0, roll=0.1, pitch=-0.2,
          yaw=0.7), "global_position/gp_lp_offset", PoseStamped,
     {"header.stamp": 5.0, "header.frame_id": "earth", "pose.position": (2.0, 1.0, 3.0), "pose.orientation": Q_ENU}),
]  # fmt: skip

POSE = dict(header__stamp__secs=5, pose__position=(1.0, 2.0, 3.0), pose__orientation=Q_ENU)
FLOW = dict(integrated_x=1.0, integrated_y=2.0, integrated_xgyro=3.0, integrated_ygyro=4.0, integrated_zgyro=5.0)
FLOW_FRD = dict(integrated_x=1.0, integrated_y=-2.0, integrated_xgyro=3.0, integrated_ygyro=-4.0, integrated_zgyro=-5.0)
IN = [
    ("gps_input/gps_input", filled(msg.GPSINPUT, header__stamp__secs=5, fix_type=3, gps_id=1, ignore_flags=2, lat=3,
                                   lon=-4, alt=5.5, hdop=0.5, vn=1.0, vd=-1.0, satellites_visible=9, yaw=8),
     "GPS_INPUT", dict(time_usec=US, fix_type=3, gps_id=1, lat=3, lon=-4, alt=5.5, hdop=0.5, vd=-1.0, yaw=8)),
    ("obstacle/send", filled(LaserScan, header__stamp__secs=5, angle_min=-math.pi, angle_increment=math.pi / 36,
                             range_min=0.2, range_max=30.0, ranges=[1.0, NAN, INF, -1.0, 0.0, 2.345]),
     "OBSTACLE_DISTANCE", dict(time_usec=US, sensor_type=0, increment=5, increment_f=5.0, angle_offset=-180.0,
                               min_distance=20, max_distance=3000, frame=0,
                               distances=[100, 65535, 65535, 65535, 0, 234, *[65535] * 66])),
    ("distance_sensor/sonar", filled(Range, header__stamp__secs=5, radiation_type=Range.ULTRASOUND, field_of_view=0.1,
                                     min_range=0.2, max_range=7.0, range=1.23),
     "DISTANCE_SENSOR", dict(time_boot_ms=5000, min_distance=20, max_distance=700, current_distance=123, type=1, id=2,
                             orientation=25, covariance=0, horizontal_fov=0.2, vertical_fov=0.1, quaternion=[0.0] * 4)),
    ("distance_sensor/odd", filled(Range, radiation_type=Range.INFRARED, range=1.0),
     "DISTANCE_SENSOR", dict(type=0, id=3, orientation=100, covariance=9,
                             quaternion=[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])),
    ("vision_speed/speed_twist_cov", filled(TwistWithCovarianceStamped, header__stamp__secs=5,
                                            twist__twist__linear=(1.0, 2.0, 3.0),
                                            twist__covariance=[float(i) for i in range(36)]),
     "VISION_SPEED_ESTIMATE", dict(usec=US, x=2.0, y=1.0, z=-3.0, covariance=[7, 6, -8, 1, 0, -2, -13, -12, 14])),
    ("companion_process/status", filled(msg.CompanionProcessStatus, state=4, component=196),
     "HEARTBEAT", dict(type=18, autopilot=12, base_mode=1, system_status=4)),
    ("onboard_computer/status", filled(msg.OnboardComputerStatus, header__stamp__secs=5, component=191, uptime=7,
                                       cpu_cores=bytes(range(8)), temperature_board=-5, fan_speed=[1, -2, 3, 4],
                                       link_rx_max=[6] * 6),
     "ONBOARD_COMPUTER_STATUS", dict(time_usec=US, uptime=7, cpu_cores=list(range(8)), temperature_board=-5,
                                     fan_speed=[1, -2, 3, 4], link_rx_max=[6] * 6)),
    ("hil/gps", filled(msg.HilGPS, header__stamp__secs=5, fix_type=3, geo__latitude=47.5, geo__longitude=-8.5,
                       geo__altitude=488.5, eph=1, epv=2, vel=3, vn=-4, ve=5, vd=6, cog=90, satellites_visible=9),
     "HIL_GPS", dict(time_usec=US, fix_type=3, lat=475000000, lon=-85000000, alt=488500, eph=100, epv=200, vel=300,
                     vn=-400, ve=500, vd=600, cog=9000, satellites_visible=9)),
    ("hil/imu_ned", filled(msg.HilSensor, header__stamp__secs=5, acc=(1.0, 2.0, 3.0), gyro=(4.0, 5.0, 6.0),
                           mag=(1e-5, 2e-5, 3e-5), abs_pressure=95500.0, diff_pressure=100.0, pressure_alt=500.0,
                           temperature=25.0, fields_updated=63),
     "HIL_SENSOR", dict(time_usec=US, xacc=1.0, yacc=-2.0, zacc=-3.0, xgyro=4.0, ygyro=-5.0, zgyro=-6.0, xmag=0.1,
                        ymag=-0.2, zmag=-0.3, abs_pressure=955.0, diff_pressure=1.0, pressure_alt=500.0,
                        temperature=25.0, fields_updated=63)),
    ("hil/state", filled(msg.HilStateQuaternion, header__stamp__secs=5, orientation=Q_ENU,
                         angular_velocity=(1.0, 2.0, 3.0), linear_acceleration=(4.0, 5.0, 6.0),
                         linear_velocity=(1.0, 2.0, 3.0), geo__latitude=47.5, geo__altitude=488.5, ind_airspeed=1.5,
                         true_airspeed=2.5),
     "HIL_STATE_QUATERNION", dict(time_usec=US, attitude_quaternion=tuple(Q_NED), rollspeed=-2.0, pitchspeed=1.0,
                                  yawspeed=3.0, xacc=4, yacc=-5, zacc=-6, vx=200, vy=100, vz=-300, lat=475000000,
                                  alt=488500, ind_airspeed=150, true_airspeed=250)),
    ("hil/optical_flow", filled(msg.OpticalFlowRad, header__stamp__secs=5, temperature=20, quality=9, distance=1.5,
                                **FLOW),
     "HIL_OPTICAL_FLOW", dict(time_usec=US, sensor_id=127, temperature=2000, quality=9, distance=1.5, **FLOW_FRD)),
    ("hil/rc_inputs", filled(msg.RCIn, header__stamp__secs=5, channels=[1000, 1500]),
     "HIL_RC_INPUTS_RAW", dict(time_usec=US, chan1_raw=1000, chan2_raw=1500, chan3_raw=65535, chan12_raw=65535)),
    ("px4flow/raw/send", filled(msg.OpticalFlowRad, header__stamp__secs=5, temperature=20, quality=9, distance=-1.0,
                                integration_time_us=20000, **FLOW),
     "OPTICAL_FLOW_RAD", dict(time_usec=US, sensor_id=0, temperature=2000, quality=9, distance=-1.0,
                              integration_time_us=20000, **FLOW_FRD)),
    ("landing_target/pose", filled(PoseStamped, **POSE | {"pose__position": (3.0, 0.0, -4.0)}),
     "LANDING_TARGET", dict(time_usec=US, target_num=1, frame=1, x=0.0, y=3.0, z=4.0, q=tuple(Q_NED), distance=5.0,
                            angle_x=0.0, angle_y=math.atan(0.75), size_x=2.0 * math.atan(0.1), type=2,
                            position_valid=1)),
    ("fake_gps/mocap/tf", filled(TransformStamped, header__stamp__secs=5),
     "HIL_GPS", dict(time_usec=US, fix_type=0, lat=473667000, lon=85500000, alt=408000, eph=200, epv=200, vel=0, cog=0,
                     satellites_visible=5)),
    ("global_position/set_gp_origin", filled(GeoPointStamped, position__latitude=47.5, position__longitude=-8.5,
                                             position__altitude=488.5),
     "SET_GPS_GLOBAL_ORIGIN", dict(target_system=1, latitude=475000000, longitude=-85000000, altitude=488500)),
]  # fmt: skip


@pytest.mark.parametrize(("sent", "topic", "kind", "expected"), OUT, ids=[row[1] for row in OUT])
def test_the_autopilots_messages_are_published(bench, sent, topic, kind, expected):
    path = f"/iris_0/mavros/{topic}"
    assert bench.ros.kinds[path] is kind
    bench.take(topic)
    assert MESSAGE_ID[sent.msgname] in bench.link.wanted
    bench.send(sent)
    [got] = bench.published(topic)
    wrong = {
        name: (plain(attrgetter(name)(got)), value)
        for name, value in expected.items()
        if not agrees(plain(attrgetter(name)(got)), value)
    }
    assert not wrong
    got.serialize(io.BytesIO())


@pytest.mark.parametrize(("topic", "ros", "name", "expected"), IN, ids=[row[0] for row in IN])
def test_messages_of_programs_are_forwarded(bench, topic, ros, name, expected):
    assert bench.ros.kinds[f"/iris_0/mavros/{topic}"] is type(ros)
    bench.call(topic, ros)
    [sent] = bench.received()
    assert sent.get_type() == name
    assert sent.get_srcComponent() == getattr(ros, "component", 240)
    wrong = {
        field: (getattr(sent, field), value)
        for field, value in expected.items()
        if not agrees(tuple(getattr(sent, field)) if isinstance(value, tuple) else getattr(sent, field), value)
    }
    assert not wrong


FIRST_FLOATS = {
    "gps_input/gps_input": "alt", "obstacle/send": "angle_min", "distance_sensor/sonar": "range",
    "vision_speed/speed_twist_cov": "twist.twist.linear.x", "hil/gps": "geo.latitude", "hil/imu_ned": "acc.y",
    "hil/state": "linear_velocity.x", "hil/optical_flow": "integrated_y", "px4flow/raw/send": "distance",
    "landing_target/pose": "pose.position.z", "fake_gps/mocap/tf": "transform.translation.x",
    "global_position/set_gp_origin": "position.altitude",
}  # fmt: skip


@pytest.mark.parametrize("value", [NAN, INF, 1e300])
@pytest.mark.parametrize("topic", FIRST_FLOATS)
def test_values_that_mavlink_cannot_hold_are_rejected_by_name(bench, caplog, topic, value):
    ros = type(next(row[1] for row in IN if row[0] == topic))()
    parent, _, leaf = FIRST_FLOATS[topic].rpartition(".")
    setattr(attrgetter(parent)(ros) if parent else ros, leaf, value)
    bench.call(topic, ros)
    assert bench.received() == []
    assert f"/iris_0/mavros/{topic}: " in caplog.text
    assert "the message is not forwarded" in caplog.text


@pytest.mark.parametrize(
    ("topic", "ros", "field"),
    [
        ("px4flow/raw/send", msg.OpticalFlowRad(integrated_zgyro=NAN), "integrated_zgyro"),
        ("hil/optical_flow", msg.OpticalFlowRad(integrated_xgyro=NAN), "integrated_xgyro"),
        ("debug_value/send", msg.DebugValue(type=3, value_float=NAN), "value"),
        ("debug_value/send", msg.DebugValue(type=1, data=[0.0, NAN, INF]), "y"),
    ],
)
def test_nan_is_forwarded(bench, topic, ros, field):
    bench.call(topic, ros)
    assert math.isnan(getattr(bench.received()[0], field))


@pytest.mark.parametrize(
    ("topic", "ros", "said"),
    [
        ("tunnel/in", msg.Tunnel(payload_length=129), "payload_length is 129; 0 to 128 is allowed"),
        ("debug_value/send", msg.DebugValue(type=9), "type is 9; 0 to 4 is allowed"),
        ("debug_value/send", msg.DebugValue(type=1, data=[1.0]), "data is 1 numbers; 3 of them"),
        ("debug_value/send", msg.DebugValue(type=0, index=-1), "index is -1; 0 to 255"),
        ("gps_rtk/send_rtcm", msg.RTCM(data=bytes(721)), "data is 721 bytes; at most 720"),
        ("adsb/send", msg.ADSBVehicle(latitude=300.0), "ADSB_VEHICLE.lat is 3000000000;"),
        ("hil/gps", msg.HilGPS(vn=400), "HIL_GPS.vn is 40000; -32768 to 32767"),
    ],
)
def test_values_out_of_range_are_rejected_by_name(bench, caplog, topic, ros, said):
    bench.call(topic, ros)
    assert bench.received() == []
    assert f"/iris_0/mavros/{topic}: {said}" in caplog.text


def test_nothing_is_requested_without_a_subscriber(bench):
    assert bench.link.wanted == {MESSAGE_ID[name] for name in (
        "HEARTBEAT", "STATUSTEXT", "EVENT", "HOME_POSITION", "MISSION_CURRENT", "MISSION_ITEM_REACHED",
        "GPS_GLOBAL_ORIGIN", "LOG_ENTRY", "LOG_DATA")}  # fmt: skip
    assert not bench.link.from_any_sender


def test_any_bytes_make_a_message_that_can_be_sent(bench, caplog):
    """Any payload yields a ROS message that can be serialised, although its fields are narrower in places."""
    dice = random.Random(1)
    bench.take(*(row[1] for row in OUT), "esc_info", "esc_status", "odometry/in")
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for name in sorted({row[0].msgname for row in OUT} | {"ESC_INFO", "ESC_STATUS", "ODOMETRY"}):
        kind = MESSAGES[MESSAGE_ID[name]]
        for _ in range(10):
            payload = dice.choice([dice.randbytes(kind.unpacker.size), b"\xff" * kind.unpacker.size])
            header = mavlink.MAVLink_message(kind.id, name)
            bench.send_raw(bytes(header._pack(packer, kind.crc_extra, payload)))
    published = [m for publisher in bench.ros.publishers.values() for m in publisher.messages]
    assert len(published) > 200
    for ros in published:
        ros.serialize(io.BytesIO())


class TestBothWays:
    """Sent and received messages are equal."""

    def back(self, bench, topic, ros, out):
        bench.take(out)
        bench.call(topic, ros)
        datagram = bench.fcu.recv(65535)
        bench.send_raw(datagram)  # only messages open to any sender are accepted from component 240
        return bench.published(out)

    @pytest.mark.parametrize(
        ("topic", "out", "ros"),
        [
            ("adsb/send", "adsb/vehicle", filled(msg.ADSBVehicle, ICAO_address=1, callsign="D-EABC", latitude=-47.5,
             longitude=8.25, altitude=1500.5, heading=359.5, ver_velocity=-1.25, tslc__secs=9, squawk=7000)),
            ("tunnel/in", "tunnel/out", filled(msg.Tunnel, target_system=3, payload_type=9, payload_length=3,
             payload=[1, 2, 3] + [0] * 125)),
            *[("debug_value/send", f"debug_value/{name}", filled(msg.DebugValue, type=type_, header__stamp__secs=3,
               **values)) for type_, (name, values) in enumerate({
                   "debug": {"index": 9, "array_id": -1, "value_float": 0.5},
                   "debug_vector": {"index": -1, "array_id": -1, "name": "abc", "data": [1.0, -2.0, 3.0]},
                   "debug_float_array": {"index": -1, "array_id": 5, "name": "abc", "data": [0.25] * 58},
                   "named_value_float": {"index": -1, "array_id": -1, "name": "abc", "value_float": 0.5},
                   "named_value_int": {"index": -1, "array_id": -1, "name": "abc", "value_int": -7}}.items())],
        ],
    )  # fmt: skip
    def test_information(self, bench, topic, out, ros):
        [got] = self.back(bench, topic, ros, out)
        for name in ros.__slots__[1:]:  # all fields except header, or target_system
            assert plain(getattr(got, name)) == plain(getattr(ros, name))

    @given(
        position=st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3),
        angles=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
        velocity=st.tuples(*[st.floats(-100, 100, width=32)] * 3),
        parent=st.sampled_from([1, 20]),
        child=st.sampled_from([1, 8, 12, 20]),
    )
    @settings(max_examples=60, deadline=None)
    def test_odometry(self, shared, position, angles, velocity, parent, child):
        """Velocities are in body axes, in whichever frame the autopilot sends them."""
        q = frames.quaternion_from_rpy(*angles)
        out = filled(Odometry, pose__pose__position=position, pose__pose__orientation=q,
                     twist__twist__linear=velocity, twist__twist__angular=velocity)  # fmt: skip
        out.pose.covariance = [1.0 if i == j else 0.0 for i in range(6) for j in range(6)]
        out.twist.covariance = [float(i + 1) if i == j else 0.0 for i in range(6) for j in range(6)]
        shared.received()
        shared.call("odometry/out", out)
        [sent] = shared.received()
        assert (sent.frame_id, sent.child_frame_id) == (20, 12)
        sent.frame_id, sent.child_frame_id = parent, child
        if child in (1, 20):  # as PX4 v1.14 does
            sent.vx, sent.vy, sent.vz = frames.rotate(tuple(sent.q), (sent.vx, sent.vy, sent.vz))
            sent.velocity_covariance[1:6] = [NAN] * 5
            sent.velocity_covariance[0] = sent.velocity_covariance[6] = sent.velocity_covariance[11] = 4.0
        shared.take("odometry/in")
        shared.send(sent)
        [got] = shared.published("odometry/in")
        assert plain(got.pose.pose.position) == pytest.approx(position, rel=1e-6)
        assert agrees(plain(got.pose.pose.orientation), plain(out.pose.pose.orientation))
        assert plain(got.twist.twist.linear) == pytest.approx(velocity, rel=1e-4, abs=1e-4)
        assert plain(got.twist.twist.angular) == pytest.approx(velocity)
        linear = [got.twist.covariance[i] for i in (0, 7, 14)]
        assert linear == pytest.approx([4.0] * 3 if child in (1, 20) else [1.0, 2.0, 3.0], rel=1e-4)
        assert list(got.pose.covariance) == pytest.approx(list(out.pose.covariance), abs=1e-6)

    def test_landing_target(self, bench):
        pose = filled(PoseStamped, **POSE | {"header__stamp__secs": 9})
        bench.take("landing_target/pose_in")
        bench.call("landing_target/pose", pose)
        [sent] = bench.received()
        bench.send(sent)
        [got] = bench.published("landing_target/pose_in")
        assert plain(got.pose.position) == (1.0, 2.0, 3.0)
        assert agrees(plain(got.pose.orientation), Q_ENU)


class TestOdometryFrames:
    """Computed by hand: heading east, flying north at 2 m/s is flying left."""

    def send(self, bench, frame, child):
        east = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
        bench.take("odometry/in")
        velocity = [1.0, *[NAN] * 5, 4.0, *[NAN] * 14]
        bench.send(made("ODOMETRY", time_usec=US, frame_id=frame, child_frame_id=child, q=east, vx=2.0, vz=-1.0,
                        pose_covariance=[NAN] * 21, velocity_covariance=velocity))  # fmt: skip
        return bench.published("odometry/in")

    def test_px4_v1_14(self, bench, caplog):
        [got] = self.send(bench, 1, 1)
        assert plain(got.twist.twist.linear) == pytest.approx((0.0, 2.0, 1.0), abs=1e-6)
        assert [got.twist.covariance[i] for i in (0, 7)] == pytest.approx([4.0, 1.0])  # north is left: y
        assert (got.header.frame_id, got.child_frame_id, list(got.pose.covariance)) == ("map", "base_link", [0.0] * 36)
        assert not caplog.records

    def test_an_unknown_frame_is_reported(self, bench, caplog):
        assert self.send(bench, 1, 21) == []
        assert "ODOMETRY in frames 1, 21 is not published" in caplog.text


class TestFromAnyone:
    """Radio, traffic and programs use system ids of their own."""

    def test_radio_status_is_published(self, bench):
        bench.take("radio_status", "gpsstatus/gps1/raw")
        radio = mavlink.MAVLink(None, srcSystem=ord("3"), srcComponent=ord("D"))
        bench.send_raw(bytes(made("RADIO_STATUS", rssi=1).pack(radio)) + bytes(made("GPS_RAW_INT").pack(radio)))
        assert len(bench.published("radio_status")) == 1
        assert bench.published("gpsstatus/gps1/raw") == []  # the GPS of another vehicle


class TestEscs:
    """Six motors in two messages."""

    @pytest.fixture
    def escs(self):
        made_ = Bench(PLUGINS)
        yield made_
        made_.close()

    def test_both(self, escs):
        escs.take("esc_info", "esc_status")
        for index in (0, 4, 0, 4):
            escs.send(
                made("ESC_INFO", index=index, time_usec=US, counter=7, count=6, connection_type=2, info=63,
                     temperature=[2550, 2600, 0, 0], error_count=[index, 1, 2, 3]),
                made("ESC_STATUS", index=index, time_usec=US, rpm=[index, -1, 2, 3], voltage=[16.0] * 4,
                     current=[1.5] * 4),
            )  # fmt: skip
        info, status = escs.published("esc_info")[-1], escs.published("esc_status")[-1]
        assert (info.counter, info.count, info.connection_type, info.info) == (7, 6, 2, 63)
        assert [item.temperature for item in info.esc_info] == [26, 26, 0, 0, 26, 26]
        assert [item.error_count for item in info.esc_info] == [0, 1, 2, 3, 4, 1]
        assert [item.rpm for item in status.esc_status] == [0, -1, 2, 3, 4, -1]
        assert status.esc_status[5].voltage == 16.0
        assert status.header.stamp.to_sec() == 5.0
        escs.uas.set_connected(True)
        escs.uas.set_connected(False)
        escs.send(made("ESC_STATUS", index=0))
        assert escs.published("esc_status")[-1].esc_status == []

    def test_the_status_alone(self, escs):
        escs.take("esc_status")
        escs.send(made("ESC_INFO", count=4), made("ESC_STATUS", rpm=[1, 2, 3, 4]))
        assert [item.rpm for item in escs.published("esc_status")[0].esc_status] == [1, 2, 3, 4]
        assert escs.published("esc_info") == []


class TestTexts:
    """Messages that pymavlink's dialect has no class for."""

    def test_a_tune_is_cut(self, bench):
        bench.call("play_tune", msg.PlayTuneV2(format=1, tune="ABC" * 100))
        frame = bench.fcu.recv(1000)
        assert frame[7:10] == (400).to_bytes(3, "little")
        assert frame[10:] [:6] == struct.pack("<IBB", 1, 1, 1)  # fmt: skip
        assert frame[16:-2] == b"ABC" * 82 + b"A"

    def test_cellular_status(self, bench):
        bench.call("cellular_status/status", msg.CellularStatus(1, 2, 3, 4, 5, 6, 7))
        frame = bench.fcu.recv(1000)
        assert frame[7:10] == (334).to_bytes(3, "little")
        assert frame[10:-2] == struct.pack("<HHHBBBB", 5, 6, 7, 1, 2, 3, 4)

    @pytest.mark.parametrize(("number", "seed"), [(334, 72), (400, 110)])
    def test_checksum_seeds_are_mavlinks(self, number, seed):
        assert MESSAGES[number].crc_extra == seed


class TestRtcm:
    """RTCM corrections in fragments."""

    @pytest.mark.parametrize("size", [0, 1, 180, 181, 360, 720])
    def test_fragments(self, bench, size):
        data = bytes(i % 251 for i in range(size))
        bench.call("gps_rtk/send_rtcm", filled(msg.RTCM, header__seq=33, data=data))
        sent = bench.received()
        assert b"".join(bytes(m.data[: m.len]) for m in sent) == data
        expected = [0] if size <= 180 else [1 | number << 1 for number in range(len(sent))]
        assert [m.flags for m in sent] == [1 << 3 | flags for flags in expected]  # 33 in five bits
        assert len(sent) == max(1, math.ceil(size / 180))


class TestObstacles:
    """Scans of more rays than MAVLink has bins."""

    @pytest.mark.parametrize("rays", [73, 100, 143, 144, 145, 360, 1081])
    def test_each_ray_is_in_a_bin_that_is_no_farther(self, rays):
        dice = random.Random(rays)
        ranges = [dice.choice([NAN, INF, -1.0, 0.0, dice.uniform(0.01, 600.0)]) for _ in range(rays)]
        found = bins(ranges)
        starts = [math.floor(i * rays / 72) for i in range(72)]
        for i, value in enumerate(ranges):
            if 0.0 < value < INF:
                assert found[bisect.bisect_right(starts, i) - 1] <= value * 100.0
        assert set(found) <= {int(v * 100.0) for v in ranges if 0.0 < v < INF} | {65535}

    def test_a_scan_may_turn_the_other_way(self, bench):
        bench.call("obstacle/send", filled(LaserScan, angle_increment=-math.pi / 36, range_max=INF))
        [sent] = bench.received()
        assert (sent.increment, sent.increment_f, sent.max_distance) == (0, pytest.approx(-5.0), 65535)

    def test_twice_as_many(self):
        assert bins([3.0, 2.0, NAN, INF] * 36) == [200, 65535] * 36


class TestDistanceSensors:
    """Sensors by parameter."""

    def test_the_transform(self, bench):
        bench.ros.publishers["/tf"].connections = 1
        bench.take("distance_sensor/down")
        bench.send(made("DISTANCE_SENSOR", time_boot_ms=5000, orientation=25))
        [[transform]] = [m.transforms for m in bench.ros.publishers["/tf"].messages]
        assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "lidar")
        assert plain(transform.transform.translation) == (0.0, 0.0, -0.1)
        assert agrees(plain(transform.transform.rotation), frames.quaternion_from_rpy(0.0, math.radians(270.0), 0.0))

    @pytest.mark.parametrize("values", [{"orientation": 24}, {"orientation": 25, "type": 9}, {"id": 7}])
    def test_distance_sensors_of_other_id_or_type_are_rejected(self, bench, caplog, values):
        bench.take("distance_sensor/down")
        bench.send(made("DISTANCE_SENSOR", **values))
        assert bench.published("distance_sensor/down") == []
        assert "no sensor has id 7" in caplog.text or "DISTANCE_SENSOR of type" in caplog.text

    def test_orientations_are_mavlinks(self):
        assert turn(0) == turn(100) == (1.0, 0.0, 0.0, 0.0)
        assert agrees(turn(38), frames.quaternion_from_rpy(*map(math.radians, (90.0, 68.0, 293.0))))

    def test_the_variance_is_of_the_last_ranges(self, bench):
        for distance in (1.0, 3.0):
            bench.call("distance_sensor/sonar", filled(Range, range=distance))
        assert bench.received()[-1].covariance > 0

    @pytest.mark.parametrize(
        ("sensor", "said"),
        [
            ({"frame_id": "a", "field_of_view": 1.0}, "distance_sensor/x/id: it is not set"),
            ({"id": 1, "field_of_view": 1.0}, "distance_sensor/x/frame_id: it is not set"),
            ({"id": 1, "frame_id": "a"}, "distance_sensor/x/field_of_view: it is not set"),
            ({"id": 1, "subscriber": True}, "distance_sensor/x/orientation: it is not set"),
            ({"id": 1, "subscriber": True, "orientation": "UP"}, "'UP' is not allowed; NONE, YAW_45"),
        ],
    )
    def test_an_invalid_setting_is_reported(self, sensor, said):
        with pytest.raises(ValueError, match=re.escape(said)):
            Bench([kind for kind in PLUGINS if kind.name == "distance_sensor"], {"distance_sensor": {"x": sensor}})


class TestFakeGps:
    """Positions in metres, converted to a fix."""

    def fixes(self, params, topic, kind, path, stamps=((5, 0.0), (6, 3.0))):
        bench = Bench(
            [kind_ for kind_ in PLUGINS if kind_.name == "fake_gps"],
            {"fake_gps": params, "global_position": {"geoid": "none"}},
        )
        for seconds, east in stamps:
            bench.ros.time_ns = seconds * 1_000_000_000
            bench.call(
                f"fake_gps/{topic}", filled(kind, header__stamp__secs=seconds, **{path: (east, 4.0 * east / 3, 0.0)})
            )
        sent = bench.received()
        bench.close()
        return sent

    def test_the_velocity_is_the_change_of_the_position(self):
        _, second = self.fixes({"fix_type": 3}, "mocap/tf", TransformStamped, "transform__translation")
        assert (second.vn, second.ve, second.vd, second.vel) == (400, 300, 0, 500)
        assert (second.cog, second.fix_type) == (3687, 3)  # atan(3/4)
        assert second.lat - 473667000 == pytest.approx(4.0 / 111_195 * 1e7, rel=2e-3)

    def test_at_most_five_a_second(self):
        stamps = [(5, 0.0), (5, 1.0), (6, 0.0)]
        assert len(self.fixes({}, "mocap/tf", TransformStamped, "transform__translation", stamps)) == 2

    def test_gps_input(self):
        params = {"use_hil_gps": False, "mocap_transform": False, "eph": 0.0, "gps_id": 2}
        first, second = self.fixes(params, "mocap/pose", PoseStamped, "pose__position")
        assert first.ignore_flags == 2 | 8 | 16 | 32
        assert (second.ignore_flags, second.gps_id, second.alt) == (2 | 16 | 32, 2, pytest.approx(408.0))
        assert (second.vn, second.ve) == pytest.approx((4.0, 3.0))

    @pytest.mark.parametrize(
        ("params", "topic", "kind"),
        [
            ({"use_mocap": False, "use_vision": True}, "vision", PoseStamped),
            ({"mocap_transform": False, "mocap_withcovariance": True}, "mocap/pose_cov", PoseWithCovarianceStamped),
        ],
    )
    def test_other_sources(self, params, topic, kind):
        path = "pose__position" if kind is PoseStamped else "pose__pose__position"
        assert len(self.fixes(params, topic, kind, path)) == 2


def test_rates_are_to_be_positive():
    with pytest.raises(ValueError, match=re.escape("fake_gps/gps_rate: 0.0 Hz is not allowed")):
        Bench([kind for kind in PLUGINS if kind.name == "fake_gps"], {"fake_gps": {"gps_rate": 0}})


@pytest.mark.parametrize(
    ("params", "topic", "kind"),
    [
        ({"vision_speed": {"twist_cov": False}}, "vision_speed/speed_twist", TwistStamped),
        ({"vision_speed": {"listen_twist": False}}, "vision_speed/speed_vector", Vector3Stamped),
        ({"landing_target": {"listen_lt": True}}, "landing_target/raw", msg.LandingTarget),
    ],
)
def test_topics_by_parameter(params, topic, kind):
    bench = Bench([k for k in PLUGINS if k.name in ("vision_speed_estimate", "landing_target")], params)
    assert bench.ros.kinds[f"/iris_0/mavros/{topic}"] is kind
    bench.call(topic, kind())
    assert len(bench.received()) == 1
    bench.close()


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"obstacle": {"mav_frame": "BODY"}}, "obstacle/mav_frame: 'BODY' is not a MAVLink frame; GLOBAL, LOCAL_NED"),
        ({"landing_target": {"land_target_type": "X"}}, "'X' is not allowed; LIGHT_BEACON"),
    ],
)
def test_names_unknown_to_mavlink_are_reported(params, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        Bench([k for k in PLUGINS if k.name in ("obstacle_distance", "landing_target")], params)


def test_the_shipped_settings_are_valid():
    Bench(PLUGINS, yaml.safe_load((CONFIG / "px4_config.yaml").read_text())).close()


def test_the_list_of_omissions_names_plugins():
    denied = yaml.safe_load((CONFIG / "px4_pluginlists.yaml").read_text())
    assert set(denied["plugin_denylist"]) < {kind.name for kind in PLUGINS}
    bench = Bench(PLUGINS, denied)
    kept = {plugin.name for plugin in bench.uas.plugins}
    assert not kept & set(denied["plugin_denylist"])
    assert {"esc_status", "gps_status", "landing_target", "px4flow"} < kept
    bench.close()


def test_silent_topics(bench):
    kinds = {"esc_telemetry": msg.ESCTelemetry, "mag_calibration/status": UInt8}
    assert {name: bench.ros.kinds[f"/iris_0/mavros/{name}"] for name in kinds} == kinds


class TestTimesync:
    """timesync_status in simulation."""

    def test_clocks_are_compared_while_the_status_has_a_subscriber(self):
        bench = Bench(PLUGINS)
        bench.uas.step(0)
        assert not [m for m in bench.received() if m.get_type() == "TIMESYNC"]
        bench.take("timesync_status")
        requests = []
        for millis in range(0, 1000, 20):
            bench.ros.time_ns = 10**9 + millis * 1_000_000
            bench.uas.step(bench.ros.time_ns)
            requests += [m for m in bench.received() if m.get_type() == "TIMESYNC"]
        assert len(requests) == 10  # Hz
        bench.ros.time_ns = requests[-1].ts1 + 20_000_000
        bench.send(made("TIMESYNC", tc1=requests[-1].ts1 + 30_000_000, ts1=requests[-1].ts1))
        [status] = bench.published("timesync_status")
        assert status.round_trip_time_ms == pytest.approx(20.0)
        assert status.observed_offset_ns == status.estimated_offset_ns == -20_000_000
        assert status.remote_timestamp_ns == requests[-1].ts1 + 30_000_000
        assert bench.uas.time_offset_ns == 0  # stamps stay the simulation's
        bench.close()


class TestServices:
    """Commands, and information on the vehicle."""

    @pytest.fixture
    def call(self):
        """Return a function that calls a service while a thread plays the autopilot."""
        bench = Bench(PLUGINS)
        bench.send(made("HEARTBEAT", type=2, autopilot=12, base_mode=0x81, custom_mode=6 << 16, system_status=4))
        bench.received()

        def call(service, request, *answers):
            got = []

            def autopilot():
                bench.fcu.settimeout(5.0)
                while not got:
                    got.extend(bench._parser.parse_buffer(bench.fcu.recv(1000)) or [])
                bench.fcu.setblocking(False)
                ack = made("COMMAND_ACK", command=got[0].command)
                bench.fcu.sendto(b"".join(map(bench.frame, (*answers, ack))), ("127.0.0.1", bench.link.port))
                bench.link.read()

            thread = threading.Thread(target=autopilot)
            thread.start()
            response = bench.ros.services[f"/iris_0/mavros/{service}"](request)
            thread.join()
            return response, got[0], bench

        yield call
        bench.close()

    @pytest.mark.parametrize(
        ("service", "request_", "number", "params"),
        [
            ("cmd/trigger_control", srv.CommandTriggerControlRequest(True, False, True), 2003, (1.0, 0.0, 1.0)),
            ("cmd/trigger_interval", srv.CommandTriggerIntervalRequest(100.0, 5.0), 214, (100.0, 5.0, 0.0)),
            ("cmd/vtol_transition", srv.CommandVtolTransitionRequest(state=4), 3000, (4.0, 0.0, 0.0)),
        ],
    )
    def test_commands(self, call, service, request_, number, params):
        response, sent, _ = call(service, request_)
        assert (response.success, response.result) == (True, 0)
        assert (sent.get_type(), sent.command) == ("COMMAND_LONG", number)
        assert (sent.param1, sent.param2, sent.param3) == params

    def test_command_int_does_not_wait(self, bench):
        request = srv.CommandIntRequest(frame=6, command=195, param1=1.0, x=473977420, y=85455940, z=10.0)
        assert bench.ros.services["/iris_0/mavros/cmd/command_int"](request).success
        [sent] = bench.received()
        assert (sent.get_type(), sent.command, sent.frame, sent.x, sent.z) == ("COMMAND_INT", 195, 6, 473977420, 10.0)
        assert (sent.target_system, sent.target_component) == (1, 1)

    def test_command_ack_is_sent(self, bench):
        request = srv.CommandAckRequest(command=2000, result=5, progress=50, result_param2=2**32 - 3)
        response = bench.ros.services["/iris_0/mavros/cmd/command_ack"](request)
        assert (response.success, response.result) == (True, 0)
        [sent] = bench.received()
        assert (sent.command, sent.result, sent.progress, sent.result_param2) == (2000, 5, 50, -3)
        assert (sent.target_system, sent.target_component) == (1, 1)

    def test_the_old_component_is_addressed_on_request(self):
        bench = Bench(PLUGINS, {"cmd": {"use_comp_id_system_control": True}})
        bench.ros.services["/iris_0/mavros/cmd/command_int"](srv.CommandIntRequest())
        assert bench.received()[-1].target_component == 250
        bench.close()

    def test_vehicle_info(self, call):
        version = made("AUTOPILOT_VERSION", capabilities=0xE4EF, flight_sw_version=0x010E03FF, board_version=1, uid=77,
                       flight_custom_version=[0xEF, 0xBE, 0, 0, 0, 0, 0, 0x12], vendor_id=3, product_id=4)  # fmt: skip
        response, sent, bench = call("vehicle_info_get", srv.VehicleInfoGetRequest(), version)
        assert (sent.command, sent.param1) == (520, 1.0)
        [info] = response.vehicles
        assert (response.success, info.available_info, info.sysid, info.compid) == (True, 3, 1, 1)
        assert (info.mode, info.mode_id, info.type, info.autopilot) == ("OFFBOARD", 6 << 16, 2, 12)
        assert (info.capabilities, info.flight_sw_version, info.uid) == (0xE4EF, 0x010E03FF, 77)
        assert info.flight_custom_version == "120000000000beef"
        again = bench.ros.services["/iris_0/mavros/vehicle_info_get"]
        assert again(srv.VehicleInfoGetRequest(get_all=True, sysid=9)).vehicles == [info]
        assert not again(srv.VehicleInfoGetRequest(sysid=9, compid=1)).success
        assert bench.received() == []  # the answer is cached by now

    def test_nothing_is_known_before_the_first_heartbeat(self, bench):
        info = bench.ros.services["/iris_0/mavros/vehicle_info_get"]
        assert not info(srv.VehicleInfoGetRequest()).success
        everyone = info(srv.VehicleInfoGetRequest(get_all=True))
        assert (everyone.success, everyone.vehicles) == (True, [])


def test_an_inverted_gimbal_is_corrected():
    bench = Bench(PLUGINS, {"mount_control": {"negate_measured_pitch": True}})
    bench.take("mount_control/orientation")
    bench.send(made("MOUNT_ORIENTATION", roll=10.0, pitch=20.0, yaw=30.0))
    [q] = bench.published("mount_control/orientation")
    assert agrees(plain(q), frames.quaternion_from_rpy(*map(math.radians, (10.0, -20.0, 30.0))))
    bench.close()


def test_the_global_pose_is_a_transform_on_request():
    bench = Bench(PLUGINS, {"global_position": {"tf": {"send": True, "child_frame_id": "body"}}})
    bench.ros.publishers["/tf"].connections = 1
    bench.uas.refresh()
    bench.send(
        made("ATTITUDE_QUATERNION", q1=Q_NED[0], q2=Q_NED[1], q3=Q_NED[2], q4=Q_NED[3]),
        made("HOME_POSITION", latitude=473977420, longitude=85455940, q=[1, 0, 0, 0]),
        made("GLOBAL_POSITION_INT", time_boot_ms=5000, lat=473977420, lon=85455940, relative_alt=2000),
    )
    [[transform]] = [m.transforms for m in bench.ros.publishers["/tf"].messages]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "body")
    assert plain(transform.transform.translation) == pytest.approx((0.0, 0.0, 2.0), abs=1e-6)
    assert agrees(plain(transform.transform.rotation), Q_ENU)
    bench.close()


@given(
    st.tuples(*[st.floats(-1e5, 1e5)] * 3),
    st.tuples(st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-100.0, 9000.0)),
)
@settings(max_examples=100, deadline=None)
def test_places_on_earth_are_inverse(position, origin):
    assert frames.geodetic_to_enu(frames.enu_to_geodetic(position, origin), origin) == pytest.approx(position, abs=1e-5)
