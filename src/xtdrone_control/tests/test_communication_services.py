"""The communication node's calls of MAVROS services."""

from __future__ import annotations

from contextlib import contextmanager

from xtdrone_control.communication import multirotor
from xtdrone_control.communication.commands import CommandRequest


def test_time_may_flow_while_an_answer_is_waited_for_in_a_turn(monkeypatch):
    """While a service call waits in a turn, time advances: PX4 replies to a MAVROS outside the lockstep only then."""
    seen = []

    @contextmanager
    def needs_time():
        seen.append("begin")
        yield
        seen.append("end")

    def proxy(name, kind):
        def call(*_):
            seen.append(name)
            return kind._response_class()

        return call

    monkeypatch.setattr(multirotor.lockstep, "needs_time", needs_time)
    monkeypatch.setattr(multirotor.rospy, "ServiceProxy", proxy)
    services = multirotor.MavrosServices("iris_0", in_lockstep=True)
    services.submit(CommandRequest("ARM", True))
    assert seen == ["begin", "/iris_0/mavros/cmd/arming", "end"]
    [(_, accepted, reason)] = services.finished()
    assert (accepted, reason) == (False, "MAV_RESULT 0")
