"""The private names of rospy that the lockstep relies on, in one place.

rospy offers no public way to replace the ends of a topic, to set the time or to shut down as on a signal.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any
from xmlrpc.client import MultiCall

import rospy
import rospy.core
import rospy.impl.paramserver
import rospy.impl.tcpros_base
import rospy.rostime
import rospy.topics
from rospy.impl.registration import Registration, RegistrationListener, RegManager, get_registration_listeners
from rospy.impl.statistics import SubscriberStatisticsLogger

PublisherImpl: Any = rospy.topics._PublisherImpl
"""Base class of a topic's publishing end, shared by all ``rospy.Publisher`` objects of the topic in a process."""
SubscriberImpl: Any = rospy.topics._SubscriberImpl
"""Base class of a topic's receiving end, shared by all ``rospy.Subscriber`` objects of the topic in a process."""

_ASK_PERIOD = 1.0  # s of wall time


def set_time_us(time_us: int) -> None:
    """Set the time that ``rospy.Time.now`` returns, in microseconds; otherwise only rospy's /clock callback sets it."""
    # Equivalent to rospy's own function in a tenth of the time; that one creates two checked objects and logs a
    # deprecation.
    now = rospy.Time.__new__(rospy.Time)
    seconds, micros = divmod(time_us, 1_000_000)
    now.secs, now.nsecs = seconds, micros * 1000
    module = rospy.rostime
    module._rostime_current = now
    condition = module._rostime_cond
    condition.acquire()
    try:
        if condition._waiters:
            condition.notify_all()
    finally:
        condition.release()


def handle_signal(number: int) -> None:
    """Shut the node down as rospy does on signal ``number``."""
    rospy.core._ros_signal(number, None)


def topic_server_address() -> tuple[str, int]:
    """Start rospy's server of topic connections, if necessary, and return its IP address and TCP port."""
    rospy.impl.tcpros_base.start_tcpros_server()
    server = rospy.impl.tcpros_base._tcpros_server.tcp_ros_server
    return server.addr, server.port


def accept_topic_connection(sock: socket.socket, address: tuple[str, int]) -> None:
    """Make a subscriber's connection as rospy's server does: exchange headers, then add it to the topic or close it."""
    rospy.impl.tcpros_base._tcpros_server._tcp_server_callback(sock, address)


def add_publisher_impl(impl: Any) -> None:
    """Register a publishing end with the topic manager and the master; the caller holds the manager's lock.

    The manager's public ``acquire_impl`` would create rospy's own end.
    """
    manager = rospy.topics.get_topic_manager()
    manager._add(impl, manager.pubs, Registration.PUB)


def add_subscriber_impl(impl: Any) -> None:
    """Register a receiving end with the topic manager and the master; the caller holds the manager's lock."""
    manager = rospy.topics.get_topic_manager()
    manager._add(impl, manager.subs, Registration.SUB)


def watch_param(name: str) -> Callable[[], Any]:
    """Subscribe to a parameter, and return a function that returns its current value, None if it is not set.

    Unlike this function, ``rospy.get_param_cached`` asks the master at every call for a parameter that is not set. As
    rospy loses a notification that comes before the answer to the subscription, the master is asked once a second.
    """
    rospy.get_param_cached(name, None)
    cache = rospy.impl.paramserver.get_param_server_cache()
    asked = time.monotonic()

    def value() -> Any:
        nonlocal asked
        if time.monotonic() - asked > _ASK_PERIOD:
            asked = time.monotonic()
            return rospy.get_param(name, None)
        try:
            return cache.get(name)
        except KeyError:
            return None

    return value


# ---- registration with the master ----


_MOST_CALLS = 500  # of one request, so that the master serves other nodes in between
_CALLS = {
    Registration.PUB: "registerPublisher",
    Registration.SUB: "registerSubscriber",
    Registration.SRV: "registerService",
}


