"""Actions of a soak's events: each action of the script is a method."""

from __future__ import annotations

import math
import shutil
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from validation.soak.limits import process_figures
from validation.soak.simulation_under_test import Node, Nodes, Stack
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import FRAME_MISSION, PlanItem
from xtdrone_autopilot.plans.qgc_plan import FRAME_RELATIVE, Plan
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.geodesy import projection
from xtdrone_interaction.bags.bag_kinds import large_batches
from xtdrone_interaction.bags.ros1bag import BagError, BagFile
from xtdrone_interaction.gcs import GcsError, GroundStation, Peer
from xtdrone_interaction.gcs.exchanges import commands_and_refusals, parameters
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat
from xtdrone_interaction.gcs.exchanges.plans import cancel_transfers, upload_plan
from xtdrone_interaction.recording.flight_from_ulog import LogError, read_log

_HOME = (47.397742, 8.545594)  # degrees, of the map's origin, PX4's default in simulation
_PATIENCE = 300.0  # s of wall time without a response from a vehicle, on a busy machine
_CONNECT_LIMIT = 600.0  # s of wall time until a node subscribes to its commands
_LISTEN_LIMIT = 60.0  # s of wall time for a subscriber of a topic; the script may have killed it
_CLIENT_STATUSES = (0, 1)  # exit statuses of a ground station: done, and rejected by a vehicle
_SECOND = 1_000_000  # us
_CLIENTS = {"params": ("params", "save"), "logs": ("logs", "download", "all"), "status": ("status",)}


