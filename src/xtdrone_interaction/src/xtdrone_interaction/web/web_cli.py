"""``./xtdrone web``: the page of the running flight in a browser.

Exit status: 0 after Ctrl-C, 1 without a flight, 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import fields
from pathlib import Path

from xtdrone_interaction import command_options
from xtdrone_interaction.simulation_services import RUNS, SimError, choose_master, master_uri
from xtdrone_interaction.web.server.credentials import TOKEN_ADVICE
from xtdrone_interaction.web.station_settings import StationSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Serve a page of the running flight: 3D view, vehicles and commands, swarm, time. Prints its URL. Watching "
        "changes no bit of the flight. Ctrl-C ends the page, not the flight."
    )
    StationSettings.add_arguments(parser)
    parser.add_argument("--token", action=_RefusedToken, help=argparse.SUPPRESS)
    parser.add_argument(
        "--master",
        type=master_uri,
        metavar="PORT|URI",
        help="the flight's ROS master (default: ROS_MASTER_URI; without a simulator there, the newest flight)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Become the station's node; return the exit status if that fails."""
    settings = StationSettings.from_arguments(arguments)
    try:
        master, origin = choose_master(
            arguments.master or "", os.environ.get("ROS_MASTER_URI", ""), [Path("runs"), RUNS]
        )
    except SimError as error:
        print(f"xtdrone web: {error}", file=sys.stderr)
        return 1
    if origin:
        print(f"xtdrone web: {origin}, ROS master {master}", file=sys.stderr)
    environment = {"ROS_MASTER_URI": master}
    if not {"ROS_IP", "ROS_HOSTNAME"} & os.environ.keys():
        environment["ROS_IP"] = "127.0.0.1"
    node = command_options.repository() / "src" / "xtdrone_interaction" / "nodes" / "web_station.py"
    given = [f"_{field.name}:={_yaml(getattr(settings, field.name))}" for field in fields(settings)]
    sys.stdout.flush()
    os.execve(sys.executable, [sys.executable, str(node), *given], {**os.environ, **environment})


class _RefusedToken(argparse.Action):
    """Refuses a token on the command line."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        parser.error(TOKEN_ADVICE)


def _yaml(value: object) -> str:
    """Return a value as rospy reads it on a command line; texts quoted, so that 12345678 stays a text."""
    return json.dumps(",".join(value) if isinstance(value, tuple) else value)
