"""Gazebo's services that query models; the handlers are called in the simulator's thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rospy
from gazebo_msgs import srv
from gazebo_msgs.msg import LinkState
from std_msgs.msg import Header

from xtdrone_common.poses import Pose
from xtdrone_sim.gazebo.models_by_name import Models
from xtdrone_sim.gazebo.request_limits import RequestError, unknown
from xtdrone_sim.gazebo.states import pose_message, relative_to, twist_message
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.worlds.sdf import DEFAULT_INERTIAL
from xtdrone_worlds.worlds.urdf import Inertial


class Queries:
    """The read-only services."""

    def __init__(self, simulation: Simulation, models: Models) -> None:
        """Store the objects that the responses need.

        Args:
            simulation: the simulation.
            models: its models.
        """
        self._simulation, self._models = simulation, models

    def table(self) -> list[tuple[str, Any, Callable[[Any], Any]]]:
        """Return name below /gazebo, type and handler of each service."""
        return [
            ("get_model_state", srv.GetModelState, self._get_model_state),
            ("get_link_state", srv.GetLinkState, self._get_link_state),
            ("get_model_properties", srv.GetModelProperties, self._get_model_properties),
            ("get_link_properties", srv.GetLinkProperties, self._get_link_properties),
        ]

    def _get_model_state(self, request: Any) -> srv.GetModelStateResponse:
        name, frame = request.model_name, request.relative_entity_name
        try:
            if "::" in name and self._models.model(name) is None:
                raise RequestError(f"model_name: {name!r} is a link, get_link_state returns its state")
            state = self._models.find("model_name", name)
            seen = relative_to(state, self._models.find("relative_entity_name", frame, frame=True))
        except RequestError as error:
            return srv.GetModelStateResponse(success=False, status_message=str(error))
        now_us = self._simulation.time_us
        header = Header(stamp=rospy.Time(now_us // 1_000_000, now_us % 1_000_000 * 1000), frame_id=frame)
        return srv.GetModelStateResponse(header, pose_message(seen.pose), twist_message(seen), True, "")

    def _get_link_state(self, request: Any) -> srv.GetLinkStateResponse:
        name, frame = request.link_name, request.reference_frame
        try:
            state = self._models.find_link("link_name", name)
            seen = relative_to(state, self._models.find("reference_frame", frame, frame=True))
        except RequestError as error:
            return srv.GetLinkStateResponse(LinkState(), False, str(error))
        found = LinkState(name, pose_message(seen.pose), twist_message(seen), frame)
        return srv.GetLinkStateResponse(found, True, "")

    def _get_model_properties(self, request: Any) -> srv.GetModelPropertiesResponse:
        name = request.model_name
        model, vehicle = self._models.model(name), self._models.vehicle(name)
        parts: list[tuple[str, int]]
        joints: list[str] = []
        if name == "ground_plane":
            parts, static = [("link", 1)], True
        elif vehicle is not None:
            urdf = self._simulation.models[vehicle].urdf
            parts = [(link.name, len(link.collisions)) for link in urdf.moving]
            joints, static = [joint.name for joint in urdf.joints], False
        elif model is not None:
            parts, static = [(link.name, len(link.collisions)) for link in model.links], model.static
        elif self._models.actor(name) is not None:
            parts, static = [], False
        else:
            error = unknown("model_name", name, self._models.present)
            return srv.GetModelPropertiesResponse(success=False, status_message=str(error))
        return srv.GetModelPropertiesResponse(
            canonical_body_name=parts[0][0] if parts else "",
            body_names=[part for part, _ in parts],
            geom_names=[f"{part}_collision_{k}" for part, count in parts for k in range(count)],
            joint_names=joints,
            is_static=static,
            success=True,
        )

    def _get_link_properties(self, request: Any) -> srv.GetLinkPropertiesResponse:
        try:
            inertial, gravity = self._mass_of(request.link_name)
        except RequestError as error:
            return srv.GetLinkPropertiesResponse(success=False, status_message=str(error))
        ixx, iyy, izz, ixy, ixz, iyz = inertial.inertia
        return srv.GetLinkPropertiesResponse(
            com=pose_message(inertial.pose),
            gravity_mode=gravity,
            mass=inertial.mass,
            **{"ixx": ixx, "iyy": iyy, "izz": izz, "ixy": ixy, "ixz": ixz, "iyz": iyz},
            success=True,
        )

    def _mass_of(self, name: str) -> tuple[Inertial, bool]:
        """Return mass and whether gravity acts; the body of a vehicle has the mass of the whole vehicle."""
        self._models.find("link_name", name)
        base, _, part = name.partition("::")
        vehicle = self._models.vehicle(base)
        if vehicle is not None:
            model = self._simulation.models[vehicle]
            if part in ("", model.urdf.root):
                record = self._simulation.world.models[vehicle]
                ixx, iyy, izz = record["inertia"].tolist()
                return Inertial(float(record["mass"]), Pose(), (ixx, iyy, izz, 0.0, 0.0, 0.0)), True
            found = next((link for link in model.urdf.links if link.name == part), None)
            return (found.inertial if found is not None and found.inertial else Inertial(0.0, Pose(), (0.0,) * 6)), True
        part_of = self._models.link(name)
        if part_of is None:
            raise RequestError(f"link_name: {name!r} has no mass")
        owner, link = part_of
        return link.inertial or DEFAULT_INERTIAL, link.gravity and not owner.static
