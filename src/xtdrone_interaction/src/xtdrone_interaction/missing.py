"""Which nodes of a launch have not joined its simulator, and what is known of each. No ROS is needed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from xtdrone_interaction.deaths import SIMULATOR, Death

_NODE = re.compile(r"^    (?P<name>\S+) \((?P<package>[^/)]+)/(?P<program>[^)]+)\)$")
_NAMESPACE = re.compile(r"^  (?P<name>/\S*)$")
_STARTED = re.compile(r"^process\[(?P<node>.+)-(?P<number>\d+)\]: started with pid \[(?P<pid>\d+)\]")
_OTHERS = ("rosbag", "rviz", "rosout", "topic_tools", "tf2_ros", "image_view", "rviz_view.py")  # take no part
_MOST = 6  # that are named


def not_joined(log: Sequence[str], joined: Iterable[str], deaths: Mapping[str, Death], folder: Path) -> str:
    """Return the nodes that have not joined, with what is known of each; empty where none is known.

    Args:
        log: lines of roslaunch's log, without colours; it lists all nodes, then those that it starts.
        joined: names of the participants, with the leading slash.
        deaths: nodes that have ended, by their names without it.
        folder: of the logs.
    """
    started = {found["node"]: found for line in log if (found := _STARTED.search(line))}
    there = {name.strip("/") for name in joined}
    parts = []
    for node in (node for node in nodes(log) if node not in there):
        found = started.get(node)
        if node in deaths:
            parts.append(str(deaths[node]))
        elif found is None:
            parts.append(f"{node} was never started")
        else:
            parts.append(f"{node} {_state(int(found['pid']))}, see {_log(folder, node, found['number'])}")
    more = f"; and {len(parts) - _MOST} more" if len(parts) > _MOST else ""
    return "; ".join(parts[:_MOST]) + more


def nodes(log: Iterable[str]) -> list[str]:
    """Return the nodes that roslaunch lists and that may take part: their names without the leading slash."""
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


def _state(pid: int) -> str:
    """Return what a process does, in words."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return "is gone"
    return "is stopped (SIGSTOP)" if stat.rsplit(")", 1)[1].split()[0] in "Tt" else "runs"


def _log(folder: Path, node: str, number: str) -> str:
    """Return a node's own log where it has one, else the folder."""
    name = f"{node.replace('/', '-')}-{number}"
    own = [path for ending in (".log", "-stdout.log") for path in sorted(folder.glob(f"*/{name}{ending}"))]
    written = [path for path in own if not path.parent.is_symlink() and path.stat().st_size]
    return str(written[0] if written else folder)
