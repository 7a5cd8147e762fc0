"""``./xtdrone sim``: time, vehicles and status of a running simulation.

Exit status: 0 on success, 1 on failure, 2 for an invalid value, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.programs.node_command_line import speed_setting
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.simulation_services import RUNS, SimError, call, choose_master, find_service, master_uri

_MOST_TICKS = (1 << 32) - 1
_TIME_END = float(1 << 32)  # s; a ROS time is less
_DURATION_END = float(1 << 31)  # s; a ROS duration is less
_NAMES_SHOWN = 8
_RESETS = ("simulation", "world")


@dataclass(frozen=True)
class StepOptions(Settings):
    """Arguments of ``step``, of which one may be given."""

    ticks: int | None = setting(None, low=1, high=_MOST_TICKS, text="number of ticks (default: 1)", positional=True)
    until: float | None = setting(
        None,
        above=0.0,
        below=_TIME_END,
        unit="s",
        text="to the first tick at or after this simulated time",
        metavar="T",
    )
    seconds: float | None = setting(
        None,
        above=0.0,
        below=_DURATION_END,
        unit="s",
        text="to the first tick after this much simulated time",
        option="--for",
        metavar="S",
    )


@dataclass(frozen=True)
class SpeedOptions(Settings):
    """Argument of ``speed``."""

    factor: float = speed_setting("target speed", default=..., positional=True)


@dataclass(frozen=True)
class WindOptions(Settings):
    """Arguments of ``wind``: the air's velocity, ENU."""

    east: float = setting(..., unit="m/s", text="towards the east", positional=True)
    north: float = setting(..., unit="m/s", text="towards the north", positional=True)
    up: float = setting(0.0, unit="m/s", text="upwards", positional=True)


@dataclass(frozen=True)
class FailureOptions(Settings):
    """Argument of ``fail``."""

    value: float = setting(
        0.0, text="biased: m added to every range; dropouts: share of the returns that are lost", positional=True
    )


# ---- commands; each returns its output


def _trigger(name: str) -> Callable[[str, argparse.Namespace], str]:
    def run(master: str, _arguments: argparse.Namespace) -> str:
        from std_srvs.srv import Trigger, TriggerRequest

        return _accepted(call(master, f"/simulator/{name}", Trigger, TriggerRequest()))

    return run


def _step(master: str, arguments: argparse.Namespace) -> str:
    import genpy
    from xtdrone_msgs.srv import Step, StepRequest

    options = StepOptions.from_arguments(arguments)
    request = StepRequest(ticks=options.ticks or 0)
    if options.until is not None:
        request.until = genpy.Time.from_sec(options.until)
    if options.seconds is not None:
        request.duration = genpy.Duration.from_sec(options.seconds)
    try:
        return _accepted(call(master, "/simulator/step", Step, request, limit=None))
    except KeyboardInterrupt:
        print("\nxtdrone sim: the step continues; './xtdrone sim pause' ends it", file=sys.stderr)
        raise


def _speed(master: str, arguments: argparse.Namespace) -> str:
    from xtdrone_msgs.srv import SetSpeed, SetSpeedRequest

    return _accepted(call(master, "/simulator/set_speed", SetSpeed, SetSpeedRequest(speed=arguments.factor)))


def _wind(master: str, arguments: argparse.Namespace) -> str:
    from geometry_msgs.msg import Vector3
    from xtdrone_msgs.srv import SetWind, SetWindRequest

    velocity = Vector3(arguments.east, arguments.north, arguments.up)
    return _accepted(call(master, "/simulator/set_wind", SetWind, SetWindRequest(velocity=velocity)))


def _reset(master: str, arguments: argparse.Namespace) -> str:
    from std_srvs.srv import Empty, EmptyRequest

    if arguments.what not in _RESETS:
        return _reset_vehicle(master, arguments)
    if arguments.pose:
        raise SimError("reset: --pose is for one vehicle, as reset iris_0 --pose 3 4")
    call(master, f"/gazebo/reset_{arguments.what}", Empty, EmptyRequest())
    if arguments.what == "world":
        return "reset: vehicles are at their places, simulated time continues"
    return "reset: vehicles are at their places, simulated time is 0"


def _reset_vehicle(master: str, arguments: argparse.Namespace) -> str:
    from xtdrone_msgs.srv import ResetVehicle, ResetVehicleRequest

    request = ResetVehicleRequest(arguments.what, arguments.pose or [])
    return _accepted(call(master, "/simulator/reset_vehicle", ResetVehicle, request))


def _add(master: str, arguments: argparse.Namespace) -> str:
    from xtdrone_msgs.srv import AddVehicle, AddVehicleRequest

    request = AddVehicleRequest(arguments.vehicle, arguments.model, arguments.pose or [])
    return _accepted(call(master, "/simulator/add_vehicle", AddVehicle, request))


def _remove(master: str, arguments: argparse.Namespace) -> str:
    from xtdrone_msgs.srv import RemoveVehicle, RemoveVehicleRequest

    request = RemoveVehicleRequest(arguments.vehicle)
    return _accepted(call(master, "/simulator/remove_vehicle", RemoveVehicle, request))


