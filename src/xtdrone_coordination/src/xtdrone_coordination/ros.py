"""What a program of your own needs to run its follower class as a node: ``sys.exit(run_follower(MyFollower))``."""

from __future__ import annotations

from xtdrone_coordination.follower_nodes import run_avoidance as run_avoidance
from xtdrone_coordination.follower_nodes import run_follower as run_follower
