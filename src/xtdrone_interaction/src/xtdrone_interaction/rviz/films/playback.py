"""Playback of a recorded flight to the drawing nodes, in place of the simulator.

This process runs the lockstep server and publishes the recorded messages in simulated time, so each frame shows exactly
the state at its time.
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

from xtdrone_interaction import command_options
from xtdrone_interaction.launching.process_tree import ProcessTree
from xtdrone_interaction.launching.supervised_launch import defer_signals
from xtdrone_interaction.rviz.films.film_options import FilmSettings
from xtdrone_interaction.rviz.films.messages_from_bag import Timed
from xtdrone_interaction.rviz.films.view_nodes import NODES, Stage, StageError, node_environment
from xtdrone_interaction.rviz.markers_node import SEARCH_EVENTS
from xtdrone_interaction.rviz.view_configurations import Array
from xtdrone_lockstep.server import LockstepServer

Idle = Callable[[float], None]

_JOIN_LIMIT = 90.0  # wall s for the nodes to start
_MASTER_LIMIT = 20.0  # wall s
_HANG_LIMIT = 60.0  # wall s
_SLICE = 0.1  # wall s
_LAST_TURNS = 2  # after the end of the record, because messages are drawn two turns later
_NOT_PLAYED = {"/rosout", "/clock", "/tf", "/tf_static"}


class Record(Protocol):
    """A recorded flight, such as :class:`xtdrone_interaction.rviz.films.messages_from_bag.FlightBag`.

    Attributes:
        fleet: such as ``iris:9``.
        types: message type by topic.
        begin_us: simulated time of its start, microseconds.
        flown: positions that the view should show, shape (k, 3), m; None for the default.
    """

    fleet: str
    types: dict[str, str]
    begin_us: int
    flown: Array | None

    def messages(self, topics: Collection[str]) -> Iterator[Timed]:
        """Yield the messages of ``topics`` in order of time."""


def play(settings: FilmSettings, record: Record, work: Path, on_turn: Callable[[int], None]) -> int:
    """Film a recorded flight with a ROS master of its own.

    Args:
        settings: of the film; ``begin`` and ``end`` limit the part of the record.
        record: the flight.
        work: existing folder for files of the nodes.
        on_turn: callback after each turn with the simulated time, microseconds.

    Returns:
        Number of frames.

    Raises:
        StageError: no film was made.
        BagError: from the record.
    """
    with _master(work) as uri:
        os.environ.update(node_environment(uri))
        return _serve(settings, record, work, on_turn)


@contextlib.contextmanager
def _master(work: Path) -> Iterator[str]:
    """Run a ROS master on a free port and yield its URI.

    Raises:
        StageError: it does not start.
    """
    port = command_options.free_port()
    uri = f"http://127.0.0.1:{port}"
    tree = ProcessTree(["rosmaster", "--core", "-p", str(port)], {**os.environ, "ROS_IP": "127.0.0.1"}, work / "master")
    try:
        end = time.monotonic() + _MASTER_LIMIT
        while not rosgraph.is_master_online(uri):
            if tree.wait(_SLICE) or time.monotonic() > end:
                raise StageError(f"rosmaster: does not answer on port {port}")
        yield uri
    finally:
        with defer_signals():
            tree.stop(5.0)


def _serve(settings: FilmSettings, record: Record, work: Path, on_turn: Callable[[int], None]) -> int:
    """Start the nodes and run them with the recorded messages; return the number of frames."""
    import roslib.message
    import rospy

    import xtdrone_lockstep as lockstep
    from xtdrone_common.programs.plain_node import init_plain_node

    init_plain_node("bag_player", disable_rostime=True, disable_signals=True)
    server = LockstepServer(hang_limit=_HANG_LIMIT, log=_log)
    try:
        server.attach_host(lockstep.host())
        rospy.set_param("/use_sim_time", True)
        rospy.set_param("/xtdrone/fleet", record.fleet)
        if settings.world:
            rospy.set_param("/xtdrone/world", settings.world)
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
    """Wait for messages of participants, at most ``timeout`` s; see LockstepServer.tick."""
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
    """Publish all messages at their times, turn by turn."""
    begin_us = max(record.begin_us, round(settings.begin * 1e6))
    end_us = settings.end * 1e6
    source = record.messages(publishers)
    following = next(source, None)
    # Before the start of the film, only the last message of each topic matters.
    held: dict[str, Any] = {}
    while following is not None and following.time_us < begin_us:
        if following.topic == SEARCH_EVENTS:  # but all finds remain
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
            raise StageError("no node takes part any longer")
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
