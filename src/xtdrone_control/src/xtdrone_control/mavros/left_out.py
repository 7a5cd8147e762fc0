"""Parts of MAVROS that this layer does not offer, with the reason and the replacement.

``docs/mavros.md`` is generated from this table and from the plugins; a test fails if the table lists an offered topic.
Names of plugins and topics are those of MAVROS 1.x (``mavros_plugins.xml`` of mavros and mavros_extras).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LeftOut:
    """The part of a MAVROS plugin that is not offered.

    Attributes:
        why: the reason, as part of a sentence.
        instead: the replacement, empty for none.
        published: topics that MAVROS publishes, below the vehicle's ``mavros`` namespace unless they begin with "/".
        subscribed: topics that MAVROS subscribes to.
    """

    why: str
    instead: str = ""
    published: tuple[str, ...] = ()
    subscribed: tuple[str, ...] = ()


LEFT_OUT: dict[str, tuple[LeftOut, ...]] = {
    "global_position": (LeftOut("HOME_POSITION of the autopilot is used", subscribed=("home_position/home",)),),
    "guided_target": (
        LeftOut(
            "it serves ArduPilot's guided mode",
            "setpoint_raw/target_local",
            published=("/move_base_simple/goal",),
            subscribed=("global_position/gp_origin",),
        ),
    ),
    "rangefinder": (LeftOut("only ArduPilot sends it"),),
    "safety_area": (LeftOut("MAVROS's configuration for PX4 denies it", "geofence/push"),),
    "setpoint_position": (
        LeftOut("the autopilot's messages are used", subscribed=("global_position/global", "local_position/pose")),
    ),
    "wheel_odometry": (LeftOut("a simulated multicopter has no wheels"),),
    "mavros": (  # the node itself
        LeftOut("ground stations use their own ports, docs/ground-stations.md", published=("/mavlink/gcs_ip",)),
        LeftOut(
            "frame rotations are fixed and need no tf; setpoint plugins use tf with tf/listen",
            published=("/tf_static",),
            subscribed=("/tf", "/tf_static"),
        ),
    ),
}


def plugin_reasons() -> dict[str, str]:
    """Return the reasons by MAVROS plugin, for plugins that are not offered in full."""
    return {plugin: "; ".join(entry.why for entry in entries) for plugin, entries in LEFT_OUT.items()}


def subscribed() -> dict[str, LeftOut]:
    """Return the topics that only MAVROS subscribes to, without the namespace, with their entries."""
    return {topic: entry for entries in LEFT_OUT.values() for entry in entries for topic in entry.subscribed}


def explain(entry: LeftOut) -> str:
    """Return the reason and the replacement as the end of a sentence."""
    return f"{entry.why}; use {entry.instead}" if entry.instead else entry.why
