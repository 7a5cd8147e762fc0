"""Topics that a recording has beside MAVROS's, descriptions of positions, and the order of vehicles."""

from __future__ import annotations

import re

EVENTS_TOPIC = "/xtdrone/demo/events"
PROGRESS_TOPIC = "/xtdrone/demo/progress"
SEARCH_EVENTS_TOPIC = "/xtdrone/search/event"
SEARCH_PROGRESS_TOPIC = "/xtdrone/search/progress"
PATTERN_TOPIC = "/xtdrone/formation_pattern"
TOPOLOGY_TOPIC = "/xtdrone/communication_topology"
TRUTH_TOPIC = "/gazebo/model_states"
LOG_TOPIC = "/rosout"
TRUTH = "ground truth of the simulator"
ESTIMATE = "estimate (mavros/local_position/pose)"
ORIGIN = "origin"  # the pattern that is the spawn grid


def odometry_topic(name: str) -> str:
    """Return the topic of a model's true pose and velocity, with time stamps."""
    return f"/xtdrone/{name}/ground_truth/odom"


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key that puts iris_10 behind iris_9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
