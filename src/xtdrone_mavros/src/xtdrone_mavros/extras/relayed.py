"""MAVROS's plugins that only relay messages, as tables. PX4 v1.14 in simulation sends few of these by default.

HIL_RC_INPUTS_RAW has microseconds, as MAVLink defines; MAVROS wrongly divides them by a hundred.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped
from mavros_msgs.msg import (
    GPSINPUT,
    GPSRAW,
    GPSRTK,
    ADSBVehicle,
    CellularStatus,
    CompanionProcessStatus,
    ESCTelemetry,
    HilActuatorControls,
    HilControls,
    HilGPS,
    HilSensor,
    HilStateQuaternion,
    MagnetometerReporter,
    NavControllerOutput,
    OnboardComputerStatus,
    OpticalFlowRad,
    PlayTuneV2,
    RadioStatus,
    RCIn,
    TerrainReport,
    Tunnel,
    Vibration,
)
from pymavlink.dialects.v20 import common as mavlink
from rospy import Duration
from std_msgs.msg import UInt8

from xtdrone_common import frames
from xtdrone_mavros.link.ros_values_to_mavlink import FieldError, whole
from xtdrone_mavros.relayed_messages import In, Out, Relay, relay, text, wrap_bits
from xtdrone_mavros.uas import Plugin, Uas

Fields = Mapping[str, Any]

_UNKNOWN_U8, _UNKNOWN_U16, _UNKNOWN_U32 = 0xFF, 0xFFFF, 0xFFFFFFFF
_PAYLOAD = 128  # bytes of a TUNNEL
_RC_CHANNELS = 12
_GAUSS = 1e4  # per tesla
_HECTOPASCAL = 1e-2  # per pascal
_HIL_GPS_CENTI = ("eph", "epv", "vel", "vn", "ve", "vd", "cog")  # fields with hundredths in MAVLink
_BASELINE_FRAMES = {0: "earth", 1: "map"}  # RTK_BASELINE_COORDINATE_SYSTEM: ECEF, NED


def _dbm(rssi: int) -> float:
    return rssi / 1.9 - 127.0


def _radio(m: Any) -> Fields:
    return {"rssi_dbm": _dbm(m.rssi), "remrssi_dbm": _dbm(m.remrssi)}


TdrRadioPlugin = relay("3dr_radio", Out("RADIO_STATUS", "radio_status", RadioStatus, _radio, any_sender=True))


def _adsb_to_ros(m: Any) -> Fields:
    return {
        "callsign": m.callsign.rstrip("\0"),
        "latitude": m.lat / 1e7,
        "longitude": m.lon / 1e7,
        "altitude": m.altitude / 1e3,
        "heading": m.heading / 1e2,
        "hor_velocity": m.hor_velocity / 1e2,
        "ver_velocity": m.ver_velocity / 1e2,
        "tslc": Duration(m.tslc),
    }


def _adsb_to_mavlink(m: Any) -> Fields:
    return {
        "callsign": text(m.callsign, 8),  # characters; the field has 9 bytes with the terminating zero
        "lat": whole(m.latitude * 1e7),
        "lon": whole(m.longitude * 1e7),
        "altitude": whole(m.altitude * 1e3),
        "heading": whole(m.heading * 1e2),
        "hor_velocity": whole(m.hor_velocity * 1e2),
        "ver_velocity": whole(m.ver_velocity * 1e2),
        "tslc": m.tslc.secs,
    }


AdsbPlugin = relay(
    "adsb",
    Out("ADSB_VEHICLE", "adsb/vehicle", ADSBVehicle, _adsb_to_ros, any_sender=True),
    In("adsb/send", ADSBVehicle, "ADSB_VEHICLE", _adsb_to_mavlink),
)

CellularStatusPlugin = relay("cellular_status", In("cellular_status/status", CellularStatus, "CELLULAR_STATUS"))


def _companion(m: Any) -> Fields:
    return {
        "type": mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        "autopilot": mavlink.MAV_AUTOPILOT_PX4,
        "base_mode": mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
        "system_status": m.state,
        "mavlink_version": 3,
    }


CompanionProcessStatusPlugin = relay(
    "companion_process_status",
    In("companion_process/status", CompanionProcessStatus, "HEARTBEAT", _companion, as_component="component"),
)


class EscTelemetryPlugin(Plugin):
    """MAVROS's esc_telemetry: the topic is never published, because only ArduPilot sends the message."""

    name = "esc_telemetry"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        uas.topic("esc_telemetry", ESCTelemetry())


GpsInputPlugin = relay("gps_input", In("gps_input/gps_input", GPSINPUT, "GPS_INPUT", rate=("gps_input/gps_rate", 5.0)))


