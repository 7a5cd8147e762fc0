"""The hub of one vehicle: its link, the state that its plugins share, and the messages they currently need."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import Decoder, FrameError, decoder, message_name
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_common import frames
from xtdrone_common.geodesy.geoid import undulation
from xtdrone_mavros.feeds import Feed, Need, Ros, Topic
from xtdrone_mavros.lib.plugin_settings import Params, PluginLists
from xtdrone_mavros.lib.refusals import Refusals
from xtdrone_mavros.link.autopilot_links import RAW, AutopilotLink, Throttle
from xtdrone_mavros.link.command_acks import AwaitedCommands
from xtdrone_mavros.link.plan_transfers import PlanTransfers
from xtdrone_mavros.link.ros_values_to_mavlink import FLOAT32_MAX, FLOAT32_RANGE, FieldError, source
from xtdrone_mavros.link.stream_requests import StreamRequests

log = logging.getLogger("rosout.mavros")

_NS = 1_000_000_000
_GEOIDS = ("egm96", "none")
_POLE = 90.0  # deg
_REFRESH_PERIOD = 0.5  # s of ROS time between checks for subscribers
# Hz, where PX4's default rate does not suit: images are projected to the ground with the gimbal's attitude. PX4 does
# not stream the other two to a companion by default; these are its rates for them on other links.
_RATES = {"MOUNT_ORIENTATION": 50.0, "MANUAL_CONTROL": 5.0, "ACTUATOR_CONTROL_TARGET": 10.0}
_HEARTBEAT = MESSAGE_ID["HEARTBEAT"]


class _Slot:
    """Handlers and latest value of one MAVLink message."""

    __slots__ = ("active", "decode", "feeds", "frame", "message")

    def __init__(self, decode: Decoder) -> None:
        self.decode = decode
        self.feeds: list[Feed] = []
        self.active: tuple[Callable[[Any], None], ...] = ()  # handlers of the feeds that are active now
        self.frame: bytes | None = None  # the latest
        self.message: Any = None  # the latest, decoded on first use


class _Timer:
    __slots__ = ("call", "next_ns", "period_ns")

    def __init__(self, period: float, call: Callable[[], None]) -> None:
        self.period_ns = round(period * _NS)
        self.next_ns = 0
        self.call = call


class Plugin:
    """One MAVROS plugin of one vehicle.

    A subclass creates its topics and services in ``__init__`` and fills in:

    Attributes:
        messages: MAVLink message name to its feed or feeds, handled in the main thread; ``RAW`` for every frame.
        replies: MAVLink message name to a handler of the raw frame that the receiver thread calls immediately; for
            answers that a service is waiting for.
    """

    name = ""
    listed = True

    def __init__(self, uas: Uas) -> None:
        """Store the vehicle's hub."""
        self.uas = uas
        self.messages: dict[str | int, Feed | Sequence[Feed]] = {}
        self.replies: dict[str, Callable[[bytes], None]] = {}

    def connected(self, connected: bool) -> None:
        """Handle the first heartbeat of the autopilot or the loss of its heartbeat; the default does nothing."""


class PluginKind(Protocol):
    """A factory of plugins: a plugin class or an equivalent callable.

    Attributes:
        name: the plugin's name.
        listed: whether the plugin lists can deny it by name; otherwise it is part of the node.
    """

    name: str
    listed: bool

    def __call__(self, uas: Uas) -> Plugin:
        """Create the plugin for a vehicle."""


