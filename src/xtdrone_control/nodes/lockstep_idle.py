#!/usr/bin/env python3
"""A participant that does nothing, to measure what the barrier costs: ``lockstep_idle.py NAME RATE``."""

import sys
from collections.abc import Sequence

from xtdrone_control import lockstep
from xtdrone_control.communication.arguments import ArgumentError, run_program


def main(arguments: Sequence[str]) -> None:
    """Take part under the name and at the rate (Hz) that the two arguments give."""
    if len(arguments) != 2:
        raise ArgumentError(f"two arguments are needed, a name and a rate in Hz, {len(arguments)} were given")
    name, rate = arguments
    try:
        lockstep.init_node(name, rate=float(rate))
    except ValueError as error:
        raise ArgumentError(str(error)) from error
    lockstep.start()
    lockstep.spin()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "lockstep_idle.py NAME RATE"))