class Actions:
    """Executes events.

    Attributes:
        counts: events by action.
        refused: rejections by vehicles, by action.
        expected: vehicles commanded to take off, at the time of counting.
        flights: armed ones among them.
        forced: vehicles still armed at the end of an episode.
        lost_words: commands published without a subscriber.
        bags: folder of the recorders.
    """

    def __init__(self, stack: Stack, nodes: Nodes, count: int, speed: float) -> None:
        """Prepare the actions.

        Args:
            stack: the simulation.
            nodes: beside the simulation.
            count: number of vehicles.
            speed: target real-time factor outside of ``speed`` events.
        """
        self.counts: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.expected = 0
        self.flights = 0
        self.forced = 0
        self.lost_words = 0
        self.bags = stack.folder / "bags"
        self.bags.mkdir()
        self._stack = stack
        self._nodes = nodes
        self._speed = speed
        self._peers = [Peer.of(vehicle) for vehicle in parse_fleet(f"iris:{count}")]
        self._publishers: dict[str, Any] = {}
        self._sockets: list[socket.socket] = []
        self._joining = False

    def do(self, action: str, arguments: dict[str, Any]) -> None:
        """Execute an event."""
        self.counts[action] += 1
        method: Callable[..., None] = getattr(self, action)
        method(**arguments)

    def settle(self) -> None:
        """Wait for the nodes started by the events of one time; time continues after they have joined."""
        if self._joining:
            self._joining = False
            self._nodes.await_joined()
        self._nodes.collect()

    # ---- vehicles, over MAVLink

    def _exchange(self, action: str, job: Callable[[Heartbeat, int], Exchange[Any]]) -> list[Any]:
        """Run an exchange with every vehicle from temporary ports; return the results of those that responded."""

        def of(number: int) -> Callable[[Heartbeat], Exchange[Any]]:
            return lambda heartbeat: job(heartbeat, number)

        with GroundStation(self._peers) as station:
            jobs = {peer: of(number) for number, peer in enumerate(self._peers)}
            results = station.run(jobs, patience=_PATIENCE, on_abort=cancel_transfers)
        found = []
        for result in results.values():
            if isinstance(result, GcsError):
                self.refused[f"{action}: {str(result).split(': ', 1)[-1]}"] += 1
            else:
                found.append(result)
        return found

    def log(self, vehicles: Sequence[int]) -> None:
        """Enable flight logs, written while armed, for these vehicles only."""

        def set_mode(heartbeat: Heartbeat, number: int) -> Exchange[Any]:
            return (yield from parameters.change(heartbeat, "SDLOG_MODE", 0.0 if number in vehicles else -1.0))

        self._exchange("log", set_mode)

    def upload(self, plans: Sequence[dict[str, Any]]) -> None:
        """Upload each vehicle's mission."""

        def store(heartbeat: Heartbeat, number: int) -> Exchange[Any]:
            yield from upload_plan(heartbeat.system, mission(plans[number]))

        self._exchange("upload", store)

    def fly_mission(self) -> None:
        """Start the missions of the vehicles that are not armed."""

        def fly(heartbeat: Heartbeat, _number: int) -> Exchange[Any]:
            if not _armed(heartbeat):
                yield from commands_and_refusals.set_mode(heartbeat, "MISSION")
                yield from commands_and_refusals.arm(heartbeat)

        self._exchange("fly_mission", fly)

    def take_off(self, height: float) -> None:
        """Command all vehicles to take off."""

        def climb(heartbeat: Heartbeat, _number: int) -> Exchange[Any]:
            if not _armed(heartbeat):
                yield from commands_and_refusals.take_off(heartbeat, height)

        self._exchange("take_off", climb)

    def count_flying(self, vehicles: Sequence[int]) -> None:
        """Count the armed vehicles among those commanded to take off."""

        def look(heartbeat: Heartbeat, number: int) -> Exchange[bool]:
            yield from ()
            return _armed(heartbeat) and number in vehicles

        self.expected += len(vehicles)
        self.flights += sum(self._exchange("count_flying", look))

    def land(self) -> None:
        """Command all flying vehicles to land in place."""

        def descend(heartbeat: Heartbeat, _number: int) -> Exchange[None]:
            if _armed(heartbeat):
                yield from commands_and_refusals.land(heartbeat)

        self._exchange("land", descend)

    def disarm(self) -> None:
        """Force-disarm the vehicles that are still armed."""

        def force(heartbeat: Heartbeat, _number: int) -> Exchange[bool]:
            if _armed(heartbeat):
                yield from commands_and_refusals.arm(heartbeat, armed=False, force=True)
            return _armed(heartbeat)

        self.forced += sum(self._exchange("disarm", force))

    # ---- nodes

    def start(self, node: str, program: tuple[str, str], arguments: Sequence[str]) -> None:
        """Start a participant of the lockstep."""
        self._nodes.run(node.split("_")[2], node, *program, arguments)
        self._joining = True

    def end(self, node: str, signal: str) -> None:
        """End a node."""
        self._nodes.end(node, signal)

    def halt(self, node: str, wall: float) -> None:
        """Suspend a node while time advances, and resume it after ``wall`` s of wall time."""
        if not self._nodes.signal(node, signal.SIGSTOP):
            return
        timer = threading.Timer(wall, self._nodes.signal, (node, signal.SIGCONT))
        timer.start()
        try:
            self._stack.advance(self._stack.soak_us + _SECOND)
        finally:
            timer.cancel()
            self._nodes.signal(node, signal.SIGCONT)

    def record(self, node: str, topics: Sequence[str]) -> None:
        """Record topics with rosbag."""
        bag = self.bags / f"{node}.bag"
        command = ["rosrun", "rosbag", "record", "--lz4", "-O", str(bag), *topics, f"__name:={node}"]
        self._nodes.await_subscribed(self._nodes.start("record", node, command))

    def client(self, node: str, what: str, vehicle: int) -> None:
        """Start a ground station's command."""
        folder = self._stack.folder / "clients" / node
        folder.mkdir(parents=True)
        words = {"params": [str(folder)], "logs": ["--to", str(folder)], "status": []}[what]
        gcs = [sys.executable, "-m", "xtdrone_interaction", "gcs"]
        command = [*gcs, *_CLIENTS[what], *words, "--vehicle", str(vehicle)]
        started = self._nodes.start(what, node, command, allowed=_CLIENT_STATUSES)
        self._stack.wait_for(lambda: not started.alive or _speaks(started), _CONNECT_LIMIT)

    def burst(self, sockets: int) -> None:
        """Request all parameters from short-lived clients, half of which close before the answer."""
        mav = mavlink.MAVLink(None, srcSystem=250, srcComponent=190)
        for number in range(sockets):
            peer = self._peers[number % len(self._peers)]
            client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            kind, none = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
            for message in (
                mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, 0, 3),
                mavlink.MAVLink_param_request_list_message(peer.system, 1),
            ):
                client.sendto(message.pack(mav), (peer.host, peer.port))
            if number % 2:
                client.close()
            else:
                self._sockets.append(client)

    def end_all(self) -> None:
        """End all nodes and clients."""
        for publisher in self._publishers.values():
            publisher.unregister()
        self._publishers.clear()
        for client in self._sockets:
            client.close()
        self._sockets.clear()
        self._nodes.end_all()
        shutil.rmtree(self._stack.folder / "clients", ignore_errors=True)

    def say(self, topic: str, text: str) -> None:
        """Publish a std_msgs/String."""
        from std_msgs.msg import String

        self._publish(topic, String(text))

    def say_velocity(self, topic: str, velocity: Sequence[float]) -> None:
        """Publish a geometry_msgs/Twist; ``velocity`` in m/s."""
        from geometry_msgs.msg import Twist, Vector3

        self._publish(topic, Twist(linear=Vector3(*velocity)))

    def _publish(self, topic: str, message: Any) -> None:
        import rospy

        if topic not in self._publishers:
            self._publishers[topic] = rospy.Publisher(topic, type(message), queue_size=10)
        publisher = self._publishers[topic]
        listening = any(node.participant and node.alive for node in self._nodes.alive.values())
        if not publisher.get_num_connections() and listening:
            self._stack.wait_for(publisher.get_num_connections, 2.0 if self.lost_words else _LISTEN_LIMIT)
        if not publisher.get_num_connections():
            self.lost_words += 1
            return
        publisher.publish(message)

    # ---- time

    def reset(self, what: str) -> None:
        """Reset the simulation or the world."""
        self._stack.reset(what)

    def pause(self, wall: float) -> None:
        """Resume and pause the simulation, for ``wall`` s of wall time."""
        self._stack.trigger("resume")
        self._stack.trigger("pause")
        self._stack.note_time()
        time.sleep(wall)

    def pause_in_step(self, wall: float) -> None:
        """Pause in the middle of a step, for ``wall`` s of wall time."""
        self._stack.broken_step(_SECOND)
        time.sleep(wall)

    def ticks(self, count: int) -> None:
        """Advance by ``count`` ticks, one step each."""
        for _ in range(count):
            self._stack.tick()

    def speed(self, factor: float) -> None:
        """Set the speed; 0: that of the command line."""
        self._stack.set_speed(factor or self._speed)