class _Collector(RegistrationListener):  # type: ignore[misc]  # rospy has no types
    """Collects registrations for one node's registration manager."""

    def __init__(self, manager: RegManager) -> None:
        self.manager = manager
        self._added: list[tuple[str, str, str]] = []

    def reg_added(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        """Collect a registration."""
        self._added.append((resolved_name, data_type_or_uri, reg_type))

    def reg_removed(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        """Forward an unregistration, after all earlier registrations."""
        self.flush()
        self.manager.reg_removed(resolved_name, data_type_or_uri, reg_type)

    def flush(self) -> None:
        """Send the collected registrations; those that the master rejects are sent one by one, which logs the cause."""
        added, self._added = self._added, []
        for begin in range(0, len(added), _MOST_CALLS):
            part = added[begin : begin + _MOST_CALLS]
            for registration, publishers in zip(part, _register(self.manager, part), strict=True):
                if publishers is None:
                    self.manager.reg_added(*registration)
                elif registration[2] == Registration.SUB and publishers:  # each update makes rospy check all topics
                    self.manager.publisher_update(registration[0], publishers)


def _register(manager: RegManager, registrations: Sequence[tuple[str, str, str]]) -> list[Any]:
    """Register topics and services in one request, and return the master's answers, None for those that failed.

    Args:
        manager: The node's registration manager.
        registrations: Name, type (URI of a service) and kind of each.
    """
    return _request(manager, [(_CALLS[kind], name, what, manager.uri) for name, what, kind in registrations])


def _request(manager: RegManager, calls: Sequence[tuple[str, ...]]) -> list[Any]:
    """Call functions of the master in one request, and return its answers, None for those that failed.

    Args:
        manager: The node's registration manager.
        calls: Name of each function and its arguments after the node's name.
    """
    # A proxy of its own: with that of rospy, every other question to the master would wait for the answer.
    request = MultiCall(rospy.core.xmlrpcapi(manager.master_uri, cache=False))
    for function, *arguments in calls:
        getattr(request, function)(rospy.get_name(), *arguments)
    try:
        answers: Any = request()
        return [value if code == 1 else None for code, _, value in answers]
    except Exception:  # of the network, of HTTP or of XML-RPC
        return [None] * len(calls)


@contextlib.contextmanager
def registering_together() -> Iterator[None]:
    """Register the topics and services that are created inside with the master in few requests, at the end.

    A request costs node and master a millisecond each; rospy sends one for each topic and two for each subscription.
    """
    listeners = get_registration_listeners()
    with_statistics = SubscriberStatisticsLogger.is_enabled()
    SubscriberStatisticsLogger.is_enabled = classmethod(lambda _: with_statistics)
    with listeners.lock:
        collectors = [_Collector(found) for found in listeners.listeners if isinstance(found, RegManager)]
        for collector in collectors:
            listeners.listeners[listeners.listeners.index(collector.manager)] = collector
    try:
        yield
    finally:
        SubscriberStatisticsLogger.is_enabled = _IS_ENABLED
        with listeners.lock:
            for collector in collectors:
                if collector in listeners.listeners:  # rospy empties the list at a shutdown
                    listeners.listeners[listeners.listeners.index(collector)] = collector.manager
                    collector.flush()


def ask_master_again(topics: Iterable[str]) -> None:
    """Ask the master for the publishers of subscribed topics, and connect to those that have no connection.

    The master's notification may have been lost, or the publisher's answer to it. As the question is a registration,
    it also restores one that the master has lost. It is asked in a thread; one that is under way is not repeated.
    """
    names = sorted(set(topics))
    if names and _asking.acquire(blocking=False):
        threading.Thread(target=_ask, args=(names,), name="lockstep ask master", daemon=True).start()


def _ask(topics: Sequence[str]) -> None:
    try:
        for manager in _registration_managers():
            for begin in range(0, len(topics), _MOST_CALLS):
                _register_again(manager, topics[begin : begin + _MOST_CALLS])
    finally:
        _asking.release()


def _register_again(manager: RegManager, topics: Sequence[str]) -> None:
    """Register those of the topics that are subscribed to, and connect to their publishers.

    rospy's lock is not held meanwhile: with a master that does not answer, the node could not subscribe to anything. So
    a topic may be unsubscribed before the master registers it again: it is unregistered then, and registered once more
    if it has been subscribed to in between.
    """
    while asked := _subscriptions(topics):
        answers = _register(manager, asked)
        kept = {name for name, _, _ in _subscriptions(topics)}
        for (name, _, _), publishers in zip(asked, answers, strict=True):
            if publishers and name in kept:
                manager.publisher_update(name, publishers)
        topics = [name for name, _, _ in asked if name not in kept]
        if topics:
            _request(manager, [("unregisterSubscriber", name, manager.uri) for name in topics])


def _subscriptions(topics: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return name, type and kind of those of the topics that are subscribed to."""
    manager = rospy.topics.get_topic_manager()
    with manager.lock:
        ends = [manager.subs[name] for name in topics if name in manager.subs]
    return [(end.resolved_name, end.type, Registration.SUB) for end in ends]


def _registration_managers() -> list[RegManager]:
    listeners = get_registration_listeners()
    with listeners.lock:
        found = [one.manager if isinstance(one, _Collector) else one for one in listeners.listeners]
    return [one for one in found if isinstance(one, RegManager)]


_asking = threading.Lock()
_IS_ENABLED = SubscriberStatisticsLogger.__dict__["is_enabled"]
