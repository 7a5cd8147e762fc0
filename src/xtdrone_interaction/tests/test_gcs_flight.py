"""Flight commands of the ground station: to a scripted vehicle, and to real ports while time is paused."""

from __future__ import annotations

import math

import pytest
from gcs_field import FIRST, Field, LossyLine
from gcs_script import ack, beat, talk, told
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_interaction.gcs import GcsError, Peer, station
from xtdrone_interaction.gcs.exchanges import commands_and_refusals
from xtdrone_interaction.gcs.exchanges.commands_and_refusals import Target
from xtdrone_interaction.gcs.exchanges.exchange import RefusalError
from xtdrone_interaction.gcs_commands.gcs_cli import main

PATIENCE = 120.0  # s; only a broken run takes so long
ORIGIN = mavlink.MAVLink_gps_global_origin_message(473977420, 85455940, 488_000, 0)
HOME = mavlink.MAVLink_home_position_message(473977420, 85455940, 490_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
HERE = mavlink.MAVLink_global_position_int_message(0, 473977420, 85455940, 489_000, 1_000, 0, 0, 0, 0)
KNOWN = {message.id: message for message in (ORIGIN, HOME, HERE)}


class Obedient:
    """A vehicle that accepts every command."""

    def __init__(self, known=KNOWN):
        self.obeyed = []
        self._known = known

    def __call__(self, message):
        if message.get_type() == "PARAM_REQUEST_READ":
            assert message.param_id == "MIS_TAKEOFF_ALT"
            return [told(mavlink.MAVLink_param_value_message(b"MIS_TAKEOFF_ALT", 2.5, 9, 1, 0))]
        if message.command != mavlink.MAV_CMD_REQUEST_MESSAGE:
            self.obeyed.append(message)
            return [ack(message.command)]
        found = self._known.get(int(message.param1))
        if found is None:
            return [ack(message.command, mavlink.MAV_RESULT_DENIED)]
        return [ack(message.command), told(found)]

    @property
    def numbers(self):
        return [message.command for message in self.obeyed]


def test_a_px4_gets_a_takeoff_altitude_and_is_then_armed():
    vehicle = Obedient()
    assert talk(commands_and_refusals.take_off(beat(), 5.0), vehicle) == 5.0
    assert vehicle.numbers == [mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_COMPONENT_ARM_DISARM]
    assert vehicle.obeyed[0].param7 == 494.0
    assert math.isnan(vehicle.obeyed[0].param5)
    assert talk(commands_and_refusals.take_off(beat(), 1.0), vehicle) == 2.5  # the autopilot's minimum


def test_no_vehicle_takes_off_twice():
    flying = mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR)
    vehicle = Obedient(KNOWN | {flying.id: flying})
    with pytest.raises(RefusalError, match="in the air"):
        talk(commands_and_refusals.take_off(beat(), 5.0), vehicle)
    assert vehicle.obeyed == []


@pytest.mark.parametrize(
    ("target", "altitude"),
    [
        (Target(local=(0.0, 0.0, 7.0)), 495.0),
        (Target(place=(47.397742, 8.545594), altitude=500.0), 500.0),
        (Target(place=(47.397742, 8.545594), altitude=3.0, over_home=True), 493.0),
    ],
)
def test_positions_have_amsl_altitudes(target, altitude):
    vehicle = Obedient()
    talk(commands_and_refusals.go_to(beat(), target), vehicle)
    (message,) = vehicle.obeyed
    assert (message.command, message.x, message.y, message.z) == (
        mavlink.MAV_CMD_DO_REPOSITION, 473977420, 85455940, altitude
    )  # fmt: skip


def test_local_places_are_east_north_up():
    vehicle = Obedient()
    talk(commands_and_refusals.go_to(beat(), Target(local=(0.0, 100.0, 0.0), speed=2.0)), vehicle)
    (message,) = vehicle.obeyed
    assert message.x - 473977420 == pytest.approx(100.0 / 6371000.0 * 180.0 / math.pi * 1e7, abs=2)
    assert (message.y, message.param1) == (85455940, 2.0)


@pytest.mark.parametrize("target", [Target(local=(0.0, 0.0, 0.0)), Target(place=(1.0, 1.0), over_home=True)])
def test_a_vehicles_missing_state_is_reported(target):
    with pytest.raises(RefusalError, match="has no"):
        talk(commands_and_refusals.go_to(beat(), target), Obedient({}))


@pytest.mark.parametrize(
    ("name", "params"), [("auto.mission", (4, 4)), ("LOITER", (4, 3)), ("position", (3, 0)), ("HOLD", (4, 3))]
)
def test_modes_by_name(name, params):
    vehicle = Obedient()
    talk(commands_and_refusals.set_mode(beat(), name), vehicle)
    (message,) = vehicle.obeyed
    assert (message.param1, message.param2, message.param3) == (1, *params)


