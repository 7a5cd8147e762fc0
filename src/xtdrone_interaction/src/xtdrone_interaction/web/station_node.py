"""The station as a ROS node: it takes no part in the lockstep, so that watching changes no bit of a flight."""

from __future__ import annotations

import errno
import logging
import signal
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import rosgraph
import rospy
from tornado.ioloop import IOLoop

from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_interaction.ending import end_within_limit
from xtdrone_interaction.server_guard import is_loopback
from xtdrone_interaction.server_port import check_not_running, port_here
from xtdrone_interaction.web.actions.operator_actions import OperatorActions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.rooms import methods_of_rooms
from xtdrone_interaction.web.server.credentials import TOKEN_ADVICE, Credentials, TokenError, chosen_token
from xtdrone_interaction.web.server.station_server import Address, StationServer
from xtdrone_interaction.web.station_settings import DEFAULT_PORT, StationSettings

NAME = "web_station"
URL_PARAMETER = "~url"
_TOKEN_PARAMETER = "~token"
PAGE = Path(__file__).resolve().parents[3] / "web_page"
_PORTS_TRIED = 20


def main(arguments: Sequence[str]) -> None:
    """Run the node until shutdown.

    Raises:
        ArgumentError: an argument was given, or a token that is not allowed.
        SettingError: a parameter is not allowed.
        ROSInitException: a station runs already.
    """
    check_no_arguments(arguments)
    check_not_running(NAME, URL_PARAMETER.removeprefix("~"))
    init_plain_node(NAME, disable_signals=True)
    settings, token = _settings_and_token()
    loop = IOLoop.current()
    context = StationContext(rosgraph.get_master_uri(), rospy.get_name())
    actions = OperatorActions(context)
    context.act = actions.carry_out
    credentials = Credentials.for_host(settings.host, token, settings.view_only)
    server = StationServer(
        Address(settings.host, port_here(settings.port, DEFAULT_PORT), credentials, settings.origins, settings.names),
        PAGE,
        methods_of_rooms(context, settings),
        operate=context.act,
        report=rospy.logwarn,
        welcome=lambda: {"station": str(actions.station)},
        sessions=context.sessions,
    )
    port = _listen(server)
    for role, url in server.address.urls(port).items():
        print(f"station ({'operate' if role == 'operate' else 'watch only'}): {url}", flush=True)
    rospy.set_param(URL_PARAMETER, url.partition("#")[0])  # without a token, because any node can read parameters
    if not is_loopback(settings.host):
        rospy.logwarn("the station listens on %s: the token allows flying the vehicles", settings.host)
    rospy.on_shutdown(lambda: loop.add_callback(loop.stop))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: loop.add_callback_from_signal(loop.stop))
    end_within_limit(NAME)
    try:
        loop.start()
    finally:
        server.stop()
        context.close()
        threading.Thread(target=rospy.signal_shutdown, args=("the station ends",), daemon=True).start()


def _settings_and_token() -> tuple[StationSettings, str]:
    """Return the settings, and the token that the user has chosen.

    Raises:
        ArgumentError: the token is not allowed, or on the parameter server, where it is deleted.
        SettingError: a parameter is not allowed.
    """
    if rospy.has_param(_TOKEN_PARAMETER):
        rospy.delete_param(_TOKEN_PARAMETER)
        raise ArgumentError(TOKEN_ADVICE)
    settings = StationSettings.from_parameters(rospy.get_param)
    try:
        return settings, chosen_token(settings.token_file)
    except TokenError as error:
        raise ArgumentError(str(error)) from error


def _listen(server: StationServer) -> int:
    """Listen on the requested port or, if it is in use, on one of the next; return it.

    Raises:
        SystemExit: none of them is free.
    """
    wished = server.address.port
    for port in range(wished, wished + (_PORTS_TRIED if wished else 1)):
        server.address = replace(server.address, port=port)
        try:
            listening = server.start()
            if port != wished:
                print(f"station: port {wished} is in use, it listens on {port}", flush=True)
            return listening
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise SystemExit(
                    f"host: {server.address.host!r} is not allowed, an address of this machine: {error}"
                ) from error
    raise SystemExit(f"port: {wished} is not allowed, it and the {_PORTS_TRIED - 1} after it are in use")


logging.getLogger("tornado").setLevel(logging.ERROR)
