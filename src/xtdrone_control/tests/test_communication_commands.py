"""Decisions of the multirotor communication node, without ROS."""

from __future__ import annotations

import math

import pytest

from xtdrone_control.communication.commands import HOVER_SPEED, STATE_GRACE, MultirotorCore
from xtdrone_control.communication.setpoint import Setpoint, yaw_of

LEVEL = (0.0, 0.0, 0.0, 1.0)
HALF = math.sqrt(0.5)
WEST_OF_NORTH = (0.0, 0.0, HALF, HALF)  # yaw 90 deg


class Recorder:
    """Keeps the log messages."""

    def __init__(self) -> None:
        self.infos: list[str] = []
        self.warnings: list[str] = []

    def info(self, text: str) -> None:
        self.infos.append(text)

    def warning(self, text: str) -> None:
        self.warnings.append(text)

    stream_warning = warning


@pytest.fixture
def log() -> Recorder:
    return Recorder()


@pytest.fixture
def core(log: Recorder) -> MultirotorCore:
    return MultirotorCore("iris_0", log)


P, V, AF, YAW, YAW_RATE = 0b111, 0b111000, 0b111000000, 1024, 2048

ENCODINGS = [
    ("pose", False, Setpoint(1, V | AF | YAW_RATE, position=(1.0, 2.0, 3.0), yaw=math.pi / 2)),
    ("pose", True, Setpoint(9, V | AF | YAW_RATE, position=(1.0, 2.0, 3.0), yaw=math.pi / 2)),
    ("velocity", False, Setpoint(1, P | AF | YAW, velocity=(1.0, 2.0, 3.0), yaw_rate=0.5)),
    ("velocity", True, Setpoint(8, P | AF | YAW, velocity=(1.0, 2.0, 3.0), yaw_rate=0.5)),
    ("acceleration", False, Setpoint(1, P | V | YAW, acceleration=(1.0, 2.0, 3.0), yaw_rate=0.5)),
    ("acceleration", True, Setpoint(8, P | V | YAW, acceleration=(1.0, 2.0, 3.0), yaw_rate=0.5)),
]


def send(core: MultirotorCore, kind: str, body: bool, vector: tuple[float, float, float], last: float) -> None:
    """Send one target; ``last`` is the yaw rate of a twist."""
    if kind == "pose":
        core.on_target_pose("/t", vector, WEST_OF_NORTH, body=body)
    elif kind == "velocity":
        core.on_target_velocity("/t", vector, last, 0.0, body=body)
    else:
        core.on_target_acceleration("/t", vector, last, 0.0, body=body)


@pytest.mark.parametrize(("kind", "body", "expected"), ENCODINGS)
def test_encoding_table(core: MultirotorCore, kind: str, body: bool, expected: Setpoint) -> None:
    send(core, kind, body, (1.0, 2.0, 3.0), 0.5)
    got = core.tick(0.0)
    assert (got.frame, got.type_mask) == (expected.frame, expected.type_mask)
    assert (got.position, got.velocity, got.acceleration) == (
        expected.position,
        expected.velocity,
        expected.acceleration,
    )
    assert got.yaw == pytest.approx(expected.yaw)
    assert got.yaw_rate == expected.yaw_rate
    assert core.tick(1e6) is got, "the last input stays the setpoint"


@pytest.mark.parametrize(
    ("quaternion", "yaw"),
    [(LEVEL, 0.0), (WEST_OF_NORTH, math.pi / 2), ((0, 0, 0, 0), 0.0), ((0, 0, 2.0, 2.0), math.pi / 2)],
)
def test_yaw_of_any_quaternion(quaternion: tuple[float, float, float, float], yaw: float) -> None:
    assert yaw_of(*quaternion) == pytest.approx(yaw)


def test_yaw_is_independent_of_tilt() -> None:
    cr, sr, cy, sy = math.cos(0.2), math.sin(0.2), math.cos(0.6), math.sin(0.6)
    assert yaw_of(sr * cy, sr * sy, cr * sy, cr * cy) == pytest.approx(1.2)


def test_before_any_input_holds_still_then_the_present_pose(core: MultirotorCore) -> None:
    first = core.tick(0.0)
    assert first.velocity == (0.0, 0.0, 0.0)
    assert not first.type_mask & V
    assert first.type_mask & P
    core.on_pose((3.0, 4.0, 0.1), WEST_OF_NORTH)
    core.on_pose((3.0, 4.0, 2.5), WEST_OF_NORTH)
    held = core.tick(0.1)
    assert held.position == (3.0, 4.0, 2.5)
    assert held.yaw == pytest.approx(math.pi / 2)
    core.on_state("OFFBOARD", True)
    core.on_pose((3.0, 4.0, 2.0), WEST_OF_NORTH)
    assert core.tick(0.2).position == (3.0, 4.0, 2.5), "in OFFBOARD the hold does not give way"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e39])
