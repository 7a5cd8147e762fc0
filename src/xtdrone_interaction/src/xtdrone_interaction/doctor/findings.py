"""Findings on a simulation and its vehicles, derived from readings. ROS is not needed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from xtdrone_common.fleet import COMMAND_TOPICS

ESTIMATES = (
    ("attitude_status_flag", 1, "attitude"),
    ("velocity_horiz_status_flag", 2, "velocity"),
    ("pos_horiz_rel_status_flag", 8, "position"),
    ("pos_vert_abs_status_flag", 32, "height"),
)
"""Estimates that flying OFFBOARD needs: field of mavros_msgs/EstimatorStatus, bit of MAVLink's ESTIMATOR_STATUS_FLAGS,
word."""

SETPOINT_TOPICS = (
    "setpoint_accel/accel",
    "setpoint_attitude/attitude",
    "setpoint_attitude/cmd_vel",
    "setpoint_position/global",
    "setpoint_position/global_to_local",
    "setpoint_position/local",
    "setpoint_raw/attitude",
    "setpoint_raw/global",
    "setpoint_raw/local",
    "setpoint_trajectory/local",
    "setpoint_velocity/cmd_vel",
    "setpoint_velocity/cmd_vel_unstamped",
)
OFFBOARD_SIGNAL = "check_modes_offboard_signal"
_STANDBY = 3  # MAV_STATE; below it, the autopilot is starting
_SLOWEST = 2.0  # Hz; PX4 leaves OFFBOARD with fewer setpoints (its COM_OF_LOSS_T is 1 s)
_HELD = 2.0  # s of wall time in one turn after which a node is named
_NAMES = 6

_WAIT_FOR_ESTIMATOR = "wait a few seconds of simulated time on the ground; an injected sensor failure does not go away"
_WAIT_FOR_POSITION = (
    "after the start this takes a few seconds of simulated time; if it persists, check GPS (an injected failure, "
    "EKF2_GPS_CTRL, SYS_HAS_GPS); without GPS it needs vision or optical flow"
)
_CHARGE = "charge it: ./xtdrone sim reset; BAT1_* has the limits"

CHECK_REMEDIES = {
    "check_modes_cannot_takeoff": "switch to another mode before arming: AUTO.LOITER, AUTO.TAKEOFF or OFFBOARD",
    "check_modes_attitude": "wait until the estimator has started",
    "check_modes_local_pos": _WAIT_FOR_POSITION,
    "check_modes_global_pos": "wait for GPS; without it publish mavros/global_position/set_gp_origin, launch with "
    "datum_known:=true, or fly in OFFBOARD, POSCTL, AUTO.TAKEOFF and AUTO.LAND",
    "check_modes_local_alt": "wait until the estimator has started; later: check EKF2_HGT_REF and the barometer",
    "check_modes_mission": "upload a mission (QGroundControl, ./xtdrone gcs upload), or set COM_ARM_MIS_REQ to 0",
    "check_modes_offboard_signal": "publish setpoints at 2 Hz or faster before switching to OFFBOARD",
    "check_modes_home_position": "wait for GPS, which sets it, or call cmd/set_home",
    "check_modes_manual_control": "connect a joystick or radio, or switch to a mode without: AUTO.LOITER, OFFBOARD",
    "check_battery_unhealthy": _CHARGE,
    "check_battery_critical": _CHARGE,
    "check_battery_emergency": _CHARGE,
    "check_rc_dl_no_dllink": "connect a ground station (QGroundControl, ./xtdrone gcs status), or set NAV_DLL_ACT to 0",
    "check_failure_detector_attitude": "the vehicle is tipped over: ./xtdrone sim reset (limits: FD_FAIL_R, FD_FAIL_P)",
    "check_failure_detector_motor": "a motor has failed: end the injected failure, or ./xtdrone sim reset",
    "check_gf_violation": "it is outside its geofence: clear or move the fence (geofence/clear)",
    "check_estimator_vel_not_stable": f"{_WAIT_FOR_ESTIMATOR}; COM_ARM_EKF_VEL is the limit",
    "check_estimator_pos_not_stable": f"{_WAIT_FOR_ESTIMATOR}; COM_ARM_EKF_POS is the limit",
    "check_estimator_hgt_not_stable": f"{_WAIT_FOR_ESTIMATOR}; COM_ARM_EKF_HGT is the limit",
    "check_estimator_heading_not_stable": f"{_WAIT_FOR_ESTIMATOR}; COM_ARM_EKF_YAW is the limit",
    "check_estimator_gps_fix_too_low": "GPS has no fix: end an injected failure, or set COM_ARM_WO_GPS to 1 to "
    "fly without it",
}
"""Remedy for each failing check of the autopilot, by the name of its event."""
_UNKNOWN_CHECK = "a ground station shows the details; with PX4, its documentation of the check"


@dataclass(frozen=True)
class Finding:
    """A problem.

    Attributes:
        what: the ability that is missing, such as ``arming``.
        text: the problem.
        remedy: what to do about it.
    """

    what: str
    text: str
    remedy: str


@dataclass(frozen=True)
class Graph:
    """The nodes of a ROS master.

    Attributes:
        publishers, subscribers: names of the nodes that answer, by topic.
        silent: registered nodes that do not answer, such as killed ones.
    """

    publishers: Mapping[str, Sequence[str]] = field(default_factory=dict)
    subscribers: Mapping[str, Sequence[str]] = field(default_factory=dict)
    silent: tuple[str, ...] = ()


@dataclass(frozen=True)
class Check:
    """A failing check of the autopilot; see xtdrone_msgs/FailingCheck."""

    name: str
    text: str
    blocks_arming: bool
    blocks_offboard: bool


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """Known state of one vehicle.

    Attributes:
        name: as ``iris_0``.
        prefix: namespace of its MAVROS topics, as ``/iris_0/mavros``.
        served: whether a living node publishes its ``mavros/state``.
        heard: whether that node has reported its state.
        connected: whether that node receives heartbeats from the autopilot.
        armed, mode, system_status: see mavros_msgs/State.
        fcu_url: the link to the autopilot; empty if unknown.
        checks: the autopilot's failing checks; None if it does not report them.
        ready_to_arm: the prearm check of SYS_STATUS; None if unknown.
        missing_estimates: in words, from ESTIMATOR_STATUS; empty if there are none or they are unknown.
        texts: the autopilot's latest warnings.
        setpoint_rate: setpoints received in a second, Hz; None if they were not counted.
        battery: charge, 0 to 1; None if unknown.
        estimates: that the estimator has, of attitude, velocity, position and height; None if unknown.
    """

    name: str
    prefix: str
    served: bool
    heard: bool = False
    connected: bool = False
    armed: bool = False
    mode: str = ""
    system_status: int = 0
    fcu_url: str = ""
    checks: tuple[Check, ...] | None = None
    ready_to_arm: bool | None = None
    missing_estimates: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    setpoint_rate: float | None = None
    battery: float | None = None
    estimates: tuple[str, ...] | None = None

    @property
    def kind(self) -> tuple[str, str]:
        """Type and index, as ``("iris", "0")``."""
        kind, _, index = self.name.rpartition("_")
        return kind, index


@dataclass(frozen=True, kw_only=True)
class Simulator:
    """State of the simulator; see xtdrone_msgs/SimulationStatus.

    Attributes:
        time: simulated, s.
        speed: target real-time factor, 0 for unlimited.
        measured_speed: over the last second.
        participants: of the lockstep.
        waiting_for: participants whose turn is not over.
        waiting: wall time for which the slowest has kept the simulation waiting, s.
        reason: why time stands still; empty while it advances.
    """

    time: float
    speed: float
    measured_speed: float
    paused: bool
    participants: tuple[str, ...]
    waiting_for: tuple[str, ...]
    waiting: float
    reason: str


# ---- the simulation


def examine_simulator(simulator: Simulator, graph: Graph) -> list[Finding]:
    """Return the problems that keep simulated time from advancing."""
    if simulator.paused:
        return [Finding("time", "the simulation is paused", "./xtdrone sim resume")]
    if simulator.waiting_for and simulator.waiting >= _HELD:
        names = listed(simulator.waiting_for)
        return [
            Finding(
                "time",
                f"{names} {_has(simulator.waiting_for)} held up the tick for {simulator.waiting:.0f} s of wall time",
                "a node at a breakpoint may take any time; one that hangs: see its log, then end it (rosnode kill "
                f"{simulator.waiting_for[0]}); the simulator drops a node that stays silent (hang_limit)",
            )
        ]
    if simulator.reason and not simulator.waiting_for:
        dead = [name for name in graph.silent if name not in simulator.participants]
        cause = f"; {listed(dead)} {_has(dead)} died" if dead else ""
        return [
            Finding(
                "time",
                f"{simulator.reason}{cause}",
                "start the missing nodes, or launch with participants:= fitting the nodes that you start",
            )
        ]
    return []


def examine_graph(graph: Graph) -> list[Finding]:
    """Return the nodes that are registered and do not answer."""
    if not graph.silent:
        return []
    return [
        Finding(
            "nodes",
            f"{listed(graph.silent)} {_does(graph.silent)} not answer: dead, or hanging",
            "start again what you need (its log is in the launch's logs/ or ~/.ros/log); 'rosnode cleanup' removes "
            "the names of dead nodes",
        )
    ]


# ---- a vehicle


def examine_vehicle(vehicle: Vehicle, graph: Graph, simulator: Simulator | None) -> list[Finding]:
    """Return why a vehicle does not send data, arm or fly OFFBOARD; a problem that causes others is returned alone."""
    link = _link(vehicle, graph, simulator)
    if link is not None:
        return [link, *_unheard_commands(vehicle, graph)]
    return [
        *_arming(vehicle),
        *_offboard(vehicle, graph),
        *_rivals(vehicle, graph),
        *_unheard_commands(vehicle, graph),
    ]


def _link(vehicle: Vehicle, graph: Graph, simulator: Simulator | None) -> Finding | None:
    if not vehicle.served:
        dead = [name for name in graph.silent if name.endswith("mavros")]
        cause = f"{listed(dead)} {_has(dead)} died" if dead else f"no node publishes {vehicle.prefix}/state"
        return Finding(
            "MAVROS",
            cause,
            "start the launch again; beside a simulation without one: roslaunch launch/mavros.launch, or a real MAVROS "
            "(docs/px4-sitl.md)",
        )
    if vehicle.connected:
        return None
    if simulator is not None and (simulator.reason or simulator.time < 2.0):
        return Finding("link", "the autopilot sends nothing while simulated time stands still", "see 'time' above")
    if not vehicle.heard:
        return Finding(
            "link", f"no message received on {vehicle.prefix}/state", "is the node alive? rosnode ping, and its log"
        )
    link = f" ({vehicle.fcu_url})" if vehicle.fcu_url else ""
    return Finding(
        "link",
        f"MAVROS receives no heartbeat from the autopilot{link}",
        "check that the autopilot runs and that fcu_url has its ports; another program may hold the port (ss -ulnp)",
    )


def _arming(vehicle: Vehicle) -> Iterator[Finding]:
    if vehicle.armed:
        return
    blocking = [check for check in vehicle.checks or () if check.blocks_arming]
    if vehicle.checks is None:
        yield from _arming_by_topics(vehicle)
    elif vehicle.system_status < _STANDBY:
        reasons = "; ".join(check.text for check in blocking if check.name != OFFBOARD_SIGNAL)
        yield Finding(
            "arming",
            f"the estimator is starting{f': {reasons}' if reasons else ''}",
            "wait a few seconds of simulated time",
        )
        return
    for check in blocking:
        if check.name != OFFBOARD_SIGNAL:
            yield Finding("arming", check.text, remedy(check))


def _arming_by_topics(vehicle: Vehicle) -> Iterator[Finding]:
    if vehicle.system_status < _STANDBY:
        yield Finding("arming", "the autopilot is starting", "wait for its estimator")
    elif vehicle.missing_estimates:
        yield Finding(
            "arming",
            f"the estimator has no {listed(vehicle.missing_estimates)}",
            "check GPS or vision (global_position/raw/fix, vision_pose/pose); indoors fly with vision or optical flow",
        )
    elif vehicle.ready_to_arm is False:
        said = f": {'; '.join(vehicle.texts)}" if vehicle.texts else ""
        yield Finding(
            "arming",
            f"the autopilot's prearm checks fail{said}",
            f"rosservice call {vehicle.prefix}/cmd/arming 'value: true': its refusal gives the reason on "
            f"{vehicle.prefix}/statustext/recv",
        )


def _offboard(vehicle: Vehicle, graph: Graph) -> Iterator[Finding]:
    checks = [check for check in vehicle.checks or () if check.blocks_offboard]
    for check in checks:
        # a problem of arming has been named there
        if check.name != OFFBOARD_SIGNAL and (vehicle.armed or not check.blocks_arming):
            yield Finding("OFFBOARD", check.text, remedy(check))
    if vehicle.checks is None:
        silent = vehicle.setpoint_rate is not None and vehicle.setpoint_rate < _SLOWEST
    else:
        silent = any(check.name == OFFBOARD_SIGNAL for check in checks)
    if silent:
        yield _no_setpoints(vehicle, graph)


def _no_setpoints(vehicle: Vehicle, graph: Graph) -> Finding:
    kind, index = vehicle.kind
    publishers = setpoint_publishers(vehicle, graph)
    commands = f"/xtdrone/{vehicle.name}"
    listeners = graph.subscribers.get(f"{commands}/cmd", ())
    dead = [name for name in graph.silent if vehicle.name in name or "communication" in name]
    start = f"rosrun xtdrone_control multirotor_communication.py {kind} {index}"
    if publishers:
        topic, nodes = next(iter(publishers.items()))
        if set(nodes) <= set(listeners):
            return Finding(
                "OFFBOARD",
                f"no setpoints: {listed(nodes)} {_has(nodes)} no velocity or position to pass on",
                f"publish on {commands}/cmd_vel_enu (geometry_msgs/Twist) or {commands}/cmd_pose_enu, or send HOVER on "
                f"{commands}/cmd",
            )
        rate = "" if vehicle.setpoint_rate is None else f" ({vehicle.setpoint_rate:.1f} Hz)"
        return Finding(
            "OFFBOARD",
            f"no stream of setpoints, though {listed(nodes)} publish{_es(nodes)} on {topic}{rate}",
            "publish continuously at 2 Hz or faster, and look for a rejected message in MAVROS's log",
        )
    if dead and not listeners:
        return Finding(
            "OFFBOARD", f"no setpoints arrive: {listed(dead)} {_has(dead)} died", f"start it again, such as {start}"
        )
    if listeners:
        return Finding(
            "OFFBOARD",
            f"no setpoints arrive; {listed(listeners)} takes XTDrone's commands and streams none",
            f"publish on {commands}/cmd_vel_enu (geometry_msgs/Twist) or {commands}/cmd_pose_enu",
        )
    return Finding(
        "OFFBOARD",
        "no setpoints arrive, and no node publishes any",
        f"{start}, which takes XTDrone's commands; or a script of yours that publishes on "
        f"{vehicle.prefix}/setpoint_raw/local at 2 Hz or faster",
    )


def _rivals(vehicle: Vehicle, graph: Graph) -> Iterator[Finding]:
    nodes = sorted({node for nodes in setpoint_publishers(vehicle, graph).values() for node in nodes})
    if len(nodes) > 1:
        yield Finding(
            "OFFBOARD",
            f"{listed(nodes)} all publish setpoints for it, which conflict",
            f"end all but one, such as: rosnode kill {nodes[-1]}",
        )


def _unheard_commands(vehicle: Vehicle, graph: Graph) -> Iterator[Finding]:
    kind, index = vehicle.kind
    topics = [f"/xtdrone/{vehicle.name}/{name}" for name in COMMAND_TOPICS]
    void = [topic for topic in topics if graph.publishers.get(topic) and not graph.subscribers.get(topic)]
    if void:
        nodes = sorted({node for topic in void for node in graph.publishers[topic]})
        yield Finding(
            "commands",
            f"{listed(nodes)} publish{_es(nodes)} on {listed(void)}, which no node subscribes to",
            f"rosrun xtdrone_control multirotor_communication.py {kind} {index}",
        )


def setpoint_publishers(vehicle: Vehicle, graph: Graph) -> dict[str, Sequence[str]]:
    """Return the nodes that publish setpoints for a vehicle, by topic."""
    topics = (f"{vehicle.prefix}/{name}" for name in SETPOINT_TOPICS)
    return {topic: nodes for topic in topics if (nodes := graph.publishers.get(topic, ()))}


def remedy(check: Check) -> str:
    """Return what to do about a failing check."""
    return CHECK_REMEDIES.get(check.name, _UNKNOWN_CHECK)


# ---- wording


def listed(names: Iterable[str]) -> str:
    """Return comma-separated names, only the first few of many."""
    all_names = list(names)
    more = f" and {len(all_names) - _NAMES} more" if len(all_names) > _NAMES else ""
    return ", ".join(all_names[:_NAMES]) + more


def _has(names: Sequence[str]) -> str:
    return "has" if len(names) == 1 else "have"


def _does(names: Sequence[str]) -> str:
    return "does" if len(names) == 1 else "do"


def _es(names: Sequence[str]) -> str:
    return "es" if len(names) == 1 else ""
