"""Write a world of scenery to a file: ``python -m xtdrone_worlds.worlds.scenery --seed 3 --persons 2 -o my.world``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from xtdrone_common.files import write_whole
from xtdrone_worlds.worlds.people_meshes import names
from xtdrone_worlds.worlds.scenery.countryside_layout import CLEAR, LIGHTS, REGION, outdoor
from xtdrone_worlds.worlds.scenery.materials import SPLITS
from xtdrone_worlds.worlds.sdf import write_world


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m xtdrone_worlds.worlds.scenery", description="Write a world made from a seed."
    )
    rectangle: dict[str, Any] = {"type": float, "nargs": 4, "metavar": ("X0", "Y0", "X1", "Y1")}
    parser.add_argument("--seed", type=int, default=0, help="from 0 on; the same seed gives the same world")
    parser.add_argument("--persons", type=int, default=1, help="number of people")
    parser.add_argument("--walking", action="store_true", help="people walk in circuits instead of standing")
    parser.add_argument("--skins", nargs="*", metavar="NAME", help="people to choose from; by default all of them")
    parser.add_argument("--region", **rectangle, default=REGION, help="area of objects and people, m ENU")
    parser.add_argument("--clear", **rectangle, default=CLEAR, help="empty area in which vehicles start")
    parser.add_argument("--person-distance", type=float, default=10.0, help="m that people keep from --clear")
    parser.add_argument("--objects", type=float, default=1.0, help="factor on the number of things, 0 to 3")
    parser.add_argument("--light", choices=LIGHTS, default="noon", help="time of day and weather")
    parser.add_argument("--split", choices=SPLITS, default="all", help="colours, textures and forms to choose from")
    parser.add_argument("-o", "--out", type=Path, required=True, help="file to write, as my.world")
    return parser


def main() -> int:
    """Write the world; return the exit status."""
    arguments: dict[str, Any] = vars(_parser().parse_args())
    out, skins = arguments.pop("out"), arguments.pop("skins")
    try:
        for name in ("region", "clear"):
            arguments[name] = tuple(arguments[name])
        world = outdoor(**arguments, skins=names() if skins is None else skins)
        write_whole(out, write_world(world))
    except (ValueError, OSError) as error:
        print(f"scenery: {error}", file=sys.stderr)
        return 1
    for actor in world.actors:
        x, y, _ = actor.pose.position
        print(f"{actor.name}: {actor.skin or 'any person'} at {x:g} {y:g}")
    print(f"{out}: {len(world.models)} things, {len(world.actors)} people")
    return 0


if __name__ == "__main__":
    sys.exit(main())
