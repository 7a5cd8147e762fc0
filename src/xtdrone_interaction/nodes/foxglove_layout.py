#!/usr/bin/env python3
"""Write a layout for Foxglove or Lichtblick: ``foxglove_layout.py formation iris:30 > my_layout.json``.

Arguments:
    view: formation or search.
    fleet: vehicles such as iris:9; default: the fleet of the layouts in config/foxglove.

It needs no ROS master.
"""

import argparse
import sys

from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_interaction.bridges.foxglove.layouts import VIEWS, layout, to_text

_FLEETS = {"formation": "iris:9", "search": "typhoon_h480:6"}


def main() -> int:
    """Print the layout; return the exit status."""
    parser = argparse.ArgumentParser(description="Write a layout for Foxglove or Lichtblick to standard output.")
    parser.add_argument("view", choices=VIEWS)
    parser.add_argument("fleet", nargs="?", default="", help="vehicles such as iris:9")
    arguments = parser.parse_args()
    try:
        fleet = parse_fleet(arguments.fleet or _FLEETS[arguments.view])
    except FleetError as error:
        parser.error(str(error))
    sys.stdout.write(to_text(layout(arguments.view, fleet)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
