"""What is filmed, and how: the options of ``./xtdrone record-view``."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction import options
from xtdrone_interaction.options import OptionError, checked
from xtdrone_interaction.rviz.views import SHIPPED

DEMOS = ("formation", "simplified", "search")
_RATES = (1.0, 50.0)  # Hz of simulated time, least and most frames
_SIZES = (64, 4096)  # pixels


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed, and how.

    Attributes:
        view: of SHIPPED, or an .rviz file.
        bag: recorded flight; None: the running one.
        demo: flown first, or empty; then ``bag`` is None.
        demo_options: of that demo.
        fps: frames a second of the film.
        faster: how many simulated seconds pass in a second of the film.
        size: width and height, pixels.
        begin, end: part of the flight that is filmed, s of simulated time.
        antialiasing: whether edges are smoothed.
        out: the film.
        frames: folder for PNG files too, or None.
        master: of the running flight: port or URI, or empty: it is looked for.
    """

    view: str
    bag: Path | None
    demo: str
    demo_options: tuple[str, ...]
    fps: float
    faster: float
    size: tuple[int, int]
    begin: float
    end: float
    antialiasing: bool
    out: Path
    frames: Path | None
    master: str

    @property
    def rate(self) -> float:
        """Frames a simulated second."""
        return self.fps / self.faster


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(_SIZES[0] <= side <= _SIZES[1] for side in size):
        raise OptionError(f"size: {text!r} is not allowed; WIDTHxHEIGHT, each {_SIZES[0]} to {_SIZES[1]}, as 1280x720")
    return size


def _positive(name: str) -> Any:
    return checked(lambda text: options.positive(name, text))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Film a flight as rviz shows it, without a screen: a recorded one, one that a demo flies first, or "
        "the one that is running. Options of the demo go after --."
    )
    add = parser.add_argument
    add("view", metavar="VIEW", help=f"{', '.join(SHIPPED)} (made for the vehicles that fly), or an .rviz file")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--bag", type=Path, metavar="FILE", help="flight.bag of a run")
    source.add_argument("--demo", choices=DEMOS, help="fly this demo, then film it")
    add("--out", type=Path, metavar="FILM", help="ends with .mp4 (default: VIEW.mp4 beside the bag, else here)")
    add("--fps", type=_positive("fps"), default=30.0, metavar="N", help="frames a second of the film (default: 30)")
    add("--faster", type=_positive("faster"), default=1.0, metavar="N",
        help="simulated seconds in a second of the film (default: 1)")  # fmt: skip
    add("--size", type=checked(_size), default=(1280, 720), metavar="WxH", help="pixels (default: 1280x720)")
    add("--rough", action="store_true", help="do not smooth edges: drawn in about half the time")
    add("--from", dest="begin", type=float, default=0.0, metavar="S",
        help="of a bag: simulated time at which the film begins")  # fmt: skip
    add("--to", dest="end", type=float, default=math.inf, metavar="S",
        help="of a bag: simulated time of the last frame")  # fmt: skip
    add("--frames", type=Path, metavar="FOLDER", help="write each frame as PNG file too, into a new folder")
    add("--master", default="", metavar="PORT|URI", help="of the running flight (default: it is looked for)")


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parse a command line; the words after ``--`` are kept in ``demo_options``."""
    own = list(words)
    cut = own.index("--") if "--" in own else len(own)
    arguments = parser.parse_args(own[:cut])
    arguments.demo_options = own[cut + 1 :]
    return arguments


def film_settings(argv: Sequence[str]) -> FilmSettings:
    """Return the settings of a command line; see :func:`settings_of`.

    Args:
        argv: options, and after ``--`` those of the demo.

    Raises:
        OptionError: a value that is not allowed.
        SystemExit: argparse's.
    """
    parser = argparse.ArgumentParser(prog="xtdrone record-view")
    add_arguments(parser)
    return settings_of(parse(parser, argv))


def settings_of(arguments: argparse.Namespace) -> FilmSettings:
    """Return what is to be filmed, after all checks that need no ROS.

    Raises:
        OptionError: a value that is not allowed.
    """
    demo_options = arguments.demo_options
    view = arguments.view
    name = Path(view).stem if view.endswith(".rviz") and not Path(view).is_file() else view
    if name not in SHIPPED:
        if not Path(view).is_file():
            raise OptionError(f"view: {view!r} is neither an .rviz file nor one of {', '.join(SHIPPED)}")
        name = str(Path(view).resolve())
    if demo_options and not arguments.demo:
        raise OptionError(f"{demo_options[0]!r}: options of a demo are for --demo only")
    if arguments.bag is not None and not arguments.bag.is_file():
        raise OptionError(f"bag: {arguments.bag} does not exist")
    if not arguments.begin < arguments.end:
        raise OptionError(f"from, to: {arguments.begin:g} s is not before {arguments.end:g} s")
    out = arguments.out or (arguments.bag.parent if arguments.bag else Path()) / f"{Path(name).stem}.mp4"
    if out.suffix != ".mp4":
        raise OptionError(f"out: {str(out)!r} is not allowed; a film ends with .mp4")
    if not out.resolve().parent.is_dir():
        raise OptionError(f"out: {out.resolve().parent} is no folder")
    settings = FilmSettings(
        view=name,
        bag=arguments.bag,
        demo=arguments.demo or "",
        demo_options=tuple(demo_options),
        fps=arguments.fps,
        faster=arguments.faster,
        size=arguments.size,
        begin=arguments.begin,
        end=arguments.end,
        antialiasing=not arguments.rough,
        out=out.resolve(),
        frames=options.new_folder(arguments.frames) if arguments.frames else None,
        master=arguments.master,
    )
    if not _RATES[0] <= settings.rate <= _RATES[1]:
        raise OptionError(
            f"fps, faster: {settings.rate:g} frames a simulated second are not allowed; {_RATES[0]:g} to {_RATES[1]:g}"
        )
    return settings
