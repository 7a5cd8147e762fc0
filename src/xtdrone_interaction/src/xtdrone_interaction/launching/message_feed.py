"""Messages of a running launch, received by a child process, so that only the child blocks on an unresponsive master.

The child is this module, run as a program: a node that writes one line of JSON per message received. It polls the
master until that answers; it exits at the end of its standard input, or with its parent.

Lines have a ``kind``:

===========  ======================================================================================================
master       the master answers and the topics are subscribed
status       of the simulator: ``text``: reason for a standstill, ``held``: whether that is intended, ``joined``: names
             of the lockstep participants, ``time``: simulated, s, ``paused``
warning      of the flight's recorder, which can record no more: ``text``
estimators   every vehicle's estimator has started; ``time``: simulated, s
(others)     JSON of the std_msgs/String messages on the requested topics, as ``message``
===========  ======================================================================================================
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Mapping, Sequence
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_interaction.launching.process_tree import die_with_parent

ANSWER_LIMIT = 3.0  # s for a master to answer one call
_ASK_PERIOD = 0.3  # s between two calls to a master that does not answer
_CLOSE_LIMIT = 2.0  # s for the child to unregister from the master
_NAMES_SHOWN = 3
_STANDBY = 3  # MAV_STATE; below it, the autopilot is starting
_WARNINGS = "/recorder/warning"
_MOST_ESTIMATORS = 50  # vehicles whose state is subscribed; each is a connection


def answers(uri: str, limit: float = ANSWER_LIMIT) -> bool:
    """Return whether a ROS master answers at ``uri`` within ``limit`` s of wall time for each step of the call."""
    parts = urlparse(uri)
    try:
        connection = HTTPConnection(parts.hostname or "localhost", parts.port or 11311, timeout=limit)
        try:
            connection.request(
                "POST", "/RPC2", xmlrpc.client.dumps(("/xtdrone",), "getPid"), {"Content-Type": "text/xml"}
            )
            xmlrpc.client.loads(connection.getresponse().read())
        finally:
            connection.close()
    except (OSError, HTTPException, ValueError, xmlrpc.client.Error, SyntaxError):  # the last: no XML
        return False
    return True


def standstill(status: Any) -> str:
    """Return the reason why simulated time stands still; empty while it advances.

    Args:
        status: an xtdrone_msgs/SimulationStatus.
    """
    if status.waiting_for:
        names = ", ".join(sorted(status.waiting_for)[:_NAMES_SHOWN])
        rest = len(status.waiting_for) - _NAMES_SHOWN
        more = f" and {rest} more" if rest > 0 else ""
        return f"waiting for {names}{more} ({status.waiting.to_sec():.0f} s)"
    if status.stepping:
        return ""
    return "paused" if status.paused else str(status.reason)


class Feed:
    """The parent's end of the child process."""

    def __init__(
        self, environment: Mapping[str, str], log: Path, topics: Mapping[str, str], vehicles: Sequence[str] = ()
    ) -> None:
        """Start the child. Call it from the main thread.

        Args:
            environment: of the launch, with its ROS_MASTER_URI.
            log: file of the child's standard error.
            topics: topic by kind of message.
            vehicles: report when the estimators of all of them have started.

        Raises:
            OSError: the child cannot be started.
        """
        self.lost = False
        self._log = log
        self._messages: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        wanted = {"parent": os.getpid(), "topics": dict(topics), "vehicles": list(vehicles[: _MOST_ESTIMATORS + 1])}
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, json.dumps(wanted)],
                env=dict(environment),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def take(self, timeout: float) -> list[dict[str, Any]]:
        """Return the messages received, after waiting up to ``timeout`` s of wall time for the first."""
        messages: list[dict[str, Any]] = []
        try:
            message = None if self.lost else self._messages.get(timeout=timeout)
            while message is not None:
                messages.append(message)
                message = self._messages.get_nowait()
            if self.lost:
                time.sleep(timeout)
            self.lost = True
        except queue.Empty:
            pass
        return messages

    def last_words(self) -> str:
        """Return the last line in the child's log."""
        lines = self._log.read_text(encoding="utf-8", errors="replace").split("\n") if self._log.is_file() else []
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def close(self) -> None:
        """Stop the child after it has unregistered from the master."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()
        try:
            self._process.wait(_CLOSE_LIMIT + 1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(1.0)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                try:
                    self._messages.put(json.loads(line))
                except ValueError:  # printed by a library
                    continue
        self._messages.put(None)


class _Node:
    """The child."""

    def __init__(self, wanted: dict[str, Any]) -> None:
        self._wanted = wanted
        self._printing = threading.Lock()
        self._lock = threading.Lock()  # also held while the master is asked, unlike the other
        self._starting: dict[str, Any] = {}  # subscription by vehicle whose estimators have not started

    def run(self) -> int:
        """Run until the end of standard input."""
        threading.Thread(target=self._end_with_input, daemon=True).start()
        uri = os.environ["ROS_MASTER_URI"]
        while not answers(uri):
            time.sleep(_ASK_PERIOD)
        import rospy
        from mavros_msgs.msg import State
        from std_msgs.msg import String
        from xtdrone_msgs.msg import SimulationStatus

        init_plain_node("demo_display", anonymous=True, disable_signals=True, disable_rostime=True)
        for kind, topic in self._wanted["topics"].items():
            rospy.Subscriber(topic, String, self._on_text, kind)
        rospy.Subscriber("/simulator/status", SimulationStatus, self._on_status)
        rospy.Subscriber(_WARNINGS, String, lambda message: self._say("warning", text=message.data))
        names = self._wanted["vehicles"] if len(self._wanted["vehicles"]) <= _MOST_ESTIMATORS else []
        with self._lock:
            for name in names:
                self._starting[name] = rospy.Subscriber(f"/{name}/mavros/state", State, self._on_state, name)
        self._say("master")
        rospy.spin()
        return 0

    def _say(self, kind: str, **fields: Any) -> None:
        with self._printing:
            print(json.dumps({"kind": kind, **fields}), flush=True)

    def _on_text(self, message: Any, kind: str) -> None:
        self._say(kind, message=json.loads(message.data))

    def _on_status(self, status: Any) -> None:
        self._say(
            "status",
            text=standstill(status),
            held=bool(status.paused or status.waiting_for),
            joined=list(status.participants),
            time=status.sim_time.to_sec(),
            paused=bool(status.paused),
        )

    def _on_state(self, state: Any, name: str) -> None:
        if state.system_status < _STANDBY:
            return
        with self._lock:
            subscription = self._starting.pop(name, None)
            last = subscription is not None and not self._starting
        if subscription is not None:
            # not in the subscription's own thread, which cannot join itself
            threading.Thread(target=subscription.unregister, daemon=True).start()
        if last:
            self._say("estimators", time=state.header.stamp.to_sec())

    def _end_with_input(self) -> None:
        while os.read(0, 4096):
            pass
        # Unregistering calls the master, which may be gone or unresponsive.
        threading.Timer(_CLOSE_LIMIT, os._exit, (1,)).start()
        rospy = sys.modules.get("rospy")
        if rospy is not None:
            rospy.signal_shutdown("the launch has ended")
        os._exit(0)


def main() -> int:
    """Run the child; return its exit status."""
    wanted = json.loads(sys.argv[1])
    die_with_parent(wanted["parent"])
    try:
        return _Node(wanted).run()
    except BrokenPipeError:
        return 1


if __name__ == "__main__":
    sys.exit(main())