@pytest.mark.parametrize("kind", ["pose", "velocity", "acceleration"])
def test_rejects_plans_that_no_vehicle_can_fly(core: MultirotorCore, log: Recorder, kind: str, bad: float) -> None:
    send(core, kind, False, (1.0, 1.0, 1.0), 0.1)
    before = core.tick(0.0)
    send(core, kind, False, (1.0, bad, 1.0), 0.1)
    assert core.tick(0.1) is before
    field = "position.y" if kind == "pose" else "linear.y"
    assert len(log.warnings) == 1
    assert "/t" in log.warnings[0]
    assert f"{field} is {bad}" in log.warnings[0]


def test_bad_pose_is_not_hovered_at(core: MultirotorCore, log: Recorder) -> None:
    core.on_pose((1.0, 2.0, 3.0), LEVEL)
    core.on_pose((math.nan, 2.0, 3.0), LEVEL)
    core.on_command("HOVER", 0.0)
    assert core.tick(0.0).position == (1.0, 2.0, 3.0)
    assert "position.x is nan" in log.warnings[0]


def test_hover_freezes_the_pose_of_its_moment(core: MultirotorCore) -> None:
    core.on_pose((1.0, 2.0, 3.0), WEST_OF_NORTH)
    assert core.on_command("HOVER", 0.0) is None
    core.on_pose((9.0, 9.0, 9.0), LEVEL)
    core.on_command("HOVER", 0.1)
    hover = core.tick(0.1)
    assert (hover.frame, hover.type_mask) == (1, V | AF | YAW_RATE)
    assert hover.position == (1.0, 2.0, 3.0)
    assert hover.yaw == pytest.approx(math.pi / 2)


def test_hover_before_a_pose_warns_and_can_be_repeated(core: MultirotorCore, log: Recorder) -> None:
    send(core, "velocity", False, (1.0, 0.0, 0.0), 0.0)
    core.on_command("HOVER", 0.0)
    assert core.tick(0.0).velocity == (0.0, 0.0, 0.0)
    assert "local_position/pose" in log.warnings[0]
    core.on_pose((1.0, 2.0, 3.0), LEVEL)
    core.on_command("HOVER", 0.1)
    assert core.tick(0.1).position == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
@pytest.mark.parametrize(
    ("vector", "yaw_rate", "hovers"),
    [
        ((0.02, -0.02, 0.02), 0.005, True),
        ((0.0, 0.0, 0.0), 0.006, False),
        ((0.021, 0.0, 0.0), 0.0, False),
        ((0.0, 0.0, -0.021), 0.0, False),
    ],
)
def test_dead_zone(log: Recorder, kind: str, vector: tuple[float, float, float], yaw_rate: float, hovers: bool) -> None:
    core = MultirotorCore("iris_0", log, hover_speed=0.02)
    core.on_pose((1.0, 2.0, 3.0), LEVEL)
    send(core, kind, True, (1.0, 0.0, 0.0), 0.0)
    send(core, kind, True, vector, yaw_rate)
    assert core.hovering is hovers
    assert (core.tick(0.0).frame == 1) is hovers


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
@pytest.mark.parametrize("axis", range(4))
def test_a_press_of_the_keyboard_is_no_hover(core: MultirotorCore, kind: str, axis: int) -> None:
    core.on_pose((1.0, 2.0, 3.0), LEVEL)
    x, y, z, turn = (0.01 if i == axis else 0.0 for i in range(4))
    send(core, kind, True, (x, y, z), turn)
    told = core.tick(0.0)
    assert not core.hovering
    assert (told.velocity if kind == "velocity" else told.acceleration) == (x, y, z)
    assert told.yaw_rate == turn
    send(core, kind, True, (HOVER_SPEED, 0.0, 0.0), 0.0)
    assert core.hovering, "what is as good as nothing still is"


def test_dead_zone_can_be_narrowed(log: Recorder) -> None:
    core = MultirotorCore("iris_0", log, hover_speed=0.0)
    core.on_pose((1.0, 2.0, 3.0), LEVEL)
    send(core, "velocity", False, (0.0, 1e-4, 0.0), 0.0)
    assert core.tick(0.0).velocity == (0.0, 1e-4, 0.0)
    send(core, "velocity", False, (0.0, 0.0, 0.0), 0.0)
    assert core.tick(0.0).position == (1.0, 2.0, 3.0)


def test_zero_velocity_stream_hovers_anew_after_a_mode_change(core: MultirotorCore) -> None:
    core.on_pose((0.0, 0.0, 0.0), LEVEL)
    send(core, "velocity", False, (0.0, 0.0, 0.0), 0.0)
    request = core.on_command("AUTO.TAKEOFF", 0.0)
    assert request is not None
    core.on_result(request, True, "", 0.0)
    core.on_pose((0.0, 0.0, 2.5), LEVEL)
    send(core, "velocity", False, (0.0, 0.0, 0.0), 0.0)
    assert core.tick(0.0).position == (0.0, 0.0, 2.5), "else OFFBOARD would dive to the ground"


