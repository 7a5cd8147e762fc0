"""``/xtdrone/scene`` as received."""

from __future__ import annotations

from geometry_msgs.msg import Pose as PoseMessage
from xtdrone_msgs.msg import SceneState

from xtdrone_sim.shapes.visual import Pose
from xtdrone_sim.worlds.scene_at import ActorState, SceneAt


def scene_of(message: SceneState) -> SceneAt:
    """Return the poses of a message."""
    links = {name: _pose(pose) for name, pose in zip(message.links, message.poses, strict=True)}
    actors = {
        name: ActorState(_pose(pose), phase)
        for name, pose, phase in zip(message.actors, message.actor_poses, message.actor_phases, strict=True)
    }
    return SceneAt(links, actors)


def _pose(message: PoseMessage) -> Pose:
    p, q = message.position, message.orientation
    return Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))
