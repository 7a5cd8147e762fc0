#!/usr/bin/env python3
"""Serve the browser station: a page on the running flight; see ``xtdrone_interaction.web.station_node`` and
docs/web.md.

Parameters:
    ~host, ~port, ~token_file, ~origins, ~names, ~view_only, ~rate: see ``StationSettings`` and docs/settings.md.
    ~url (out): URL of the page, without the token.

Topics:
    /xtdrone/live_states (in): while a page is open; /gazebo/model_states where no node publishes it.
    /clock, /simulator/status (in); further topics as the pages' panels need them.
    /xtdrone/operator_actions (std_msgs/String, out): actions of the pages' users, as JSON; recorded in bags.
"""

import sys

from xtdrone_common.programs.node_command_line import run_program
from xtdrone_interaction.web.station_node import main

if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "web_station.py"))
