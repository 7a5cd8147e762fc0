"""MAVLink frames as topics in both directions, and /diagnostics."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavros_fakes import Bench
from mavros_msgs.msg import Mavlink
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.link.raw_frames import RawFrameError, fill, to_frame
from xtdrone_mavros.plugins import PLUGINS

HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0x91, 6 << 16, 4, 3)


@pytest.fixture
def bench():
    made = Bench(PLUGINS)
    yield made
    made.close()


def raw(frame):
    message = Mavlink()
    fill(message, frame)
    return message


def test_a_frame_by_hand():
    packer = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    packer.seq = 5
    frame = bytes(mavlink.MAVLink_command_ack_message(0x0102, 4).pack(packer))
    message = raw(frame)
    assert (message.magic, message.len, message.seq, message.sysid, message.compid, message.msgid) == (
        253,
        3,
        5,
        7,
        1,
        77,
    )
    assert (message.incompat_flags, message.compat_flags, message.framing_status) == (0, 0, Mavlink.FRAMING_OK)
    assert list(message.payload64) == [0x040102]
    assert message.checksum == struct.unpack("<H", frame[-2:])[0]
    assert len(message.signature) == 0


@given(
    st.sampled_from([(1, 0), (2, 0), (2, 1)]),
    st.integers(0, 255),
    st.integers(0, 0xFF),
    st.binary(max_size=255),
    st.integers(0, 0xFFFF),
)
def test_a_frame_round_trips(kind, sequence, number, payload, checksum):
    version, signed = kind
    ids = bytes([sequence, 7, 1, number])
    if version == 1:
        frame = bytes([254, len(payload)]) + ids + payload
    else:
        frame = bytes([253, len(payload), signed, 0]) + ids + b"\x01\x02" + payload
    frame += struct.pack("<H", checksum) + bytes(range(13)) * signed
    message = raw(frame)
    assert to_frame(message) == frame
    assert message.msgid == (number if version == 1 else number | 0x020100)


def test_a_damaged_frame_is_marked(bench):
    frame = bytearray(bench.frame(HEARTBEAT))
    frame[12] ^= 1
    assert raw(bytes(frame)).framing_status == Mavlink.FRAMING_BAD_CRC


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"magic": 253, "len": 9, "payload64": [1]}, "len is 9, but payload64 has 8 bytes"),
        ({"magic": 253, "incompat_flags": 1}, "0 bytes; 13 if it is signed"),
        ({"magic": 254, "msgid": 256}, "magic 254 with msgid 256"),
        ({"magic": 0}, "magic 0"),
    ],
)
def test_invalid_frames_are_rejected(bench, caplog, fields, said):
    with pytest.raises(RawFrameError, match=said):
        to_frame(Mavlink(**fields))
    bench.ros.subscribers["/iris_0/mavlink/to"](Mavlink(**fields))
    assert said in caplog.text
    assert bench.received() == []


def test_a_frame_goes_to_the_autopilot_as_it_is(bench):
    packer = mavlink.MAVLink(None, srcSystem=42, srcComponent=191)
    bench.ros.subscribers["/iris_0/mavlink/to"](raw(bytes(HEARTBEAT.pack(packer))))
    [got] = bench.received()
    assert (got.get_type(), got.get_srcSystem(), got.custom_mode) == ("HEARTBEAT", 42, 6 << 16)
    assert bench.link.sent == 1


def test_frames_are_published_to_subscribers(bench):
    topic = bench.ros.publishers["/iris_0/mavlink/from"]
    position = mavlink.MAVLink_local_position_ned_message(12345, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125)
    bench.send(HEARTBEAT, position)
    bench.uas.refresh()
    asked = {m.param1: m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG"}
    assert asked[32] == -1.0
    assert topic.messages == []
    topic.connections = 1
    bench.uas.refresh()
    asked = {m.param1: m.param2 for m in bench.received() if m.get_type() == "COMMAND_LONG"}
    assert asked == {32: 0.0}, "what was switched off comes again"
    bench.send(HEARTBEAT, position)
    bench.uas.refresh()
    assert [message.msgid for message in topic.messages] == [0, 32]
    assert bench.received() == [], "and is not switched off"


class TestDiagnostics:
    """/diagnostics."""

    def listen(self, bench):
        bench.ros.publishers["/diagnostics"].connections = 1
        bench.uas.refresh()
        bench.uas.step(0)  # counting begins here

    def statuses(self, bench, seconds=1.0):
        bench.ros.time_ns += round(seconds * 1e9)
        bench.uas.step(bench.ros.time_ns)
        [message] = bench.ros.publishers["/diagnostics"].messages
        bench.ros.publishers["/diagnostics"].messages.clear()
        found = {}
        for status in message.status:
            assert status.name.startswith("iris_0/mavros: ")
            assert status.hardware_id.startswith("udp://:")
            values = {value.key: value.value for value in status.values}
            found[status.name.partition(": ")[2]] = status.level, status.message, values
        return found

    def test_nothing_without_a_subscriber(self, bench):
        for second in range(3):
            bench.uas.step(second * 1_000_000_000)
        assert bench.ros.publishers["/diagnostics"].messages == []
        assert not {1, 24, 111, 147} & bench.link.wanted
        assert "TIMESYNC" not in [m.get_type() for m in bench.received()]

    def test_before_the_first_message(self, bench):
        self.listen(bench)
        found = self.statuses(bench)
        assert {name: entry[:2] for name, entry in found.items()} == {
            "FCU connection": (1, "not connected"),
            "GPS": (2, "No satellites"),
            "Heartbeat": (2, "No events recorded."),
            "System": (0, "Normal"),
            "Battery": (2, "No data"),
            "Time Sync": (2, "No events recorded."),
        }

    def test_clocks_are_compared_in_simulation_while_there_is_a_subscriber(self, bench):
        self.listen(bench)
        bench.received()
        bench.ros.time_ns = 100_000_000
        bench.uas.step(bench.ros.time_ns)
        [request] = [m for m in bench.received() if m.get_type() == "TIMESYNC"]
        bench.ros.time_ns += 20_000_000
        bench.send(mavlink.MAVLink_timesync_message(request.ts1 + 10_000_000, request.ts1))
        level, text, values = self.statuses(bench)["Time Sync"]
        assert (level, text, values["Last RTT (ms)"]) == (0, "Normal", "20.000000")
        assert values["Estimated time offset (s)"] == "0.000000000", "stamps stay the simulation's"

    def test_in_flight(self, bench):
        self.listen(bench)
        cells = [4100, 4000, 3900] + [65535] * 7
        bench.send(
            HEARTBEAT,
            mavlink.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 120, 65535, 0, 0, 11),
            mavlink.MAVLink_sys_status_message(3, 3, 1, 400, 12000, -1, 87, 5, 6, 7, 8, 9, 10),
            mavlink.MAVLink_battery_status_message(0, 0, 1, 32767, cells, 1250, -1, -1, 87),
        )
        found = self.statuses(bench)
        level, text, values = found["FCU connection"]
        assert (level, text, values["Received packets:"], values["Dropped packets:"]) == (0, "connected", "4", "0")
        assert float(values["Rx speed:"]) == int(values["Rx total bytes:"]) > 0
        level, text, values = found["Heartbeat"]
        assert (level, text, float(values["Frequency (Hz)"])) == (0, "Normal", 1.0)
        assert (values["Vehicle type"], values["Autopilot type"]) == ("Quadrotor", "PX4 Autopilot")
        assert (values["Mode"], values["System status"]) == ("OFFBOARD", "Active")
        assert found["GPS"][:2] == (0, "3D fix")
        assert found["GPS"][2] == {"Satellites visible": "11", "Fix type": "3", "EPH (m)": "1.20", "EPV (m)": "Unknown"}
        level, text, values = found["System"]
        assert (level, text) == (2, "Sensor health")
        assert (values["Sensor health"], values["3D gyro"], values["3D accelerometer"]) == ("0x00000001", "Ok", "Fail")
        assert (values["CPU Load (%)"], values["Errors count #4"]) == ("40.0", "10")
        level, text, values = found["Battery"]
        assert (level, text, values["Voltage"], values["Current"]) == (0, "Normal", "12.00", "-12.5")
        assert (values["Remaining"], values["Cell 2"]) == ("87.0", "4.00")

    def test_lost_frames_are_counted(self, bench):
        self.listen(bench)
        bench.send(HEARTBEAT)
        bench.frame(HEARTBEAT)  # created, but never sent
        bench.send(HEARTBEAT)
        assert self.statuses(bench)["FCU connection"][:2] == (1, "1 packages dropped since last report")
        assert self.statuses(bench)["FCU connection"][0] == 0

    def test_settings(self):
        bench = Bench(PLUGINS, {"sys": {"min_voltage": [16.2, 16.0]}, "plugin_denylist": ["global_position"]})
        self.listen(bench)
        bench.send(mavlink.MAVLink_battery_status_message(1, 0, 1, 32767, [12000] + [65535] * 9, -1, -1, -1, 87))
        found = self.statuses(bench)
        assert found["Battery 2"][:2] == (1, "Low voltage")
        assert "GPS" not in found
        bench.close()

    def test_clocks_are_compared_outside_simulation(self):
        bench = Bench(PLUGINS, use_sim_time=False)
        self.listen(bench)
        bench.ros.time_ns = 500_000_000
        bench.send(mavlink.MAVLink_timesync_message(2_000_000_000, 400_000_000))
        level, text, values = self.statuses(bench, 0.5)["Time Sync"]
        assert (level, text, values["Last RTT (ms)"]) == (0, "Normal", "100.000000")
        assert values["Estimated time offset (s)"] == "-1.550000000"
        bench.close()
