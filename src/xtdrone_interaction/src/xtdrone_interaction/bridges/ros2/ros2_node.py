"""ROS node that carries topics to and from ROS 2 over DDS; see ``nodes/ros2_bridge.py``."""

from __future__ import annotations

import fnmatch
import functools
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import rosgraph
import rospy
from cyclonedds.core import DDSException
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

from xtdrone_common.programs.node_command_line import check_no_arguments
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_interaction.bridges.bridge_graph import BridgeGraph
from xtdrone_interaction.bridges.bridge_settings import publications_of
from xtdrone_interaction.bridges.ros2.dds_participant import (
    Participant,
    Published,
    configuration,
    is_fed,
    is_wanted,
    take,
    write,
)
from xtdrone_interaction.bridges.ros2.message_conversion import ConversionError, Converter, converter
from xtdrone_interaction.bridges.ros_publications import PublicationError
from xtdrone_interaction.ending import end_within_limit
from xtdrone_interaction.server_guard import listed
from xtdrone_interaction.server_port import check_not_running, instance_here
from xtdrone_interaction.topics.discovery import UNKNOWN_TYPE, MasterError, TopicGraph
from xtdrone_interaction.topics.message_classes import MessageTypeError, decode, installed_class
from xtdrone_interaction.topics.raw_subscriptions import Listener, RawMessage, RawSubscriptions
from xtdrone_interaction.topics.ros_names import RosNameError

NAME = "ros2_bridge"
_PERIOD = 1.0  # s between two reads of both graphs
_WAIT = 0.1  # s, longest wait for samples
_COMMANDS = ("/xtdrone/*/cmd*", "*/mavros/setpoint_*")