def _gps1(m: Any) -> Fields:
    return {"hdg_acc": wrap_bits(m.hdg_acc, 32), "dgps_numch": _UNKNOWN_U8, "dgps_age": _UNKNOWN_U32}


def _gps2(m: Any) -> Fields:
    return {"hdg_acc": wrap_bits(m.hdg_acc, 32)}


def _rtk(m: Any) -> Fields:
    return {
        "header.frame_id": _BASELINE_FRAMES.get(m.baseline_coords_type, ""),
        "wn": wrap_bits(m.wn, 16),
        "baseline_a": m.baseline_a_mm,
        "baseline_b": m.baseline_b_mm,
        "baseline_c": m.baseline_c_mm,
    }


GpsStatusPlugin = relay(
    "gps_status",
    Out("GPS_RAW_INT", "gpsstatus/gps1/raw", GPSRAW, _gps1, frame_id="/wgs84"),
    Out("GPS2_RAW", "gpsstatus/gps2/raw", GPSRAW, _gps2, frame_id="/wgs84"),
    Out("GPS_RTK", "gpsstatus/gps1/rtk", GPSRTK, _rtk),
    Out("GPS2_RTK", "gpsstatus/gps2/rtk", GPSRTK, _rtk),
)


def _xyz(v: Any) -> frames.Vector:
    return v.x, v.y, v.z


def _hil_state(m: Any) -> Fields:
    """Return HIL_STATE_QUATERNION; as in MAVROS, rates are converted from FLU to FRD and then again as if ENU."""
    q = m.orientation
    rates = frames.enu_to_ned(*frames.flu_to_frd(*_xyz(m.angular_velocity)))
    velocity = frames.enu_to_ned(*_xyz(m.linear_velocity))
    acceleration = frames.flu_to_frd(*_xyz(m.linear_acceleration))
    return {
        "attitude_quaternion": list(frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z)),
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), rates, strict=True)),
        **_place(m.geo),
        **{f"v{axis}": whole(value * 1e2) for axis, value in zip("xyz", velocity, strict=True)},
        **{f"{axis}acc": whole(value) for axis, value in zip("xyz", acceleration, strict=True)},
        "ind_airspeed": whole(m.ind_airspeed * 1e2),
        "true_airspeed": whole(m.true_airspeed * 1e2),
    }


def _place(geo: Any) -> Fields:
    """Return a position with its altitude unchanged: MAVROS does not apply the geoid here."""
    return {"lat": whole(geo.latitude * 1e7), "lon": whole(geo.longitude * 1e7), "alt": whole(geo.altitude * 1e3)}


def _hil_gps(m: Any) -> Fields:
    return {**_place(m.geo), **{name: getattr(m, name) * 100 for name in _HIL_GPS_CENTI}}


def _hil_sensor(m: Any) -> Fields:
    values: dict[str, Any] = {}
    for name, scale in (("acc", 1.0), ("gyro", 1.0), ("mag", _GAUSS)):
        vector = frames.flu_to_frd(*_xyz(getattr(m, name)))
        values |= {f"{axis}{name}": value * scale for axis, value in zip("xyz", vector, strict=True)}
    pressures = {name: getattr(m, name) * _HECTOPASCAL for name in ("abs_pressure", "diff_pressure")}
    return values | pressures


FLOW_GYRO = ("integrated_xgyro", "integrated_ygyro", "integrated_zgyro")  # NaN: not measured; PX4 sends it too


def convert_flow(m: Any) -> Fields:
    """Return the angles of either optical-flow message, converted between FRD and FLU (self-inverse)."""
    return {
        "integrated_y": -m.integrated_y,
        "integrated_ygyro": -m.integrated_ygyro,
        "integrated_zgyro": -m.integrated_zgyro,
    }


def _hil_flow(m: Any) -> Fields:
    return {**convert_flow(m), "sensor_id": 127, "temperature": m.temperature * 100}


def _hil_rc(m: Any) -> Fields:
    channels = [*m.channels, *[_UNKNOWN_U16] * _RC_CHANNELS][:_RC_CHANNELS]
    return {f"chan{i}_raw": value for i, value in enumerate(channels, 1)}


HilPlugin = relay(
    "hil",
    Out("HIL_CONTROLS", "hil/controls", HilControls),
    Out("HIL_ACTUATOR_CONTROLS", "hil/actuator_controls", HilActuatorControls),
    In("hil/state", HilStateQuaternion, "HIL_STATE_QUATERNION", _hil_state),
    In("hil/gps", HilGPS, "HIL_GPS", _hil_gps),
    In("hil/imu_ned", HilSensor, "HIL_SENSOR", _hil_sensor),
    In("hil/optical_flow", OpticalFlowRad, "HIL_OPTICAL_FLOW", _hil_flow, free=FLOW_GYRO),
    In("hil/rc_inputs", RCIn, "HIL_RC_INPUTS_RAW", _hil_rc),
)


