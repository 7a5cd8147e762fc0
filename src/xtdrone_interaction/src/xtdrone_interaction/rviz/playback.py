"""A recorded flight as the nodes that draw see it: this process stands for the simulator.

It has the lockstep's server and sends the record's messages in their simulated time, so each frame shows exactly what
there was at its moment.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import rosgraph

from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_interaction import options
from xtdrone_interaction.launched import signals_wait
from xtdrone_interaction.processes import ProcessTree
from xtdrone_interaction.rviz.bag import Timed
from xtdrone_interaction.rviz.film_options import FilmSettings
from xtdrone_interaction.rviz.node import SEARCH_EVENTS
from xtdrone_interaction.rviz.stage import NODES, Stage, StageError, node_environment
from xtdrone_interaction.rviz.views import Array

Idle = Callable[[float], None]

_JOIN_LIMIT = 90.0  # wall s for the nodes to start
_MASTER_LIMIT = 20.0  # wall s
_HANG_LIMIT = 60.0  # wall s
_SLICE = 0.1  # wall s
_LAST_TURNS = 2  # after the record's end: what it says last is drawn two turns later
_NOT_PLAYED = {"/rosout", "/clock", "/tf", "/tf_static"}


class Record(Protocol):
    """A recorded flight, as :class:`xtdrone_interaction.rviz.bag.FlightBag`.

    Attributes:
        fleet: as ``iris:9``.
        types: message type of each topic.
        begin_us: simulated time at which it begins, microseconds.
        flown: where its vehicles are in it, shape (k, 3), m; None if that does not matter.
    """

    fleet: str
    types: dict[str, str]
    begin_us: int
    flown: Array | None

    def messages(self, topics: Collection[str]) -> Iterator[Timed]:
        """Yield the messages of ``topics`` in the order of their times."""


def play(settings: FilmSettings, record: Record, work: Path, on_turn: Callable[[int], None]) -> int:
    """Have a film made of a record, at a ROS master of its own.

    Args:
        settings: of the film; ``begin`` and ``end`` bound the part of the record.
        record: of a flight.
        work: folder, which is there, for what the nodes write.
        on_turn: called after each turn with the simulated time, microseconds.

    Returns:
        How many frames the film has.

    Raises:
        StageError: there is no film.
        BagError: the record's.
    """
    with _master(work) as uri:
        os.environ.update(node_environment(uri))
        return _serve(settings, record, work, on_turn)


@contextlib.contextmanager
def _master(work: Path) -> Iterator[str]:
    """Run a ROS master on a free port and give its URI.

    Raises:
        StageError: it does not start.
    """
    port = options.free_port()
    uri = f"http://127.0.0.1:{port}"
    tree = ProcessTree(["rosmaster", "--core", "-p", str(port)], {**os.environ, "ROS_IP": "127.0.0.1"}, work / "master")
    try:
        end = time.monotonic() + _MASTER_LIMIT
        while not rosgraph.is_master_online(uri):
            if tree.wait(_SLICE) or time.monotonic() > end:
                raise StageError(f"rosmaster: does not answer on port {port}")
        yield uri
    finally:
        with signals_wait():
            tree.stop(5.0)


def _serve(settings: FilmSettings, record: Record, work: Path, on_turn: Callable[[int], None]) -> int:
    """Be the simulator of the nodes, with what the record has."""
    import roslib.message
    import rospy

    from xtdrone_control import lockstep

    rospy.init_node("bag_player", disable_rostime=True, disable_signals=True)
    server = LockstepServer(hang_limit=_HANG_LIMIT, log=_log)
    try:
        server.attach_host(lockstep.host())
        rospy.set_param("/use_sim_time", True)
        rospy.set_param("/xtdrone/fleet", record.fleet)
        rospy.set_param("/lockstep/uri", server.uri)
        with Stage(dict(os.environ), work) as stage:
            stage.start_all(settings, record.fleet, flown=record.flown)
            idle = partial(_idle, stage, server)
            if not server.wait_for(NODES, _JOIN_LIMIT, idle):
                raise StageError(f"after {_JOIN_LIMIT:g} s: {server.missing(NODES)}")
            wanted = {topic for topic, _ in rosgraph.Master("/bag_player").getSystemState()[1]}
            publishers = {
                topic: lockstep.Publisher(topic, roslib.message.get_message_class(record.types[topic]))
                for topic in sorted(wanted & record.types.keys() - _NOT_PLAYED)
            }
            server.wait_for(NODES, _JOIN_LIMIT, idle)
            _run(settings, record, server, publishers, idle, on_turn)
            return stage.finish()
    finally:
        server.close()
        rospy.signal_shutdown("the film is finished")


def _idle(stage: Stage, server: LockstepServer, timeout: float) -> None:
    """Wait until a participant has something to say, at most ``timeout`` s; see LockstepServer.tick."""
    stage.check()
    select.select([server.fileno()], [], [], min(timeout, _SLICE))


def _run(
    settings: FilmSettings,
    record: Record,
    server: LockstepServer,
    publishers: Mapping[str, Any],
    idle: Idle,
    on_turn: Callable[[int], None],
) -> None:
    """Send all messages in their time, turn by turn."""
    begin_us = max(record.begin_us, round(settings.begin * 1e6))
    end_us = settings.end * 1e6
    source = record.messages(publishers)
    following = next(source, None)
    # What was before the film's beginning is not drawn; of each topic the last message is what holds then.
    held: dict[str, Any] = {}
    while following is not None and following.time_us < begin_us:
        if following.topic == SEARCH_EVENTS:  # and all finds
            publishers[following.topic].publish(following.message)
        held[following.topic] = following.message
        following = next(source, None)
    for topic in held.keys() - {SEARCH_EVENTS}:
        publishers[topic].publish(held[topic])
    now_us, after = begin_us - 1, 0
    while after < _LAST_TURNS:
        idle(0.0)
        due_us = server.next_due_us(now_us)
        if due_us is None:
            raise StageError("none of the nodes takes part any longer")
        now_us = due_us
        while following is not None and following.time_us <= min(now_us, end_us):
            publishers[following.topic].publish(following.message)
            following = next(source, None)
        server.tick(now_us, {}, idle)
        after += following is None or now_us >= end_us
        on_turn(now_us)


def _log(level: int, text: str) -> None:
    if level >= logging.WARNING:
        print(f"lockstep: {text}", file=sys.stderr)
