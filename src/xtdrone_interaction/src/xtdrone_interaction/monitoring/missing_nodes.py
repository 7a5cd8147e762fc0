"""Nodes of a launch that have not joined its simulator, and their states. ROS is not needed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from xtdrone_interaction.monitoring.ended_nodes import SIMULATOR, EndedNode

_NODE = re.compile(r"^    (?P<name>\S+) \((?P<package>[^/)]+)/(?P<program>[^)]+)\)$")
_NAMESPACE = re.compile(r"^  (?P<name>/\S*)$")
_STARTED = re.compile(r"^process\[(?P<node>.+)-(?P<number>\d+)\]: started with pid \[(?P<pid>\d+)\]")
_OTHERS = (
    "recorder",
    "rosbag",
    "rviz",
    "rosout",
    "topic_tools",
    "tf2_ros",
    "image_view",
    "rviz_view.py",
)  # not lockstep participants
_MOST = 6  # nodes named


def not_joined(log: Sequence[str], joined: Iterable[str], ended_nodes: Mapping[str, EndedNode], folder: Path) -> str:
    """Return the nodes that have not joined with their states; empty if none is known.

    Args:
        log: lines of roslaunch's log without colour codes: the list of all nodes, then each started one.
        joined: names of the participants, with the leading slash.
        ended_nodes: nodes that have ended, by name without the leading slash.
        folder: of the logs.
    """
    started = {found["node"]: found for line in log if (found := _STARTED.search(line))}
    there = {name.strip("/") for name in joined}
    parts = []
    for node in (node for node in nodes(log) if node not in there):
        found = started.get(node)
        if node in ended_nodes:
            parts.append(str(ended_nodes[node]))
        elif found is None:
            parts.append(f"{node} was never started")
        else:
            parts.append(f"{node} {_state(int(found['pid']))}, see {_log(folder, node, found['number'])}")
    more = f"; and {len(parts) - _MOST} more" if len(parts) > _MOST else ""
    return "; ".join(parts[:_MOST]) + more


def nodes(log: Iterable[str]) -> list[str]:
    """Return the listed nodes that may be participants, by name without the leading slash."""
    found, namespace = [], ""
    for line in log:
        space, node = _NAMESPACE.search(line), _NODE.search(line)
        if space:
            namespace = space["name"]
        elif not node:
            namespace = ""
        elif namespace and not {node["package"], node["program"]} & {*_OTHERS} and node["name"] != SIMULATOR:
            found.append(f"{namespace}{node['name']}".strip("/"))
    return found


def _node_process(pid: int) -> int:
    """Return the process of a node that roslaunch started as ``pid``: behind ``node_launcher`` it is another one."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    behind_launcher = words[0].endswith(b"/node_launcher") and len(words) > 2 and words[2].isdigit()
    return int(words[2]) if behind_launcher else pid


def _state(pid: int) -> str:
    """Return a description of the state of a node that roslaunch started as ``pid``."""
    try:
        stat = Path(f"/proc/{_node_process(pid)}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return "is gone"
    return "is stopped (SIGSTOP)" if stat.rsplit(")", 1)[1].split()[0] in "Tt" else "runs"


def _log(folder: Path, node: str, number: str) -> str:
    """Return the node's log file if it exists, else the folder."""
    name = f"{node.replace('/', '-')}-{number}"
    own = [path for ending in (".log", "-stdout.log") for path in sorted(folder.glob(f"*/{name}{ending}"))]
    written = [path for path in own if not path.parent.is_symlink() and path.stat().st_size]
    return str(written[0] if written else folder)