def test_an_invalid_mode():
    with pytest.raises(RefusalError, match=r"mode: 'GUIDED' is not allowed, one of the vehicle's: ACRO, ALTCTL, AUTO"):
        talk(commands_and_refusals.set_mode(beat(), "GUIDED"), Obedient())


def test_a_rejection_has_a_reason_and_completion_is_awaited():
    why = mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, b"Arming denied: no GPS\t")
    busy, denied = mavlink.MAV_RESULT_IN_PROGRESS, mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    number = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    text = r"arm: the vehicle answers TEMPORARILY_REJECTED \(Arming denied: no GPS\)"
    with pytest.raises(RefusalError, match=text):
        talk(
            commands_and_refusals.arm(beat()),
            lambda _: [ack(number, busy), ack(512, 0), ack(number, denied), told(why)],
        )


def test_a_vehicle_that_never_finishes_is_abandoned():
    number = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    with pytest.raises(RefusalError, match="sends no final acknowledgement"):
        talk(commands_and_refusals.arm(beat()), lambda _: [ack(number, mavlink.MAV_RESULT_IN_PROGRESS)])


# ---- real MAVLink servers, while time is paused


@pytest.fixture(scope="module")
def field():
    field = Field()
    field.autopilot.estimator["initialised"] = True  # otherwise no vehicle can be armed
    yield field
    field.close()


def test_one_of_three_rejects(field, capsys):
    """A rejection fails the command, and the accepted vehicles stay armed; forced arming skips the checks."""
    vehicles = [str(vehicle.id) for vehicle in field.vehicles]
    assert main(["arm", "--force", "--vehicle", *vehicles[:2]]) == 0
    assert [commander.armed for commander in field.commanders] == [True, True, False]
    assert main(["disarm", "--vehicle", vehicles[0]]) == 0
    capsys.readouterr()
    assert main(["arm", "--vehicle", *vehicles[1:]]) == 1  # the armed vehicle stays armed, the other's checks fail
    caught = capsys.readouterr()
    assert [line.split(maxsplit=1) for line in caught.out.splitlines()] == [
        [f"vehicle_{FIRST + 1}", "armed"], [f"vehicle_{FIRST + 2}", "failed"]
    ]  # fmt: skip
    assert f"xtdrone gcs: vehicle_{FIRST + 2}: arm: the vehicle answers " in caught.err
    assert main(["disarm", "--force", "--vehicle", *vehicles]) == 0
    assert [commander.armed for commander in field.commanders] == [False] * 3


def test_commands_over_a_line_that_loses_a_third(field):
    line = LossyLine(field.ports, 0.3, 5)
    try:
        peers = [Peer(name, 0, "127.0.0.1", port) for name, port in line.ports.items()]
        for armed in (True, False):
            jobs = dict.fromkeys(peers, lambda beat, armed=armed: commands_and_refusals.arm(beat, armed, force=True))
            results = station.run(jobs, timeout=0.05, patience=PATIENCE, on_abort=station.no_abort_messages)
            assert set(results.values()) == {None}
            assert [commander.armed for commander in field.commanders] == [armed] * 3
    finally:
        line.close()


def test_a_goto_of_a_disarmed_vehicle_is_rejected(field):
    peer = field.peers()[0]
    job = {peer: lambda beat: commands_and_refusals.go_to(beat, Target(place=(47.0, 8.0), altitude=500.0))}
    (result,) = station.run(job, on_abort=station.no_abort_messages).values()
    assert isinstance(result, GcsError)
    assert "goto: the vehicle is on the ground and disarmed" in str(result)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["goto", "1", "2", "--vehicle", "0"], "goto: 2 of X Y Z is not allowed, X Y Z, m, or"),
        (["goto", "1", "2", "3", "--lat", "4", "--vehicle", "0"], "goto: 3 of X Y Z and --lat is not allowed"),
        (["goto", "--lat", "4", "--lon", "4", "--vehicle", "0"], "goto: --lat and --lon is not allowed, X Y Z, m, or"),
        (["goto", "--vehicle", "0"], "goto: no place is not allowed"),
        (["goto", "1", "2", "3", "--vehicle", "0-2"], "3 vehicles would collide there"),
        (["land"], "which vehicles?"),
    ],
)
def test_incomplete_arguments_are_rejected(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["takeoff", "nan"], ["takeoff", "-1"], ["goto", "1", "2", "far"]])
def test_invalid_numbers(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--vehicle", "0"])
    assert ended.value.code == 2
    assert "is not allowed" in capsys.readouterr().err
