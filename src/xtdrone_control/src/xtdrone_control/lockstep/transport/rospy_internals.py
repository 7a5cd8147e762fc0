"""The private names of rospy that the lockstep relies on, in one place.

rospy offers no public way to replace the ends of a topic, to set the time or to shut down as on a signal.
"""

from __future__ import annotations

from typing import Any

import rospy
import rospy.core
import rospy.rostime
import rospy.topics
from rospy.impl.registration import Registration

PublisherImpl: Any = rospy.topics._PublisherImpl
"""Base class of a topic's publishing end, shared by all ``rospy.Publisher`` objects of the topic in a process."""
SubscriberImpl: Any = rospy.topics._SubscriberImpl
"""Base class of a topic's receiving end, shared by all ``rospy.Subscriber`` objects of the topic in a process."""


def set_time_us(time_us: int) -> None:
    """Set the time that ``rospy.Time.now`` returns, in microseconds; otherwise only rospy's /clock callback sets it."""
    seconds, micros = divmod(time_us, 1_000_000)
    rospy.rostime._set_rostime(rospy.Time(seconds, micros * 1000))


def handle_signal(number: int) -> None:
    """Shut the node down as rospy does on signal ``number``."""
    rospy.core._ros_signal(number, None)


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
