#!/usr/bin/env python3
"""Serve the rosbridge protocol, version 2, for programs based on roslibjs and roslibpy; see docs/bridges.md.

Parameters:
    ~port (default 9090), ~address (127.0.0.1), ~max_message_size, ~topics_glob, ~services_glob, ~params_glob,
    ~operate, ~call_timeout, ~origins: see ``xtdrone_interaction.bridges.rosbridge.rosbridge_node.RosbridgeSettings``
    and docs/settings.md.
    ~actual_port (set by the node): the port, also if ~port is 0.

Topics and services: those requested by clients. It is a plain node: the lockstep does not wait for it.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_interaction.bridges.rosbridge.rosbridge_node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "rosbridge_websocket.py"))