def test_arm_and_disarm_ask_the_arming_service(core: MultirotorCore, log: Recorder) -> None:
    for command, value in (("ARM", True), ("DISARM", False)):
        request = core.on_command(command, 0.0)
        assert request is not None
        assert (request.service, request.arm) == ("mavros/cmd/arming", value)
    core.on_result(request, False, "MAV_RESULT 4", 0.0)
    assert "DISARM refused" in log.warnings[0]
    assert "MAV_RESULT 4" in log.warnings[0]
    assert not log.infos


def test_ignored_commands(core: MultirotorCore) -> None:
    assert core.on_command("", 0.0) is None
    assert core.on_command("stop controlling", 0.0) is None


def test_mission_label_is_kept(core: MultirotorCore) -> None:
    assert core.on_command("mission3", 0.0) is None
    assert core.mission == "3"
    request = core.on_command("mission12", 0.0)
    assert request is not None, "mission and exactly one character; the rest are modes"
    assert request.arm is None


def test_unknown_mode_is_sent_unchanged_and_its_rejection_lists_modes(core: MultirotorCore, log: Recorder) -> None:
    request = core.on_command("OFBOARD", 0.0)
    assert request is not None
    assert (request.service, request.command) == ("mavros/set_mode", "OFBOARD")
    core.on_result(request, False, "", 0.0)
    assert "'OFBOARD'" in log.warnings[0] or "OFBOARD refused" in log.warnings[0]
    assert "OFFBOARD" in log.warnings[0]
    assert "HOVER" in log.warnings[0]


def accepted(core: MultirotorCore, command: str, now: float) -> None:
    """Send a command that MAVROS accepts."""
    request = core.on_command(command, now)
    assert request is not None, f"{command} was not sent"
    core.on_result(request, True, "", now)


def test_repeated_command_is_ignored_while_its_state_holds(core: MultirotorCore) -> None:
    core.on_state("AUTO.LOITER", True)
    accepted(core, "OFFBOARD", 0.0)
    assert core.on_command("OFFBOARD", 1.0) is None, "mavros/state has had no time to follow"
    core.on_state("OFFBOARD", True)
    assert core.on_command("OFFBOARD", 100.0) is None


def test_repeated_command_is_sent_again_after_a_rejection(core: MultirotorCore) -> None:
    request = core.on_command("OFFBOARD", 0.0)
    assert core.on_command("OFFBOARD", 0.1) is None, "the answer is still to come"
    core.on_result(request, False, "", 0.2)
    assert core.on_command("OFFBOARD", 0.3) is not None


def test_repeated_command_is_sent_again_after_a_failsafe(core: MultirotorCore) -> None:
    accepted(core, "OFFBOARD", 0.0)
    core.on_state("OFFBOARD", True)
    core.on_state("AUTO.RTL", True)
    assert core.on_command("OFFBOARD", 0.5) is not None


def test_arm_is_sent_again_after_the_vehicle_disarmed_itself(core: MultirotorCore) -> None:
    accepted(core, "ARM", 0.0)
    core.on_state("AUTO.LOITER", True)
    assert core.on_command("ARM", 5.0) is None
    core.on_state("AUTO.LOITER", False)
    assert core.on_command("ARM", 10.0) is not None


def test_takeoff_that_has_become_loiter_still_holds(core: MultirotorCore) -> None:
    accepted(core, "AUTO.TAKEOFF", 0.0)
    core.on_state("AUTO.TAKEOFF", True)
    core.on_state("AUTO.LOITER", True)
    assert core.on_command("AUTO.TAKEOFF", 20.0) is None


def test_accepted_but_never_entered_is_reported_once_and_may_be_repeated(core: MultirotorCore, log: Recorder) -> None:
    core.on_state("AUTO.LOITER", True)
    accepted(core, "OFFBOARD", 0.0)
    core.tick(STATE_GRACE)
    assert not log.warnings
    core.tick(STATE_GRACE + 0.1)
    core.tick(STATE_GRACE + 0.2)
    assert len(log.warnings) == 1
    assert "AUTO.LOITER" in log.warnings[0]
    assert core.on_command("OFFBOARD", STATE_GRACE + 0.3) is not None


def test_cmd_timeout_turns_a_forgotten_velocity_into_hover(log: Recorder) -> None:
    core = MultirotorCore("iris_0", log, cmd_timeout=1.0)
    core.on_pose((1.0, 2.0, 3.0), LEVEL)
    core.on_target_velocity("/t", (1.0, 0.0, 0.0), 0.0, 10.0, body=False)
    assert core.tick(11.0).velocity == (1.0, 0.0, 0.0)
    assert core.tick(11.1).position == (1.0, 2.0, 3.0)
    core.on_target_pose("/t", (5.0, 5.0, 5.0), LEVEL, body=False)
    assert core.tick(99.0).position == (5.0, 5.0, 5.0), "a place does not run away"


@pytest.mark.parametrize("name", ["cmd_timeout", "hover_speed"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_settings_must_make_sense(log: Recorder, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        MultirotorCore("iris_0", log, **{name: value})
