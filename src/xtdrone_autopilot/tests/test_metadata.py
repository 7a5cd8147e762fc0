"""Metadata of events and parameters for ground stations: complete, in the clients' formats, served by FTP."""

from __future__ import annotations

import ast
import json
import math
import re
import struct
from pathlib import Path

import pytest
from autopilot_fakes import Flight
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.event_catalogue import CATALOGUE, CODES, ENUM_TYPES, MAX_ARGUMENTS
from xtdrone_autopilot.events.events import event, event_id
from xtdrone_autopilot.mavlink.microservices.files_and_logs.ftp import checksum
from xtdrone_autopilot.mavlink.wire.codec import decoder, split
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES
from xtdrone_autopilot.parameters import metadata
from xtdrone_autopilot.parameters.parameters import FIXED, INT32, NAMES, describe
from xtdrone_common import modes

# a module's file, not the package's: in a catkin workspace the package's is a stub in the devel space
_PACKAGE = Path(events.__file__).parents[1]
_SOURCES = [path for path in _PACKAGE.rglob("*.py") if "plans" not in path.parts]
_EVENT_NAME = re.compile(
    r"(commander|check|failsafe|rtl|logger|navigator_(rtl|takeoff|reposition|mis|mission)|mavlink_mission|mc_pos_ctrl|ekf2|"
    r"col_prev)_[a-z0-9_]+|"
    r"mission_(finished|not_valid|takeoff|do_jump|index)[a-z_]*|orbit_radius_exceeded"
)
_TELLING = {"tell", "_tell", "event", "_refuse", "Problem", "Check", "_go", "_announce", "_Destination"}