def _compass(m: Any) -> Fields:
    return {"header.frame_id": str(m.compass_id), "report": m.cal_status, "confidence": m.orientation_confidence}


class MagCalibrationStatusPlugin(Relay):
    """MAVROS's mag_calibration_status.

    ``mag_calibration/status`` is never published, because only ArduPilot sends the progress. MAVROS publishes a report
    only after progress; here every report is published.
    """

    name = "mag_calibration_status"
    outs = (Out("MAG_CAL_REPORT", "mag_calibration/report", MagnetometerReporter, _compass, latch=True),)

    def __init__(self, uas: Uas) -> None:
        """Advertise the topics."""
        super().__init__(uas)
        uas.topic("mag_calibration/status", UInt8(), latch=True, on_demand=True)


NavControllerOutputPlugin = relay(
    "nav_controller_output", Out("NAV_CONTROLLER_OUTPUT", "nav_controller_output", NavControllerOutput)
)

OnboardComputerStatusPlugin = relay(
    "onboard_computer_status",
    In("onboard_computer/status", OnboardComputerStatus, "ONBOARD_COMPUTER_STATUS", as_component="component"),
)


def _tune(m: Any) -> Fields:
    return {"tune": text(m.tune, 247)}  # characters; the field has 248 bytes with the terminating zero


PlayTunePlugin = relay("play_tune", In("play_tune", PlayTuneV2, "PLAY_TUNE_V2", _tune))


def _terrain(m: Any) -> Fields:
    return {"latitude": m.lat / 1e7, "longitude": m.lon / 1e7}


TerrainPlugin = relay("terrain", Out("TERRAIN_REPORT", "terrain/report", TerrainReport, _terrain, frame_id="terrain"))


def _tunnel(m: Any) -> Fields:
    """Return the payload, padded with zeros.

    Raises:
        FieldError: the length exceeds the payload.
    """
    length = m.payload_length
    if length > _PAYLOAD:
        raise FieldError("TUNNEL.payload_length", length, f"0 to {_PAYLOAD}")
    return {"payload": [*m.payload[:length], *[0] * (_PAYLOAD - length)]}


TunnelPlugin = relay(
    "tunnel",
    Out("TUNNEL", "tunnel/out", Tunnel, _tunnel, any_sender=True),
    In("tunnel/in", Tunnel, "TUNNEL", _tunnel),
)


def _vibration(m: Any) -> Fields:
    # As in MAVROS, although these are magnitudes.
    x, y, z = frames.ned_to_enu(m.vibration_x, m.vibration_y, m.vibration_z)
    counts = [float(count) for count in (m.clipping_0, m.clipping_1, m.clipping_2)]
    return {"vibration.x": x, "vibration.y": y, "vibration.z": z, "clipping": counts}


class VibrationPlugin(Relay):
    """MAVROS's vibration."""

    name = "vibration"
    outs = (Out("VIBRATION", "vibration/raw/vibration", Vibration, _vibration),)

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        [topic] = self.topics.values()
        topic.message.header.frame_id = uas.params.get("vibration/frame_id", "base_link")


def _wind(m: Any) -> Fields:
    x, y, z = frames.ned_to_enu(m.wind_x, m.wind_y, m.wind_z)
    covariance = [0.0] * 36
    covariance[0], covariance[14] = m.var_horiz, m.var_vert  # x and y combined, according to MAVROS's comment
    linear = {"twist.twist.linear.x": x, "twist.twist.linear.y": y, "twist.twist.linear.z": z}
    return {**linear, "twist.covariance": covariance}


WindEstimationPlugin = relay("wind_estimation", Out("WIND_COV", "wind_estimation", TwistWithCovarianceStamped, _wind))

PASSED_ON: tuple[type[Plugin], ...] = (
    AdsbPlugin,
    CellularStatusPlugin,
    CompanionProcessStatusPlugin,
    EscTelemetryPlugin,
    GpsInputPlugin,
    GpsStatusPlugin,
    HilPlugin,
    MagCalibrationStatusPlugin,
    NavControllerOutputPlugin,
    OnboardComputerStatusPlugin,
    PlayTunePlugin,
    TdrRadioPlugin,
    TerrainPlugin,
    TunnelPlugin,
    VibrationPlugin,
    WindEstimationPlugin,
)