def _armed(heartbeat: Heartbeat) -> bool:
    return bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


def _speaks(node: Node) -> bool:
    """Return whether a ground station's process has opened its socket, besides its wake-up pair."""
    try:
        return process_figures(node.process.pid)["sockets"] > 2
    except OSError:
        return False


def mission(content: dict[str, Any]) -> Plan:
    """Return the mission described by the script: takeoff, its waypoints in repeated turns, landing.

    Args:
        content: waypoints (east, north of the map's origin, m), height (m over home), rounds.
    """
    unknown = math.nan
    height = content["height"]

    def item(command: int, place: Sequence[float], up: float) -> PlanItem:
        latitude, longitude = projection.reproject(place[1], place[0], *_HOME)
        return PlanItem(command, FRAME_RELATIVE, (0.0, 0.0, 0.0, unknown), latitude, longitude, up)

    places = content["places"]
    items = [item(plan.TAKEOFF, places[0], height), *(item(plan.WAYPOINT, place, height) for place in places)]
    if content["rounds"]:
        items.append(PlanItem(plan.JUMP, FRAME_MISSION, (1.0, float(content["rounds"]), 0.0, 0.0), 0.0, 0.0, 0.0))
    items.append(item(plan.LAND, places[-1], 0.0))
    return Plan(tuple(items), home=(*_HOME, 0.0))


def read_files(files: Iterable[Path]) -> tuple[int, list[str]]:
    """Read flight logs and bags to their end and remove them.

    Args:
        files: Files that no process writes any more; bags of killed recorders end in ``.active`` and may be cut short.

    Returns:
        Number of messages read, and a sentence for each file that is damaged; these files are kept.
    """
    messages, damaged = 0, []
    for path in files:
        try:
            if path.suffix == ".ulg":
                log = read_log(path, ())
                messages += sum(log.counts.values())
                notes = log.notes
            else:
                bag = BagFile(path)
                messages += sum(len(batch.time) for batch in large_batches(bag))
                notes = [] if path.suffix == ".active" and not bag.damaged else bag.notes
        except (LogError, BagError) as error:
            notes = [] if path.suffix == ".active" and not path.stat().st_size else [str(error)]
        if notes:
            damaged.append(f"{path}: {'; '.join(notes)}")
        else:
            path.unlink()
    return messages, damaged
