#!/usr/bin/env python3
"""An idle participant, for measuring the cost of the barrier: ``lockstep_idle.py NAME RATE``."""

import sys
from collections.abc import Sequence

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, run_program


def main(arguments: Sequence[str]) -> None:
    """Take part under the name and at the rate (Hz) given by the two arguments."""
    if len(arguments) != 2:
        raise ArgumentError(f"expected two arguments, a name and a rate in Hz, got {len(arguments)}")
    name, rate = arguments
    try:
        lockstep.init_node(name, rate=float(rate))
    except ValueError as error:
        raise ArgumentError(str(error)) from error
    lockstep.start()
    lockstep.spin()


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "lockstep_idle.py NAME RATE"))
