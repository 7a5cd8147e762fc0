"""Layouts of Foxglove and Lichtblick for this project's flights: panels and their contents, as a JSON file to import.

The format is that of Foxglove Studio 1.x, which both programs import: panels by name, and a tree of halves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from xtdrone_common.fleet import Vehicle
from xtdrone_interaction.recording.topics import SEARCH_EVENTS_TOPIC, SEARCH_PROGRESS_TOPIC
from xtdrone_interaction.rviz.markers_node import TOPIC as MARKERS_TOPIC

_PLOTTED = 12  # vehicles with lines in a plot; more could not be distinguished
_PICTURES = 6
_COLOURS = ("#4e98e2", "#f5774d", "#f7df71", "#5cd6a9", "#a395e2", "#f5a8c9")
_CAMERA_VIEW = {
    "perspective": True,
    "distance": 40,
    "phi": 60,
    "thetaOffset": 45,
    "targetOffset": [0, 0, 0],
    "fovy": 45,
}
Panel = Mapping[str, Any]


@dataclass(frozen=True)
class _Half:
    """Two halves of a window, the first left or above."""

    direction: str
    first: Any
    second: Any
    percentage: float

    def tree(self) -> Panel:
        parts = [part.tree() if isinstance(part, _Half) else part for part in (self.first, self.second)]
        return {
            "direction": self.direction,
            "first": parts[0],
            "second": parts[1],
            "splitPercentage": self.percentage,
        }


def layout(view: str, fleet: Sequence[Vehicle]) -> dict[str, Any]:
    """Return the layout of a view.

    Args:
        view: one of ``VIEWS``.
        fleet: the vehicles; the first leads a formation.
    """
    panels, windows = VIEWS[view]([vehicle.name for vehicle in fleet])
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": windows.tree(),
    }


def to_text(made: Mapping[str, Any]) -> str:
    """Return a layout as the text of its file."""
    return json.dumps(made, indent=1) + "\n"


def _formation(names: Sequence[str]) -> tuple[dict[str, Panel], _Half]:
    panels = {
        "3D!swarm": _scene(names, [MARKERS_TOPIC, "/tf", "/xtdrone/leader/pose"]),
        "Plot!height": _plot("height, m", [(n, f"{_pose(n)}.pose.position.z") for n in names]),
        "Plot!speed": _plot(
            "velocity to the east, m/s",
            [(n, f"/{n}/mavros/local_position/velocity_local.twist.linear.x") for n in names],
        ),
        "Plot!avoidance": _plot("avoidance to the east, m/s", [(n, f"/xtdrone/{n}/avoid_vel.x") for n in names]),
        "Publish!leader": _publish("/xtdrone/leader/cmd", "std_msgs/String", {"data": "pyramid"}),
        **_common(names),
    }
    plots = _Half("column", "Plot!height", _Half("column", "Plot!speed", "Plot!avoidance", 50), 34)
    below = _Half("row", _Half("row", "Publish!leader", "RosOut!log", 30), "StateTransitions!modes", 55)
    return panels, _Half("column", _Half("row", "3D!swarm", plots, 62), below, 72)


def _search(names: Sequence[str]) -> tuple[dict[str, Panel], _Half]:
    pictures = {f"Image!{i}": _image(f"/uav_{i}/darknet_ros/detection_image") for i in range(len(names[:_PICTURES]))}
    panels = {
        "3D!search": _scene(names, [MARKERS_TOPIC, "/tf"]),
        "RawMessages!progress": {"topicPath": f"{SEARCH_PROGRESS_TOPIC}.data", "diffEnabled": False},
        "RawMessages!event": {"topicPath": f"{SEARCH_EVENTS_TOPIC}.data", "diffEnabled": False},
        "Plot!height": _plot("height, m", [(n, f"{_pose(n)}.pose.position.z") for n in names]),
        **pictures,
        **_common(names),
    }
    texts = _Half("column", "RawMessages!progress", "RawMessages!event", 60)
    below = _Half(
        "row", _Half("row", texts, "RosOut!log", 40), _Half("row", "Plot!height", "StateTransitions!modes", 50), 50
    )
    above = _Half("row", "3D!search", _grid(list(pictures)), 45)
    return panels, _Half("column", above, below, 65)


VIEWS = {"formation": _formation, "search": _search}
"""Functions of the vehicles' names that return panels and windows, by the view's name."""


def _common(names: Sequence[str]) -> dict[str, Panel]:
    modes = [
        {"value": f"/{n}/mavros/state.mode", "timestampMethod": "receiveTime", "label": n} for n in names[:_PLOTTED]
    ]
    return {
        "RosOut!log": {"searchTerms": [], "minLogLevel": 2, "topicToRender": "/rosout"},
        "StateTransitions!modes": {"paths": modes, "isSynced": True},
    }


def _pose(name: str) -> str:
    return f"/{name}/mavros/local_position/pose"


def _scene(names: Sequence[str], topics: Sequence[str]) -> Panel:
    shown = [*topics, *map(_pose, names)]
    return {
        "cameraState": {
            **_CAMERA_VIEW,
            "target": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "near": 0.5,
            "far": 5000,
        },
        "followMode": "follow-none",
        "followTf": "map",
        "layers": {
            "grid": {"layerId": "foxglove.Grid", "visible": True, "frameId": "map", "size": 100, "divisions": 20}
        },
        "topics": {topic: {"visible": True} for topic in shown},
        "transforms": {},
        "publish": {"type": "point", "poseTopic": "/move_base_simple/goal", "pointTopic": "/clicked_point"},
        "imageMode": {},
    }


def _plot(title: str, lines: Sequence[tuple[str, str]]) -> Panel:
    paths = [
        {
            "value": path,
            "enabled": True,
            "timestampMethod": "receiveTime",
            "label": name,
            "color": _COLOURS[i % len(_COLOURS)],
        }
        for i, (name, path) in enumerate(lines[:_PLOTTED])
    ]
    return {
        "foxglovePanelTitle": title,
        "lichtblickPanelTitle": title,
        "paths": paths,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
        "followingViewWidth": 60,
    }


def _image(topic: str) -> Panel:
    return {"imageMode": {"imageTopic": topic}, "cameraState": {}, "topics": {}, "layers": {}, "transforms": {}}


def _publish(topic: str, type_: str, value: Any) -> Panel:
    return {
        "topicName": topic,
        "datatype": type_,
        "buttonText": "Send",
        "buttonTooltip": "",
        "advancedView": True,
        "value": json.dumps(value),
    }


def _grid(panels: Sequence[str]) -> Any:
    """Return windows side by side and below each other, about equally large."""
    if len(panels) == 1:
        return panels[0]
    middle = (len(panels) + 1) // 2
    direction = "column" if len(panels) > 3 else "row"
    return _Half(direction, _grid(panels[:middle]), _grid(panels[middle:]), 100 * middle / len(panels))
