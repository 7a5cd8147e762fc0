#!/usr/bin/env python3
"""Executes a program outside ROS packages: ``run_file.py FILE [ARGUMENTS]``.

roslaunch starts only programs of packages; with this node a launch file starts a program by its path.
"""

from __future__ import annotations

import os
import sys

if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("run_file.py: the path of an executable file is needed")
    try:
        os.execv(sys.argv[1], sys.argv[1:])
    except OSError as error:
        sys.exit(f"run_file.py: {sys.argv[1]}: {error.strerror}")