def _domain() -> int:
    """Return ROS_DOMAIN_ID; the number of the instance if it is not set or not 0 to 232.

    Two simulations on a machine have topics of the same names, which must not share a domain.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "")
    return int(text) if text.isdigit() and int(text) <= 232 else instance_here()


def _interface(value: str) -> None:
    if value:
        configuration(value)


@dataclass(frozen=True)
class Ros2Settings(Settings):
    """Private parameters of the node."""

    domain_id: int = setting(
        -1, low=-1, high=232, text="DDS domain, ROS 2's ROS_DOMAIN_ID; -1: that variable's value, or the instance"
    )
    interface: str = setting(
        "lo",
        check=_interface,
        text="network interface; lo: this machine only; auto: chosen by CYCLONEDDS_URI or cyclonedds",
    )
    to_ros2: tuple[str, ...] = setting(
        ("*",), parse=listed, allowed="shell patterns", text="topics of standard types bridged to ROS 2"
    )
    from_ros2: tuple[str, ...] = setting(
        _COMMANDS, parse=listed, allowed="shell patterns", text="topics bridged from ROS 2; none: read-only"
    )


@dataclass
class _Sent:
    """A topic bridged to ROS 2."""

    converter: Converter
    md5sum: str
    writer: DataWriter[Any]
    listener: Listener | None = None
    failed: str = ""


@dataclass
class _Received:
    """A topic bridged from ROS 2."""

    converter: Converter
    kind: Any
    reader: DataReader[Any]
    failed: str = ""


class Ros2Bridge:
    """The bridged topics."""

    def __init__(self, settings: Ros2Settings) -> None:
        """Join the DDS domain; raises as ``Participant``."""
        self._settings = settings
        domain = _domain() if settings.domain_id < 0 else settings.domain_id
        self._participant = Participant(domain, settings.interface)
        self._graph = BridgeGraph(rosgraph.get_master_uri(), ("*",), 0.5 * _PERIOD)
        self._publications = publications_of(self._graph)
        self._raw = RawSubscriptions()
        self._sent: dict[str, _Sent] = {}
        self._received: dict[Published, _Received] = {}
        self._refused: set[tuple[str, str]] = set()

    def run(self) -> None:
        """Carry messages until shutdown."""
        due = 0.0
        while not rospy.is_shutdown():
            self._participant.wait(_WAIT)
            for topic, received in self._received.items():
                self._take(topic.topic, received)
            if time.monotonic() >= due:
                due = time.monotonic() + _PERIOD
                self._update()
        self._raw.close()

    def _update(self) -> None:
        try:
            graph = self._graph.read()
        except MasterError as error:
            rospy.logwarn(f"{NAME}: {error}")
            return
        self._update_sent(graph)
        self._update_received()

    # ---- to ROS 2

    def _update_sent(self, graph: TopicGraph) -> None:
        own = rospy.get_name()
        types = {
            topic.name: topic.type
            for topic in graph.topics.values()
            if topic.type != UNKNOWN_TYPE
            and any(node != own for node in topic.publishers)
            and self._is_sent(topic.name)
        }
        for name in [name for name in self._sent if name not in types]:
            self._unlisten(self._sent.pop(name))
        for name, type_ in types.items():
            if name not in self._sent and (name, type_) not in self._refused:
                self._send(name, type_)
        for name, sent in self._sent.items():
            wanted = is_wanted(sent.writer)
            if wanted and sent.listener is None:
                sent.listener = self._raw.listen(name, functools.partial(self._pass_on, sent))
            elif not wanted:
                self._unlisten(sent)

    def _is_sent(self, name: str) -> bool:
        return _matches(name, self._settings.to_ros2) and not _matches(name, self._settings.from_ros2)

    def _send(self, name: str, type_: str) -> None:
        try:
            kind = installed_class(type_)
            made = converter(type_, kind._md5sum)
            self._sent[name] = _Sent(made, kind._md5sum, self._participant.writer(name, made.name))
        except (ConversionError, MessageTypeError, DDSException) as error:
            self._refused.add((name, type_))
            rospy.logdebug(f"{NAME}: {name} is not bridged to ROS 2: {error}")

    def _unlisten(self, sent: _Sent) -> None:
        if sent.listener is not None:
            sent.listener.close()
            sent.listener = None

    def _pass_on(self, sent: _Sent, raw: RawMessage) -> None:
        """Write a message; called by rospy's threads."""
        try:
            if raw.md5sum != sent.md5sum:
                raise ConversionError(f"{raw.publisher} publishes another {raw.type}, with md5 sum {raw.md5sum}")
            write(sent.writer, sent.converter.name, sent.converter.to_cdr(raw.data))
        except (ConversionError, DDSException) as error:
            if str(error) != sent.failed:
                sent.failed = str(error)
                rospy.logwarn(f"{NAME}: {raw.topic} is not bridged to ROS 2: {error}")

    # ---- from ROS 2

    def _update_received(self) -> None:
        for topic in [topic for topic, received in self._received.items() if not is_fed(received.reader)]:
            self._participant.close_reader(self._received.pop(topic).reader)
            self._publications.unadvertise(NAME, topic.topic)
        for topic in sorted(self._participant.published()):
            wanted = _matches(topic.topic, self._settings.from_ros2)
            if wanted and topic not in self._received and topic not in self._refused:
                self._receive(topic)

    def _receive(self, topic: Published) -> None:
        try:
            kind = installed_class(topic.type)
            made = converter(topic.type, kind._md5sum)
            self._publications.advertise(NAME, topic.topic, topic.type)
            self._received[topic] = _Received(made, kind, self._participant.reader(topic.topic, made.name))
        except (RosNameError, ConversionError, MessageTypeError, PublicationError, MasterError, DDSException) as error:
            self._refused.add((topic.topic, topic.type))
            rospy.logwarn(f"{NAME}: {topic.topic!r} is not bridged from ROS 2: {error}")

    def _take(self, topic: str, received: _Received) -> None:
        for cdr in take(received.reader):
            try:
                message = decode(received.kind, received.converter.to_ros1(cdr))
                self._publications.publish(topic, message)
            except (ConversionError, MessageTypeError, PublicationError, MasterError) as error:
                if str(error) != received.failed:
                    received.failed = str(error)
                    rospy.logwarn(f"{NAME}: {topic} is not bridged from ROS 2: {error}")


def _matches(name: str, shell_patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in shell_patterns)


def main(arguments: Sequence[str]) -> None:
    """Run the node until shutdown.

    Raises:
        ArgumentError: invalid arguments.
        SettingError: a parameter is not allowed.
        ROSInitException: the DDS domain cannot be joined.
    """
    check_no_arguments(arguments)
    check_not_running(NAME)
    init_plain_node(NAME)
    end_within_limit(NAME)
    settings = Ros2Settings.from_parameters(rospy.get_param)
    try:
        bridge = Ros2Bridge(settings)
    except (DDSException, ValueError) as error:
        if isinstance(error, SettingError):
            raise
        text = f"{NAME}: the DDS domain cannot be joined on interface {settings.interface!r}: {error}"
        raise rospy.ROSInitException(text) from error
    rospy.loginfo(f"{NAME}: topics of standard types are bridged to ROS 2's DDS domain")
    bridge.run()