def literals():
    """Return every string literal in the sources, docstrings excluded, with its file."""
    found = []
    for path in _SOURCES:
        tree = ast.parse(path.read_text())
        found += [(path, node.value) for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    return [(path, value) for path, value in found if isinstance(value, str)]


def test_every_event_that_the_code_names_is_in_the_catalogue():
    named = {value for _, value in literals() if _EVENT_NAME.fullmatch(value)}
    others = {*ENUM_TYPES, "check_estimator_", "failsafe_flags", "logger_status"}  # enumerations, log topics, a part
    assert named - set(CATALOGUE) == others & named
    assert len(named) > 80
    made = {f"check_estimator_{what}_not_stable" for what in ("vel", "pos", "hgt", "heading")}
    assert set(CATALOGUE) - named == made


def test_calls_name_events_of_the_catalogue():
    """Every string argument of an announcing call that has the form of an event's name is in the catalogue."""
    for path in _SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            texts = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
            if name in _TELLING:
                for text in texts:
                    if isinstance(text, str) and re.fullmatch(r"[a-z]+(_[a-z0-9]+)+", text):
                        assert text in CATALOGUE, (path, node.lineno)


def test_only_texts_with_an_event_end_with_a_tab():
    """Only ``Announcements`` appends tabs, where it adds the event; all others strip them."""
    assert {path.stem for path, value in literals() if value.endswith("\t")} <= {
        "announcements",
        "ftp",
        "logger",
        "parameter_file",  # between columns
    }


# texts of a real PX4 v1.14.3, all with a tab, and the events of the same meaning
_FLOWN = {
    "Armed by external command": "commander_armed_by",
    "Using minimum takeoff altitude: 2.50 m": "navigator_takeoff_min_alt",
    "Takeoff detected": "commander_takeoff_detected",
    "RTL HOME activated": "navigator_rtl_home_activated",
    "RTL: landing at home position.": "rtl_land_at_home",
    "RTL: climb to 492 m (4 m above destination)": "rtl_climb_to",
    "RTL: return at 492 m (4 m above destination)": "rtl_return_at",
    "RTL: descend to 492 m (4 m above destination)": "rtl_descend_to",
    "RTL: land at destination": "rtl_land_at_destination",
    "Landing detected": "commander_landing_detected",
    "Disarmed by landing": "commander_disarmed_by",
}


def test_texts_of_a_flight_have_tabs_and_events():
    flight = Flight()
    commander = flight.commander
    flight.run(1.0)
    commander.texts.clear()
    commander.events.clear()
    commander.commands.takeoff(math.nan, math.nan)
    commander.arm_disarm(True)
    flight.run(3.0, flight.follow)
    flight.place(1.0, 0.0, -2.5)
    commander.request(modes.AUTO_RTL)
    flight.run(5.0, flight.follow)
    flight.place(0.0, 0.0, 0.0)
    flight.run(4.0)
    assert not commander.armed
    texts = [text for _, text in commander.texts]
    assert all(text.endswith("\t") for text in texts)
    told = [event.name for event in commander.events]
    expected = {re.sub(r"\d+ m \(\d+", "# m (#", text): name for text, name in _FLOWN.items()}
    assert [re.sub(r"\d+ m \(\d+", "# m (#", text.rstrip("\t")) for text in texts] == list(expected)
    assert [name for name in told if not name.startswith("check_") and "summary" not in name] == list(expected.values())


@pytest.fixture(scope="module")
def definitions():
    return json.loads(metadata.event_definitions())


def test_event_definitions_follow_libevents_schema(definitions):
    """The definitions satisfy libevents' schema and its check script."""
    assert definitions["version"] in (1, 2)
    ((component, content),) = definitions["components"].items()
    assert component == "1"
    enums = content["enums"]
    ids = set()
    for group, entry in content["event_groups"].items():
        assert group in ("default", "arming_check", "health")
        for sub_id, found in entry["events"].items():
            assert 0 <= int(sub_id) < 1 << 24
            assert int(sub_id) not in ids
            ids.add(int(sub_id))
            assert event_id(found["name"]) == 1 << 24 | int(sub_id)
            assert re.fullmatch(r"[a-zA-Z][a-zA-Z0-9_]*", found["name"])
            assert re.fullmatch(r"[^\n]{1,120}", found["message"])
            check_arguments(group, found, enums)
            for text in (found["message"], found.get("description", "")):
                check_text(text, len(found.get("arguments", ())))
    for name, enum in enums.items():
        assert re.fullmatch(r"[a-z_]+_t", name)
        assert enum["type"] in CODES
        for value, words in enum["entries"].items():
            assert re.fullmatch(r"[a-z][a-z0-9_]*", words["name"])
            assert "\n" not in words["description"]
            if enum.get("is_bitfield"):
                assert int(value).bit_count() == 1
    modes = content["navigation_mode_groups"]["groups"]
    assert {1 << int(bit) for bit in modes} == {int(value) for value in enums["navigation_mode_group_t"]["entries"]}


def check_arguments(group, found, enums):
    types = [argument["type"] for argument in found.get("arguments", ())]
    names = [argument["name"] for argument in found.get("arguments", ())]
    assert all(of_type in CODES or of_type in enums for of_type in types)
    size = struct.calcsize("<" + "".join(CODES[enums[t]["type"] if t in enums else t] for t in types))
    assert size <= MAX_ARGUMENTS
    assert size == CATALOGUE[found["name"]].layout.size
    if found.get("type") == "summary":
        assert types[0] == "uint8_t"
        if group == "arming_check":
            assert names == ["chunk_idx", "error", "warning", "can_arm", "can_run"]
        else:
            assert names == ["chunk_idx", "is_present", "error", "warning"]
    elif group != "default":
        assert types[:2] == ["navigation_mode_group_t", "uint8_t"]
        assert names[1] == "health_component_index"
    elif found.get("type"):
        assert found["type"] == "append_health_and_arming_messages"
        assert types[0] == "uint32_t"


def check_text(text, count):
    for argument in re.findall(r"\{(.*?)\}", text):
        match = re.fullmatch(r"(\d+)(:\.\d+)?(m|m_v|m/s|m\^2|C)?", argument)
        assert match, text
        assert 1 <= int(match[1]) <= count
    assert re.sub(r"<param>([A-Z0-9_]+)</param>", "", text).count("<") == 0
    for name in re.findall(r"<param>(.*?)</param>", text):
        assert name in NAMES


def test_arguments_are_cut_to_their_types():
    assert event("rtl_climb_to", events.INFO, 0, 1e12, math.nan).arguments == struct.pack("<ii", (1 << 31) - 1, 0)
    assert event("navigator_mis_wp_below_home", events.INFO, 0, -1e6).arguments == struct.pack("<h", -(1 << 15))
    assert event("rtl_loiter", events.INFO, 0, 1e300).arguments == struct.pack("<f", math.inf)
    with pytest.raises(ValueError, match="argument"):
        event("rtl_loiter", events.INFO, 0)
    with pytest.raises(KeyError):
        event("no_such_event", events.INFO, 0)


def test_definitions_of_parameters(served):
    """The definitions satisfy mavlink's parameter.schema.json and have version 1, which QGroundControl requires."""
    content = json.loads(metadata.parameter_definitions(served.parameters))
    assert content["version"] == 1
    entries = {entry["name"]: entry for entry in content["parameters"]}
    assert list(entries) == list(NAMES)
    for name, entry in entries.items():
        described = describe(name)
        assert entry["type"] == ("Int32" if described.type == INT32 else "Float")
        assert entry["default"] == served.parameters.default(name)
        assert entry.get("min", -math.inf) == described.minimum
        assert entry.get("max", math.inf) == described.maximum
        assert entry["shortDesc"]
        assert not {"values", "bitmask"} <= set(entry)
        if "decimalPlaces" in entry:
            assert round(entry["default"], entry["decimalPlaces"]) == entry["default"]
    assert entries["EKF2_GBIAS_INIT"]["rebootRequired"]
    assert entries["MAV_SYS_ID"]["readOnly"]
    assert entries["MAV_SYS_ID"]["default"] == SYSTEM


def test_choices_are_those_that_a_parameter_can_have():
    for name, choices in metadata.CHOICES.items():
        entry = describe(name)
        assert all(entry.minimum <= value <= entry.maximum for value in choices), name
        assert entry.default in choices, name
    effective = [entry for entry in map(describe, NAMES) if entry.has_effect]
    small = {entry.name for entry in effective if entry.type == INT32 and entry.maximum <= 9 and not entry.unit}
    assert small <= set(metadata.CHOICES) | set(metadata.BITS), "a new choice needs its words"
    groups = {name.split("_")[0] for name in NAMES if not name.startswith("RC")}
    assert groups <= set(metadata._GROUPS), "a new group of parameters needs its name"
    for name, bits in metadata.BITS.items():
        assert describe(name).type == INT32
        assert all(1 << bit <= describe(name).maximum for bit in bits), name
    assert set(NAMES) >= metadata.AT_START | FIXED


@pytest.fixture
def served():
    return Served()


def download(served, uri):
    """Read a file by FTP, as a ground station does that receives a URI."""
    path = uri.removeprefix("mftp://").encode()
    assert path != uri.encode()
    (size,) = struct.unpack("<I", ftp(served, 4, path)[0])
    data = b""
    while len(data) < size:
        data += ftp(served, 5, offset=len(data), size=239)[0]
    ftp(served, 1)
    crc = struct.unpack("<I", ftp(served, 14, path)[0])[0]
    assert crc == checksum(data)
    return data


def ftp(served, opcode, data=b"", offset=0, size=None):
    served.sequence = getattr(served, "sequence", 0) + 2
    head = struct.pack("<HBBBBBBI", served.sequence, 0, opcode, len(data) if size is None else size, 0, 0, 0, offset)
    payload = (head + data).ljust(251, b"\0")
    (answer,) = served.ask(mavlink.MAVLink_file_transfer_protocol_message(0, SYSTEM, 1, list(payload)))
    payload = bytes(answer.payload)
    assert payload[3] == 128, payload[:14]
    return payload[12 : 12 + payload[4]], payload


def request(served, name):
    """Request a message that pymavlink lacks; return its fields."""
    served.link.frames.clear()
    served.ask(mavlink.MAVLink_command_long_message(SYSTEM, 1, 512, 0, MESSAGE_ID[name], 0, 0, 0, 0, 0, 0))
    (frame, ack) = served.link.frames
    ((number, _, _, _),) = split(frame)
    assert number == MESSAGE_ID[name]
    assert decoder("COMMAND_ACK")(ack).result == 0
    kind = MESSAGES[number]
    values = kind.unpacker.unpack(frame[10:-2].ljust(kind.unpacker.size, b"\0"))
    return dict(zip(kind.ordered_fieldnames, values, strict=True))


def test_the_files_are_found_from_the_message(served):
    told = request(served, "COMPONENT_METADATA")
    older = request(served, "COMPONENT_INFORMATION")
    uri, crc = told["uri"].rstrip(b"\0").decode(), told["file_crc"]
    assert older["general_metadata_uri"] == told["uri"]
    assert older["general_metadata_file_crc"] == crc
    general = download(served, uri)
    assert checksum(general) == crc
    content = json.loads(general)
    assert content["version"] == 1
    files = {entry["type"]: entry for entry in content["metadataTypes"]}
    assert set(files) == {1, 4}
    for entry in files.values():
        assert checksum(download(served, entry["uri"])) == entry["fileCrc"]
    assert download(served, files[4]["uri"]) == metadata.event_definitions()
    assert download(served, files[1]["uri"]) == metadata.parameter_definitions(served.parameters)


def test_a_changed_parameter_changes_no_file(served):
    before = request(served, "COMPONENT_METADATA")["file_crc"]
    served.parameters.set("MPC_XY_VEL_MAX", 7.0)
    assert request(served, "COMPONENT_METADATA")["file_crc"] == before


def test_messages_are_those_of_the_xml():
    """Lengths and checksums equal those of common.xml."""
    assert (MESSAGES[397].unpacker.size, MESSAGES[397].crc_extra) == (108, 182)
    assert (MESSAGES[395].unpacker.size, MESSAGES[395].crc_extra) == (212, 0)
