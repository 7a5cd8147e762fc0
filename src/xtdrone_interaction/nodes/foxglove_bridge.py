#!/usr/bin/env python3
"""Bridge a running flight to Foxglove and Lichtblick: topics, time, parameters, services, publishing.

Parameters:
    ~port (default 8765), ~address (127.0.0.1), ~topics_glob, ~services_glob, ~params_glob, ~operate, ~call_timeout,
    ~send_buffer_limit: see FoxgloveSettings of ``xtdrone_interaction.bridges.foxglove`` and docs/settings.md.
    ~actual_port (set by the node): the port, also if ~port is 0.

Topics and services: those of the graph. It is a plain node: the lockstep does not wait for it. See docs/bridges.md.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_interaction.bridges.foxglove.foxglove_node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "foxglove_bridge.py"))
