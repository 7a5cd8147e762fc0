"""The bridge's participant in a DDS domain: writers and readers of ROS 2's topics, and topics that others publish."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from xtdrone_interaction.bridges.ros2.dds_types import carrier, dds_topic, ros1_type, ros_topic

_DEPTH = 10  # samples of a topic that a writer keeps for slow readers
_LATCHED = 100  # samples kept for later readers of a topic with many latched messages
_MANY_LATCHED = ("/tf_static",)
_PARTICIPANTS = 60  # participants searched for on this machine
AUTO = "auto"  # in place of an interface: roslaunch drops arguments with an empty value
_INTERFACE = re.compile(r"[A-Za-z0-9_.:-]{1,40}")
_AT_ONCE = 100  # samples taken at a time
_READABLE = SampleState.NotRead | ViewState.Any | InstanceState.Any


class Published(NamedTuple):
    """A topic that another participant publishes: its name and type in ROS 1."""

    topic: str
    type: str


def configuration(interface: str) -> str:
    """Return cyclonedds's configuration for one network interface.

    On ``lo`` there is no multicast: other participants of this machine are found by asking their ports.

    Raises:
        ValueError: not a name or address of an interface.
    """
    if not _INTERFACE.fullmatch(interface):
        raise ValueError(
            f"a network interface such as lo or eth0, or {AUTO} for the choice of CYCLONEDDS_URI or cyclonedds"
        )
    local = interface in ("lo", "127.0.0.1")
    peers = '<Peers><Peer address="localhost"/></Peers>' if local else ""
    attribute = "address" if interface[0].isdigit() else "name"
    return (
        f'<CycloneDDS><Domain><General><Interfaces><NetworkInterface {attribute}="{interface}"/></Interfaces>'
        f"<AllowMulticast>{'false' if local else 'default'}</AllowMulticast></General>"
        f"<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_PARTICIPANTS}</MaxAutoParticipantIndex>{peers}</Discovery></Domain></CycloneDDS>"
    )


class Participant:
    """A participant. All methods except ``write`` are called by one thread."""

    def __init__(self, domain_id: int, interface: str) -> None:
        """Join a domain.

        Args:
            domain_id: ROS 2's ROS_DOMAIN_ID.
            interface: network interface; ``auto`` or empty: chosen by CYCLONEDDS_URI or cyclonedds.

        Raises:
            ValueError: the interface is not allowed.
            DDSException: the domain cannot be joined.
        """
        self._domain = None if interface in ("", AUTO) else Domain(domain_id, configuration(interface))
        self._participant = DomainParticipant(domain_id)
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._changes = ReadCondition(self._publications, _READABLE)
        self._published: dict[Any, Published] = {}  # by the writer's key
        self._waitset = WaitSet(self._participant)
        self._never = GuardCondition(self._participant)  # without any condition, a waitset does not wait
        self._waitset.attach(self._never)
        self._conditions: dict[DataReader[Any], ReadCondition] = {}

    def writer(self, topic: str, name: str) -> DataWriter[Any]:
        """Return a writer of a topic; ``name``: its type in ROS 2.

        A reader that is too slow loses samples. A late reader that requests it receives the last sample, as from a
        latched topic.
        """
        kept = _LATCHED if topic in _MANY_LATCHED else 1
        qos = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0),
            Policy.History.KeepLast(_DEPTH),
            Policy.Durability.TransientLocal,
            Policy.DurabilityService(0, Policy.History.KeepLast(kept), -1, -1, -1),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        return DataWriter(self._participant, Topic(self._participant, dds_topic(topic), carrier(name)), qos=qos)

    def reader(self, topic: str, name: str) -> DataReader[Any]:
        """Return a reader of a topic; ``name``: its type in ROS 2."""
        qos = Qos(
            Policy.Reliability.BestEffort,
            Policy.History.KeepLast(_DEPTH),
            Policy.Durability.Volatile,
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        reader = DataReader(self._participant, Topic(self._participant, dds_topic(topic), carrier(name)), qos=qos)
        self._conditions[reader] = ReadCondition(reader, _READABLE)
        self._waitset.attach(self._conditions[reader])
        return reader

    def close_reader(self, reader: DataReader[Any]) -> None:
        """End a reader."""
        self._waitset.detach(self._conditions.pop(reader))

    def wait(self, limit: float) -> None:
        """Wait for samples, at most ``limit`` s."""
        self._waitset.wait(duration(seconds=limit))

    def published(self) -> set[Published]:
        """Return the topics of ROS 2 that other participants publish."""
        while changed := self._publications.take(N=_AT_ONCE, condition=self._changes):
            for endpoint in changed:
                self._note(endpoint)
        return set(self._published.values())

    def _note(self, endpoint: Any) -> None:
        """Store a writer that has come, and forget one that has gone."""
        if not endpoint.sample_info.valid_data:
            self._published.pop(endpoint.key, None)
        elif not self._is_own(endpoint):
            topic, type_ = ros_topic(endpoint.topic_name), ros1_type(endpoint.type_name)
            if topic and type_:
                self._published[endpoint.key] = Published(topic, type_)

    def _is_own(self, endpoint: Any) -> bool:
        return bool(endpoint.participant_key == self._participant.guid)


def is_wanted(writer: DataWriter[Any]) -> bool:
    """Return whether a reader of another participant matches a writer."""
    return bool(writer.get_publication_matched_status().current_count)


def is_fed(reader: DataReader[Any]) -> bool:
    """Return whether a writer of another participant matches a reader."""
    return bool(reader.get_subscription_matched_status().current_count)


def write(writer: DataWriter[Any], name: str, cdr: bytes) -> bool:
    """Write a sample; return False if a slow reader blocks the queue."""
    try:
        writer.write(carrier(name)(cdr))
    except DDSException as error:
        if error.code == DDSException.DDS_RETCODE_TIMEOUT:
            return False
        raise
    return True


def take(reader: DataReader[Any]) -> Iterator[bytes]:
    """Yield the CDR of received samples."""
    for sample in reader.take(N=_AT_ONCE):
        cdr = getattr(sample, "cdr", None)
        if cdr is not None and sample.sample_info.valid_data:
            yield cdr
