"""``./xtdrone analyse FILE``: report and pictures of any recording.

Exit status: 0 when a report was written, 1 when nothing can be read, 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console

from xtdrone_interaction import command_options
from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.missions.formation.report import find_formation
from xtdrone_interaction.missions.map_report import map_rows
from xtdrone_interaction.recording.flight_from_ulog import LogError
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.analyse import analyse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Write report and pictures of a recorded flight: report.html, which needs no other file, the "
        "pictures as PNG, and report.json. No ROS is needed."
    )
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="FILE", help="ROS 1 bag or ULog, also one truncated by a crash, ROS 2 "
        "bag, or flight.npz; or the bags of a split recording")  # fmt: skip
    add("--part", type=int, metavar="N", help="of a bag in which time was set back (default: the longest)")
    add(
        "--world", metavar="WORLD", help="world of the flight, by name or file: compare its maps with the true surfaces"
    )
    add("--map", type=Path, action="append", default=[], metavar="FILE", help="saved map to compare, too: an octree "
        ".bt or .ot, or a cloud .ply, .xyz")  # fmt: skip
    add("--out", type=Path, metavar="FOLDER", help="where the report goes (default: <file>-analysis beside the file)")


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    first = arguments.files[0]
    try:
        for file in arguments.files:
            if not file.exists():
                raise BagError(f"analyse: {str(file)!r} does not exist")
        if arguments.map and arguments.world is None:
            raise OptionError("map: --map needs --world, with whose surfaces it is compared")
        world = None if arguments.world is None else command_options.world(arguments.world)
        folder = command_options.output_folder(arguments.out, first.with_name(f"{first.stem}-analysis"))
        maps = map_rows(arguments.files, world, arguments.map, part=arguments.part) if world else []
        analyse(arguments.files, folder, Console(), arguments.part, find_formation, maps)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (BagError, LogError, RecordError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0
