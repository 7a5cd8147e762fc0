#!/usr/bin/env python3
"""Records a flight with rosbag, by a profile; see ``xtdrone_interaction.bags.record_by_profile``."""

import sys

from xtdrone_interaction.cli import main

if __name__ == "__main__":
    sys.exit(main(["record", *sys.argv[1:]]))