class Uas:
    """Hub of one vehicle.

    Attributes:
        name: the vehicle's name.
        prefix: namespace of its topics, e.g. ``/iris_0/mavros``.
        link: MAVLink connection to its autopilot.
        params: its settings.
        ros: topics, services and time.
        commands: commands awaiting acknowledgement.
        plans: transfers of missions, geofences and rally points.
        refusals: reasons why the autopilot refuses to arm or to change mode.
        arming_held: reason why the vehicle must not be armed yet; empty when it may be.
        target: system and component id of the autopilot.
        connected: whether heartbeats are arriving.
        heartbeat: the latest one, None before the first.
        on_booted: called in the main thread when the autopilot and its estimator have started.
        time_offset_ns: ROS time minus the autopilot's boot time; 0 in simulation, None while unknown.
    """

    def __init__(
        self,
        name: str,
        prefix: str,
        link: AutopilotLink,
        params: Params,
        ros: Ros,
        plugins: Iterable[PluginKind],
        setpoint_namespace: str = "",
    ) -> None:
        """Create the plugins.

        Args:
            name, prefix, link, params, ros: see above.
            plugins: their factories.
            setpoint_namespace: local setpoints are read below ``/<name>/<setpoint_namespace>``, where another node
                publishes them; empty: below ``prefix``.

        Raises:
            ParamError: a setting has the wrong type.
            ValueError: a setting is not allowed.
        """
        self.name = name
        self.prefix = prefix
        self.link = link
        self.params = params
        self.ros = ros
        self.target = link.target
        self.commands = AwaitedCommands(link.send, ros.needs_time)
        self.plans = PlanTransfers(link.send, link.target, ros.needs_time)
        self.refusals = Refusals()
        self.arming_held = ""
        self.connected = False
        self.heartbeat: Any = None
        self.on_booted: Callable[[str], None] = lambda _name: None
        self.time_offset_ns: int | None = 0 if ros.use_sim_time else None
        self.now_ns = 0
        self._time_was_reset = False
        self._throttle = Throttle()
        self._setpoint_prefix = f"/{name}/{setpoint_namespace}" if setpoint_namespace else prefix
        self._topics: list[Need] = []
        self._timers: list[_Timer] = []
        self._connections_seen = -1  # Ros.connection_changes at the latest refresh by the timer
        self._slots: dict[int, _Slot] = {RAW: _Slot(lambda frame: frame)}
        self._attitude_of: Any = None
        self._attitude: tuple[frames.Quaternion, frames.Vector] | None = None
        self._attitude_slot = self._slot("ATTITUDE_QUATERNION")
        self.streams = StreamRequests(self._request_interval, _RATES | params.get("stream_rates", {}))
        self._manage_streams = params.get("manage_streams", True)
        self._geoid = _geoid(params.get("global_position/geoid", _GEOIDS[0]))
        lists = PluginLists(params)
        self.plugins = [kind(self) for kind in plugins if not kind.listed or lists.loads(kind.name)]
        for plugin in self.plugins:
            self._connect(plugin)
        self.timer(_REFRESH_PERIOD, self._follow_demand)
        self.refresh()  # so that the first heartbeat is handled

    # Interface for plugins

    def topic(self, name: str, message: Any, latch: bool = False, on_demand: bool = False) -> Topic:
        """Advertise ``<prefix>/<name>`` (or an absolute name) for messages like ``message``, which is reused.

        Args:
            name: the topic's name.
            message: message object that determines the type.
            latch: keep the last message for later subscribers.
            on_demand: treat a latched topic as needed only while it has subscribers.
        """
        publisher = self.ros.publisher(self._path(name), type(message), latch)
        topic = Topic(publisher, message, latch and not on_demand)
        self._topics.append(topic)
        return topic

    def geoid_height(self, latitude: float, longitude: float) -> float:
        """Return the geoid height above the ellipsoid, m, at a position in degrees; 0 outside the valid range."""
        return self._geoid(latitude, longitude) if abs(latitude) <= _POLE and math.isfinite(longitude) else 0.0

    def share(self, topic: Need) -> None:
        """Add a need shared by all vehicles, such as a topic's subscribers: it also enables this vehicle's streams."""
        self._topics.append(topic)

    def subscribe(self, name: str, kind: type, callback: Callable[[Any], None]) -> None:
        """Subscribe to ``<prefix>/<name>`` (or an absolute name).

        A message with a value that does not fit into MAVLink is rejected with a warning.
        """

        def accept(message: Any) -> None:
            try:
                callback(message)
            except FieldError as error:
                self._refuse(name, message, error)

        self.ros.subscriber(self._path(name), kind, accept)

    def subscribe_setpoint(self, name: str, kind: type, callback: Callable[[Any], None]) -> None:
        """Subscribe to a local setpoint, see ``setpoint_namespace``; otherwise as ``subscribe``."""
        self.subscribe(f"{self._setpoint_prefix}/{name}", kind, callback)

    def service(self, name: str, kind: type, handler: Callable[[Any], Any]) -> None:
        """Offer ``<prefix>/<name>``; a value that does not fit into MAVLink is rejected with a warning."""

        def answer(request: Any) -> Any:
            try:
                return handler(request)
            except FieldError as error:
                self._refuse(name, request, error)
                return _deny(kind)

        self.ros.service(f"{self.prefix}/{name}", kind, answer)

    def timer(self, period: float, call: Callable[[], None]) -> None:
        """Call ``call`` in the main thread, immediately and then every ``period`` seconds of ROS time."""
        self._timers.append(_Timer(period, call))

    def latest(self, name: str) -> Any:
        """Return the latest message ``name``, decoded, or None; a feed must request it."""
        return self._decode(self._slots[MESSAGE_ID[name]])

    def glance(self, name: str) -> Any:
        """Return the latest message ``name``, decoded for the caller alone, or None; in any thread."""
        slot = self._slots[MESSAGE_ID[name]]
        frame = slot.frame
        try:
            return None if frame is None else slot.decode(frame)
        except FrameError:
            return None

    def attitude(self) -> tuple[frames.Quaternion, frames.Vector] | None:
        """Return the latest attitude, FLU to ENU (w, x, y, z), and body rates (rad/s, FLU); None before the first one.

        A plugin that calls this must have a feed for ATTITUDE_QUATERNION.
        """
        message = self._decode(self._attitude_slot)
        if message is not None and message is not self._attitude_of:
            q = frames.attitude_ned_to_enu(message.q1, message.q2, message.q3, message.q4)
            self._attitude = q, frames.frd_to_flu(message.rollspeed, message.pitchspeed, message.yawspeed)
            self._attitude_of = message
        return self._attitude

    def stamp(self, header: Any, time_boot_ms: int) -> None:
        """Set a header's stamp from the autopilot's boot time in milliseconds."""
        self.stamp_us(header, time_boot_ms * 1000)

    def stamp_us(self, header: Any, time_us: int) -> None:
        """Set a header's stamp from the autopilot's boot time in microseconds."""
        offset = self.time_offset_ns
        seconds, header.stamp.nsecs = divmod(self.now_ns if offset is None else time_us * 1000 + offset, _NS)
        header.stamp.secs = seconds & 0xFFFFFFFF  # the autopilot may send any number

    def stamp_now(self, header: Any) -> None:
        """Set a header's stamp to the ROS time."""
        header.stamp.secs, header.stamp.nsecs = divmod(self.now_ns, _NS)

    def boot_ms(self, header: Any = None) -> int:
        """Return a header's stamp (default: now) in milliseconds for a setpoint, truncated to 32 bits as in MAVROS."""
        ns = self.ros.now_ns() if header is None else header.stamp.to_nsec()
        return ns // 1_000_000 & 0xFFFFFFFF

    def finite(self, topic: str, values: Iterable[tuple[str, float]]) -> bool:
        """Return whether all (field, value) pairs are finite 32-bit floats; otherwise warn with topic and field."""
        for field, value in values:
            if not abs(value) <= FLOAT32_MAX:
                self._warn_of(topic, field, value, FLOAT32_RANGE)
                return False
        return True

    def _refuse(self, topic: str, message: Any, error: FieldError) -> None:
        """Warn about a value that does not fit, by its field name in the ROS message if it has one."""
        self._warn_of(topic, source(message, error.value) or error.field, error.value, error.allowed)

    def _warn_of(self, topic: str, field: str, value: Any, allowed: str) -> None:
        if self._throttle.passes(topic):
            path = self._path(topic)
            log.warning("%s: %s is %s; %s is allowed; the message is not forwarded", path, field, value, allowed)

    def _path(self, name: str) -> str:
        return name if name.startswith("/") else f"{self.prefix}/{name}"

    def warn(self, key: str, text: str, *args: Any) -> None:
        """Log a warning about this vehicle, rate-limited for each ``key``."""
        if self._throttle.passes(key):
            log.warning(f"{self.name}: {text}", *args)

    def failed(self, text: str) -> None:
        """Log the exception being handled, rate-limited for each text."""
        if self._throttle.passes(text):
            log.exception("%s: %s", self.name, text)

    # Interface for the node

    def receive(self, now_ns: int, datagrams: int | None = None) -> None:
        """Handle the messages received from the autopilot; call in the main thread.

        Args:
            now_ns: ROS time.
            datagrams: handle datagrams up to this count since the start; None for all that have arrived.
        """
        self.now_ns = now_ns
        frames = self.link.drain(datagrams)
        if self._time_was_reset:
            # Telemetry sent before the time was set back has stamps in the future. A freshly rebooted autopilot has
            # sent only its heartbeat.
            self._time_was_reset = False
            frames = [entry for entry in frames if entry[0] == _HEARTBEAT][-1:]
        for number, frame in frames:
            self.handle(number, frame)

    def on_time_reset(self, now_ns: int) -> None:
        """Start over after a reset of the simulation and the autopilot to their initial state."""
        self.now_ns = now_ns
        self._time_was_reset = True
        for timer in self._timers:
            timer.next_ns = 0
        self.set_connected(False, "restarts: the simulation was reset")
        self._forget()

    def on_reboot(self) -> None:
        """Reset requests and cached values after a reboot of the autopilot."""
        log.warning("%s: autopilot %d.%d has been rebooted", self.name, *self.target)
        self._forget()
        for plugin in self.plugins:
            plugin.connected(True)
        self.refresh()

    def step(self, now_ns: int) -> None:
        """Run the timers; call once per tick in the main thread."""
        self.now_ns = now_ns
        for timer in self._timers:
            # A due time far ahead means that the clock was set back.
            if now_ns >= timer.next_ns or timer.next_ns - now_ns > timer.period_ns:
                timer.next_ns = now_ns + timer.period_ns
                timer.call()

    def handle(self, number: int, frame: bytes) -> None:
        """Pass a frame to the plugins that need it."""
        slot = self._slots[number]
        slot.frame = frame
        slot.message = None
        if not slot.active:
            return
        try:
            message = slot.message = slot.decode(frame)
            for handler in slot.active:
                handler(message)
        except FrameError as error:
            slot.frame = None
            self.warn("frame", "MAVLink frame dropped: %s", error)

    def _follow_demand(self) -> None:
        """Refresh if a subscriber has connected or disconnected since the last call; stop unneeded streams."""
        if self._connections_seen == self.ros.connection_changes:
            self._update_streams()
            return
        self._connections_seen = self.ros.connection_changes
        self.refresh()

    def refresh(self) -> None:
        """Check which topics are needed, and request the messages for them from the autopilot."""
        for topic in self._topics:
            topic.refresh()
        wanted, from_any_sender = set(), set()
        for number, slot in self._slots.items():
            feeds = [feed for feed in slot.feeds if feed.wanted]
            slot.active = tuple(feed.handler for feed in feeds if feed.handler is not None)
            if feeds:
                wanted.add(number)
                if any(feed.any_sender for feed in feeds):
                    from_any_sender.add(number)
        self.link.wanted, self.link.from_any_sender = frozenset(wanted), frozenset(from_any_sender)
        self._update_streams()

    def _update_streams(self) -> None:
        """Request the streams of the needed messages, and stop those that have arrived without being needed."""
        seen, self.link.seen = self.link.seen, {}
        if not (self._manage_streams and self.connected):
            return
        wanted = self.link.wanted - {RAW}
        if any(feed.wanted and feed.all_streams for feed in self._slots[RAW].feeds):
            self.streams.update(wanted | self.streams.stopped_ids(), ())
        else:
            self.streams.update(wanted, seen)

    def set_connected(self, connected: bool, why: str = "lost") -> None:
        """Handle the first heartbeat, or the loss of heartbeats for the reason ``why`` (text of the log line)."""
        if connected == self.connected:
            return
        self.connected = connected
        system, component = self.target
        if connected:
            log.info("%s: connected to autopilot %d.%d on port %d", self.name, system, component, self.link.port)
            self.streams.reconnect()
        else:
            log.warning("%s: connection to autopilot %d.%d %s", self.name, system, component, why)
        for plugin in self.plugins:
            plugin.connected(connected)
        self.refresh()

    def _forget(self) -> None:
        for slot in self._slots.values():
            slot.frame = slot.message = None
        self._attitude_of = self._attitude = None
        self.refusals.reset()
        self.streams.reset()

    def _connect(self, plugin: Plugin) -> None:
        for name, feeds in plugin.messages.items():
            self._slot(name).feeds += [feeds] if isinstance(feeds, Feed) else feeds
        for name, handler in plugin.replies.items():
            self.link.replies[MESSAGE_ID[name]] = handler

    def _slot(self, name: str | int) -> _Slot:
        if isinstance(name, int):
            return self._slots[name]
        number = MESSAGE_ID[name]
        if number not in self._slots:
            self._slots[number] = _Slot(decoder(name))
        return self._slots[number]

    def _decode(self, slot: _Slot) -> Any:
        if slot.message is None and slot.frame is not None:
            try:
                slot.message = slot.decode(slot.frame)
            except FrameError as error:
                slot.frame = None
                self.warn("frame", "MAVLink frame dropped: %s", error)
        return slot.message

    def _request_interval(self, number: int, interval_us: int) -> None:
        log.debug("%s: %s every %d us", self.name, message_name(number), interval_us)
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        system, component = self.target
        self.commands.send(
            command,
            mavlink.MAVLink_command_long_message(
                system, component, command, 0, float(number), float(interval_us), 0.0, 0.0, 0.0, 0.0, 0.0
            ),
        )


def _geoid(model: str) -> Callable[[float, float], float]:
    if model not in _GEOIDS:
        raise ValueError(f"parameter global_position/geoid: {model!r} is not allowed, {' and '.join(_GEOIDS)} are")
    return undulation if model == _GEOIDS[0] else lambda latitude, longitude: 0.0


def _deny(kind: Any) -> Any:
    """Return a service response for a command that was not sent: no success, result "denied" where it has one."""
    response = kind._response_class()
    if hasattr(response, "result"):
        response.result = mavlink.MAV_RESULT_DENIED
    return response
