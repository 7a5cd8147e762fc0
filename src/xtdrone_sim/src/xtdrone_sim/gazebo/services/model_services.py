"""Gazebo's services and topics for the models of the running simulation.

=================================  ==============================  =====================================================
services, below /gazebo            type in gazebo_msgs
=================================  ==============================  =====================================================
get_model_state, get_link_state    GetModelState, GetLinkState     relative to any model, link or the world
get_model_properties               GetModelProperties              links, joints, whether it is static
get_link_properties                GetLinkProperties               mass, inertia, centre of mass
set_model_state, set_link_state    SetModelState, SetLinkState     vehicles, models and people, in any frame
spawn_sdf_model, spawn_urdf_model  SpawnModel                      static or movable models
delete_model                       DeleteModel                     models and people
apply_body_wrench                  ApplyBodyWrench                 on vehicles and movable models
clear_body_wrenches                BodyRequest
set_model_configuration            SetModelConfiguration           joints of gimbals and landing gears
others                                                             see ``refused_services``
=================================  ==============================  =====================================================

=================================  ==============================  =====================================================
topics, below /gazebo (in)
=================================  ==============================  =====================================================
set_model_state, set_link_state    ModelState, LinkState
set_model_states                   ModelStates                     many at once; disarmed vehicles and models are held
there for half a second =================================  ==============================
=====================================================

Changes are made between two steps. A request that a lockstep participant makes in its turn is answered at once and
carried out after the turn, in the order of the senders' names, so that a flight does not depend on the speed of the
nodes. The same holds for messages of participants. All other requests are carried out at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, NamedTuple

import rospy
from gazebo_msgs import srv
from gazebo_msgs.msg import LinkState, ModelState, ModelStates

import xtdrone_lockstep as lockstep
from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.gazebo.models_by_name import Change, Models
from xtdrone_sim.gazebo.models_in_requests import model_of_sdf, model_of_urdf
from xtdrone_sim.gazebo.request_limits import LONGEST_TEXT, RequestError
from xtdrone_sim.gazebo.scene_topics import ModelTopics
from xtdrone_sim.gazebo.services.model_queries import Queries
from xtdrone_sim.gazebo.states import microseconds, read_pose, read_state, read_wrench
from xtdrone_sim.mailbox import ClosedError, Mailbox
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.worlds.sdf import SdfModel

_WARNING_PERIOD = 5.0  # wall s between two equal warnings
_HOLD_STEPS = 125  # s for which a model or disarmed vehicle is held where /gazebo/set_model_states has put it

_JOINTS = (
    "joints of vehicles are moved by their autopilots (gimbal: mavros/mount_control/command, landing gear: no command) "
    "and set by /gazebo/set_model_configuration"
)
_LIGHT = "the world has one sun, which is that of the world file (docs/worlds.md)"
_MASS = "mass and inertia are those of a vehicle's or a model's description; delete the model and spawn another one"

REFUSED = {
    "apply_joint_effort": (srv.ApplyJointEffort, f"joints have no efforts here: {_JOINTS}"),
    "clear_joint_forces": (srv.JointRequest, f"joints have no efforts here: {_JOINTS}"),
    "get_joint_properties": (srv.GetJointProperties, "angles and rates of joints are on /VEHICLE/joint_states"),
    "set_joint_properties": (srv.SetJointProperties, f"joints have no engine parameters here: {_JOINTS}"),
    "set_link_properties": (srv.SetLinkProperties, _MASS),
    "get_light_properties": (srv.GetLightProperties, _LIGHT),
    "set_light_properties": (srv.SetLightProperties, _LIGHT),
    "delete_light": (srv.DeleteLight, _LIGHT),
}
"""Type and reason by the name of the service below /gazebo."""

Plan = Callable[[], Change]
"""Checks a request against the current state, and returns the change; raises RequestError."""


class _Deferred(NamedTuple):
    """A request to be carried out after the turn of its caller."""

    caller: str
    what: str
    plan: Plan


class GazeboServices:
    """The services and topics; all methods but the handlers are called in the simulator's thread."""

    def __init__(self, simulation: Simulation, models: Models, topics: ModelTopics, server: LockstepServer) -> None:
        """Store the objects that the requests need; see ``open``.

        Args:
            simulation: the simulation.
            models: its models.
            topics: publishes changes to other nodes.
            server: lockstep server, which knows the participants that are in their turn.
        """
        self._simulation, self._models, self._topics, self._server = simulation, models, topics, server
        self._deferred: list[_Deferred] = []
        self._told: set[str] = set()

    def open(self, mailbox: Mailbox) -> None:
        """Advertise services and subscribe to topics; called after ``lockstep.host()``.

        Args:
            mailbox: passes requests to the simulator's thread.
        """
        self._mailbox = mailbox
        changes: tuple[tuple[str, Any, Callable[[Any], Change]], ...] = (
            ("set_model_state", srv.SetModelState, lambda request: self._model_state(request.model_state)),
            ("set_link_state", srv.SetLinkState, lambda request: self._link_state(request.link_state)),
            ("delete_model", srv.DeleteModel, lambda request: self._models.deleting(request.model_name)),
            ("apply_body_wrench", srv.ApplyBodyWrench, self._wrench),
            ("set_model_configuration", srv.SetModelConfiguration, self._configuration),
        )
        for name, kind, plan in changes:
            rospy.Service(f"/gazebo/{name}", kind, partial(self._serve, kind, plan))
        rospy.Service("/gazebo/spawn_sdf_model", srv.SpawnModel, partial(self._spawn, model_of_sdf))
        rospy.Service("/gazebo/spawn_urdf_model", srv.SpawnModel, partial(self._spawn, model_of_urdf))
        rospy.Service("/gazebo/clear_body_wrenches", srv.BodyRequest, self._clear_wrenches)
        queries = Queries(self._simulation, self._models)
        for name, kind, query in queries.table():
            rospy.Service(f"/gazebo/{name}", kind, lambda request, query=query: self._in_thread(query, request))
        for name, (kind, reason) in REFUSED.items():
            rospy.Service(f"/gazebo/{name}", kind, partial(_refuse, kind, f"/gazebo/{name} is not supported: {reason}"))
        lockstep.Subscriber("/gazebo/set_model_state", ModelState, self._on_model_state)
        lockstep.Subscriber("/gazebo/set_model_states", ModelStates, self._on_model_states)
        lockstep.Subscriber("/gazebo/set_link_state", LinkState, self._on_link_state)

    def act(self) -> None:
        """Dispatch the messages of a tick, and carry out the requests of its participants; called after each tick."""
        lockstep.host().receive()
        if not self._deferred:
            return
        deferred, self._deferred = self._deferred, []
        for request in sorted(deferred, key=lambda one: one.caller):
            try:
                self._carry_out(request.plan, request.caller)
            except RequestError as error:
                rospy.logwarn("simulator: %s of %s: %s", request.what, request.caller, error)

    def restart(self) -> None:
        """Start again with the models of the world file."""
        self._deferred.clear()
        self._told.clear()
        changed = bool(self._models.added or self._models.deleted)
        self._models.restart()
        if changed:
            self._topics.announce()

    # handlers, called in rospy's threads

    def _in_thread(self, function: Callable[[Any], Any], request: Any) -> Any:
        """Return ``function(request)``, called in the simulator's thread.

        Raises:
            ServiceException: the simulator shuts down.
        """

        def act(answer: Future[Any]) -> None:
            answer.set_result(function(request))

        try:
            return self._mailbox.put(act).result()
        except ClosedError as error:
            raise rospy.ServiceException(str(error)) from error

    def _change(self, request: Any, plan: Plan) -> tuple[bool, str]:
        """Return whether a change is made, and a description of it or the reason why not."""
        caller = str(request._connection_header["callerid"])
        what = str(request._connection_header["service"])
        try:
            return True, self._in_thread(lambda _: self._decide(caller, what, plan), request)
        except RequestError as error:
            return False, str(error)

    def _decide(self, caller: str, what: str, plan: Plan) -> str:
        """Carry out a request now, or after the turn of its caller; return a description.

        Raises:
            RequestError: the request is rejected.
        """
        participant = self._server.participants.get(caller)
        if participant is None or not participant.waiting:
            return self._carry_out(plan, caller)
        plan()
        self._deferred.append(_Deferred(caller, what, plan))
        return f"carried out at the end of this turn of {caller}"

    def _carry_out(self, plan: Plan, caller: str) -> str:
        before = (len(self._models.names), len(self._models.deleted))
        text = plan()()
        rospy.loginfo("simulator: %s, by %s", text, caller)
        if before != (len(self._models.names), len(self._models.deleted)):
            self._topics.announce()
        return text

    def _serve(self, kind: Any, plan: Callable[[Any], Change], request: Any) -> Any:
        """Return the response of a service whose requests ``plan`` checks."""
        return kind._response_class(*self._change(request, lambda: plan(request)))

    def _spawn(self, read: Callable[[str], SdfModel], request: Any) -> srv.SpawnModelResponse:
        try:
            if len(request.model_xml) > LONGEST_TEXT:
                many = len(request.model_xml)
                raise RequestError(f"model_xml: {many} characters are not allowed, at most {LONGEST_TEXT}")
            model, pose = read(request.model_xml), read_pose(request.initial_pose)
        except RequestError as error:
            return srv.SpawnModelResponse(False, str(error))

        def plan(request: Any) -> Change:
            return self._models.adding(request.model_name, model, pose, request.reference_frame)

        return self._serve(srv.SpawnModel, plan, request)

    def _wrench(self, request: Any) -> Change:
        begin = max(microseconds(request.start_time), self._simulation.time_us)
        duration = microseconds(request.duration)
        # Gazebo applies a wrench of no duration in one step.
        end = None if duration < 0 else begin + (duration or self._simulation.step_us)
        return self._models.pushing(request.body_name, request.reference_frame, read_wrench(request), begin, end)

    def _clear_wrenches(self, request: Any) -> srv.BodyRequestResponse:
        success, text = self._change(request, lambda: self._models.releasing(request.body_name))
        if not success:
            raise rospy.ServiceException(text)
        return srv.BodyRequestResponse()

    def _configuration(self, request: Any) -> Change:
        return self._models.setting_joints(request.model_name, request.joint_names, request.joint_positions)

    # messages, dispatched in the simulator's thread

    def _on_model_state(self, message: ModelState) -> None:
        self._heed("/gazebo/set_model_state", message.model_name, message, lambda: self._model_state(message))

    def _on_link_state(self, message: LinkState) -> None:
        self._heed("/gazebo/set_link_state", message.link_name, message, lambda: self._link_state(message))

    def _on_model_states(self, message: ModelStates) -> None:
        topic = "/gazebo/set_model_states"
        if not len(message.name) == len(message.pose) == len(message.twist):
            sizes = f"{len(message.name)} names, {len(message.pose)} poses and {len(message.twist)} twists"
            rospy.logwarn_throttle(
                _WARNING_PERIOD, f"simulator: {topic}: {sizes} are not allowed, as many of each as names"
            )
            return
        for name, pose, twist in zip(message.name, message.pose, message.twist, strict=True):

            def plan(name: str = name, pose: Any = pose, twist: Any = twist) -> Change:
                return self._models.moving(name, read_state(pose, twist), "", hold_steps=_HOLD_STEPS)

            self._heed(topic, name, message, plan)

    def _heed(self, topic: str, name: str, message: Any, plan: Plan) -> None:
        """Carry out a message, with one log line for each topic and model."""
        sender = message._connection_header["callerid"]
        try:
            text = plan()()
        except RequestError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"simulator: {topic} of {sender}: {error}")
            return
        key = f"{topic} {name}"
        if key not in self._told and len(self._told) < 1000:
            self._told.add(key)
            rospy.loginfo("simulator: %s, by %s of %s; further messages are not logged", text, topic, sender)

    def _model_state(self, state: ModelState) -> Change:
        wanted = read_state(state.pose, state.twist)
        return self._models.moving(state.model_name, wanted, state.reference_frame)

    def _link_state(self, state: LinkState) -> Change:
        wanted = read_state(state.pose, state.twist)
        return self._models.moving_link(state.link_name, wanted, state.reference_frame)


def _refuse(kind: Any, text: str, _request: Any) -> Any:
    """Answer a request of a service that is not supported."""
    response = kind._response_class()
    if not hasattr(response, "success"):
        raise rospy.ServiceException(text)
    response.success, response.status_message = False, text
    return response
