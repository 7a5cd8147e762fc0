#!/usr/bin/env python3
"""Simulator node of all vehicles; parameters: see ``xtdrone_sim.node.Settings``."""

import sys

from xtdrone_sim.node import main

sys.exit(main())
