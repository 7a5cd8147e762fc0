"""What MAVROS offers and this layer does not: why, and what takes its place.

``docs/mavros.md`` is made from this table and from the plugins. What is offered must be taken out of it, as a test
says.
Plugins' names and topics are those of MAVROS 1.x (``mavros_plugins.xml`` of mavros and mavros_extras).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LeftOut:
    """What of a MAVROS plugin is not offered.

    Attributes:
        why: the reason, as part of a sentence.
        instead: what to use in its place, empty for nothing.
        published: topics that MAVROS publishes, below the vehicle's ``mavros`` namespace unless they begin with "/".
        subscribed: topics that MAVROS subscribes to.
    """

    why: str
    instead: str = ""
    published: tuple[str, ...] = ()
    subscribed: tuple[str, ...] = ()


LEFT_OUT: dict[str, tuple[LeftOut, ...]] = {
    "global_position": (LeftOut("the autopilot's HOME_POSITION is read", subscribed=("home_position/home",)),),
    "guided_target": (
        LeftOut(
            "it is made for ArduPilot's guided mode",
            "setpoint_raw/target_local",
            published=("/move_base_simple/goal",),
            subscribed=("global_position/gp_origin",),
        ),
    ),
    "rangefinder": (LeftOut("only ArduPilot sends it"),),
    "safety_area": (LeftOut("MAVROS's PX4 setting leaves it out", "geofence/push"),),
    "setpoint_position": (
        LeftOut("the autopilot's messages are read", subscribed=("global_position/global", "local_position/pose")),
    ),
    "wheel_odometry": (LeftOut("a simulated multicopter has no such part"),),
    "mavros": (  # the node itself
        LeftOut("a ground station has ports of its own, docs/ground-stations.md", published=("/mavlink/gcs_ip",)),
        LeftOut(
            "fixed axes are turned without asking tf; setpoints listen by their tf/listen",
            published=("/tf_static",),
            subscribed=("/tf", "/tf_static"),
        ),
    ),
}


def plugin_reasons() -> dict[str, str]:
    """Return MAVROS's plugins of which something is left out, to the reason."""
    return {plugin: "; ".join(entry.why for entry in entries) for plugin, entries in LEFT_OUT.items()}


def subscribed() -> dict[str, LeftOut]:
    """Return the topics that MAVROS would take, without the namespace, to their entries."""
    return {topic: entry for entries in LEFT_OUT.values() for entry in entries for topic in entry.subscribed}


def explain(entry: LeftOut) -> str:
    """Return why something is left out and what to use, as the end of a sentence."""
    return f"{entry.why}; use {entry.instead}" if entry.instead else entry.why