def _fail(master: str, arguments: argparse.Namespace) -> str:
    """Make a lidar or a UWB sensor fail by its service, or stop a camera."""
    sensor = f"/{arguments.sensor.strip('/')}"
    if find_service(master, f"{sensor}/failure"):
        from xtdrone_msgs.srv import SetLidarFailure, SetLidarFailureRequest

        request = SetLidarFailureRequest(arguments.failure, arguments.value)
        return _accepted(call(master, f"{sensor}/failure", SetLidarFailure, request))
    if not find_service(master, f"{sensor}/freeze"):
        raise SimError(
            f"sensor: no lidar, camera or UWB sensor {sensor[1:80]!r} runs; VEHICLE/NAME, as iris_0/scan, is needed"
        )
    if arguments.failure not in ("off", "ok"):
        raise SimError(f"failure: {arguments.failure!r} is not allowed for a camera, off or ok")
    from std_srvs.srv import SetBool, SetBoolRequest

    return _accepted(call(master, f"{sensor}/freeze", SetBool, SetBoolRequest(arguments.failure == "off")))


def _status(master: str, _arguments: argparse.Namespace) -> str:
    from xtdrone_msgs.srv import GetStatus, GetStatusRequest

    status = call(master, "/simulator/get_status", GetStatus, GetStatusRequest()).status
    state = _state(status)
    target = f"target {status.speed:g}" if status.speed else "as fast as it goes"
    count = len(status.participants)
    names = ", ".join(sorted(status.participants)[:_NAMES_SHOWN]) or "none has joined"
    rest = count - _NAMES_SHOWN
    lines = [
        ("master", master),
        ("state", state),
        ("time", f"{status.sim_time.to_sec():.3f} s, tick {status.tick}"),
        ("speed", f"{status.measured_speed:.2f} x real time, {target}"),
        ("lockstep", f"{count} participant{'s' * (count != 1)}: {names}{f' and {rest} more' if rest > 0 else ''}"),
    ]
    if status.reason and status.reason != state:
        lines.append(("stands still", status.reason))
    return "\n".join(f"{name:<13}{text}" for name, text in lines)


def _state(status: Any) -> str:
    """Return the state of the simulation in a few words."""
    if status.stepping:
        return "stepping, then paused"
    if status.paused:
        return "paused"
    if status.waiting_for:
        return "waiting"
    if status.reason.startswith("held by "):
        return "held between two ticks"
    return "waiting for participants" if status.reason else "running"


def _accepted(response: Any) -> str:
    """Return the message of a response.

    Raises:
        SimError: the request was rejected.
    """
    if not response.success:
        raise SimError(response.message)
    return str(response.message)


# ---- the command line


def _add_pose(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--pose", type=float, nargs="+", metavar="N",
                        help=f"{text}: x y z roll pitch yaw, m and rad ENU, from z on as needed")  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the commands."""
    parser.description = "Control a running simulation."
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--master", type=master_uri, metavar="PORT|URI",
                        help="the simulation's ROS master (default: ROS_MASTER_URI; without a simulator there, "
                        "the newest flight of ./xtdrone demo)")  # fmt: skip
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Callable[[str, argparse.Namespace], str], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, parents=[common], help=text, description=text)
        command.set_defaults(act=run)
        return command

    add("pause", _trigger("pause"), "stop simulated time; all nodes stay alive and respond")
    add("resume", _trigger("resume"), "continue simulated time")
    step = add("step", _step, "advance by one or more ticks, then pause")
    goal = step.add_mutually_exclusive_group()
    StepOptions.add_arguments(goal)
    speed = add("speed", _speed, "set the target real-time factor")
    SpeedOptions.add_arguments(speed)
    reset = add("reset", _reset, "move all vehicles, or one, back to their initial positions, as after a start")
    reset.add_argument("what", nargs="?", default="simulation", metavar="world|simulation|VEHICLE",
                       help="simulation: time restarts at 0 (default); world: time continues; VEHICLE, as iris_3: only "
                       "this one stands, rebooted")  # fmt: skip
    _add_pose(reset, "where the vehicle then stands (default: where it started)")
    join = add("add", _add, "let a vehicle join, at a place that the launch argument reserve keeps free; "
               "launch/vehicle.launch starts its MAVROS node, too")  # fmt: skip
    join.add_argument("vehicle", metavar="VEHICLE", help="its name, as iris_9")
    join.add_argument("--model", default="", help="name or file of its description (default: its type)")
    _add_pose(join, "where it stands (default: its place on the spawn grid)")
    leave = add("remove", _remove, "take a vehicle out of the simulation, flying or not")
    leave.add_argument("vehicle", metavar="VEHICLE", help="its name, as iris_9")
    fail = add("fail", _fail, "let a lidar, camera or UWB sensor fail, or repair it")
    fail.add_argument("sensor", metavar="VEHICLE/NAME", help="as iris_2d_lidar_0/scan")
    fail.add_argument("failure", choices=("off", "frozen", "biased", "dropouts", "ok"),
                      help="a camera can be off")  # fmt: skip
    FailureOptions.add_arguments(fail)
    wind = add("wind", _wind, "set the world's wind, until it is set again or the world is reset")
    WindOptions.add_arguments(wind)
    add("status", _status, "print the state of the simulation, and the participants it waits for")


def run(arguments: argparse.Namespace) -> int:
    """Run a command and return the exit status."""
    runs = [Path("runs"), RUNS]
    try:
        master, origin = choose_master(arguments.master or "", os.environ.get("ROS_MASTER_URI", ""), runs)
        if origin:
            print(f"xtdrone sim: {origin}, ROS master {master}", file=sys.stderr)
        print(arguments.act(master, arguments))
    except SimError as error:
        print(f"xtdrone sim: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0
