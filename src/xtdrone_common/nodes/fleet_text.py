#!/usr/bin/env python3
"""Print the value of /xtdrone/fleet for a fleet file, for launch files: ``fleet_text.py FILE``.

Exit status: 0, or 2 if the file is not allowed; the reason goes to standard error.
"""

from __future__ import annotations

import sys

from xtdrone_common.fleet import FleetError, fleet_text, read_fleet_file


def main() -> int:
    """Print the text and return the exit status."""
    if len(sys.argv) != 2:
        print("usage: fleet_text.py FILE", file=sys.stderr)
        return 2
    try:
        print(fleet_text(read_fleet_file(sys.argv[1])))
    except FleetError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
