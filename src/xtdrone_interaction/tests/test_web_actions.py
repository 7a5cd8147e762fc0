"""Operators' actions without a ROS master: reading from a bag, execution, and ports of instances."""

from __future__ import annotations

import asyncio
import json
import socket
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rospy")

from xtdrone_interaction import server_port
from xtdrone_interaction.web import station_node
from xtdrone_interaction.web.actions import operator_actions
from xtdrone_interaction.web.actions.held_time import Instant
from xtdrone_interaction.web.actions.operator_actions import OperatorActions, in_words
from xtdrone_interaction.web.actions.recorded_actions import LET_GO, REFUSED, ActionError, parse_actions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.methods import CallError, Method
from xtdrone_interaction.web.server.session import Session
from xtdrone_interaction.web.server.station_server import Address, StationServer


def entry(number: int, station: int = 1, **changed: Any) -> str:
    content = {"station": station, "number": number, "tick": 10 * number, "time": 0.1 * number, "held": True, "page": 2}
    return json.dumps({**content, "method": "vehicles.command", "params": {"n": number}, **changed})


def mark(method: str, number: int, station: int = 1) -> str:
    return json.dumps({"station": station, "method": method, "params": {"number": number}})


# ---- contents of a bag


def test_actions_are_read_in_order_once_and_of_each_start_of_the_station() -> None:
    texts = [entry(1), entry(0, method="recordings.start"), entry(1), entry(2), entry(3, held=False)]
    texts += [mark(LET_GO, 2), mark(REFUSED, 3)]
    actions = parse_actions([*texts, entry(1, station=9), entry(2, station=9, tick=None)])
    assert [(action.number, action.tick, action.exact, action.refused) for action in actions] == [
        (1, 10, True, False), (2, 20, False, False), (3, 30, False, True), (1, 10, True, False),
    ]  # fmt: skip
    assert actions[1].params == {"n": 2}


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        ([], "it contains no action of an operator on the flight"),
        ([entry(0)], "no action of an operator"),
        ([entry(2)], "action 1 is missing, the next one in it is 2"),
        ([entry(1), entry(3)], "action 2 is missing"),
        (["{"], "is not an action"),
        (["[1]"], "an object is needed"),
        ([entry(1, tick="x")], "tick of the action"),
        ([entry(1, params=3)], "params of the action"),
        (['{"method": "vehicles.command"}'], "station of the action"),
        ([json.dumps({"station": 1, "method": LET_GO})], "params of the action"),
        ([json.dumps({"station": 1, "method": REFUSED, "params": {"number": []}})], "number of an action is needed"),
    ],
)
def test_what_cannot_be_repeated_is_refused(texts: list[str], reason: str) -> None:
    with pytest.raises(ActionError, match=reason):
        parse_actions(texts)


# ---- execution


class Station:
    """Operators' actions on a fake simulator."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, instant: Instant) -> None:
        self.log: list[Any] = []
        monkeypatch.setattr(operator_actions, "hold", self._hold)
        self._instant = instant
        monkeypatch.setattr(operator_actions, "let_go", lambda *_: self.log.append("let go"))
        monkeypatch.setattr(operator_actions, "_LONGEST_ACTION", 0.05)
        self.context = StationContext("http://127.0.0.1:9", "/web_station")
        self.actions = OperatorActions(self.context)
        monkeypatch.setattr(self.actions, "_publisher", self)
        self.session = Session(3, "operate", None, lambda f: f())  # type: ignore[arg-type]

    def _hold(self, _master: str, *, is_stepping: bool) -> Instant:
        self.log.append("no hold" if is_stepping else "hold")
        return Instant(7, 0.5, False) if is_stepping else self._instant

    def publish(self, message: Any) -> None:
        self.log.append(json.loads(message.data))

    def do(self, method: Method, **params: Any) -> Any:
        return self.actions.carry_out(method, self.session, params)


def test_an_action_on_the_flight_acts_while_time_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))
        fly = Method("fly", lambda _, params: station.log.append("fly") or params["x"], "operate",
                     recorded=lambda params: {"all of": params["x"]})  # fmt: skip
        assert await station.do(fly, x=4) == 4
        held, told, *rest = station.log
        assert (held, rest) == ("hold", ["fly", "let go"])
        assert {k: told[k] for k in ("number", "tick", "time", "held", "page", "method", "params")} == {
            "number": 1, "tick": 7, "time": 0.5, "held": True, "page": 3, "method": "fly", "params": {"all of": 4},
        }  # fmt: skip
        station.context.close()

    asyncio.run(test())


def test_the_other_pages_are_told_an_action_and_its_own_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))
        told: list[tuple[int, Any]] = []
        station.context.sessions[3] = station.session
        for number in (4, 5):
            other = Session(number, "view", None, lambda f: f())  # type: ignore[arg-type]
            monkeypatch.setattr(other, "push", lambda event, data, n=number: told.append((n, (event, data))))
            station.context.sessions[number] = other
        monkeypatch.setattr(station.session, "push", lambda *entry: told.append((3, entry)))
        await station.do(Method("fly", lambda *_: None, "operate"), action="land", vehicles=["iris_0"])
        await station.do(Method("steering.send", lambda *_: None, "operate"))
        await station.do(Method("note", lambda *_: None, "operate", "nothing"))
        assert told == [(n, ("actions.other", {"page": 3, "text": "land: iris_0"})) for n in (4, 5)]
        station.context.close()

    asyncio.run(test())


@pytest.mark.parametrize(
    ("method", "params", "words"),
    [
        ("vehicles.command", {"action": "hold", "vehicles": [f"iris_{i}" for i in range(6)]},
         "hold: iris_0, iris_1, iris_2, iris_3 and 2 more"),
        ("swarm.command", {"text": "cube", "target": "leader"}, "cube: leader"),
        ("time.control", {"action": "speed", "factor": 2}, "speed 2"),
        ("time.reset", {}, "time reset"),
        ("time.reset", {"vehicle": "iris_1"}, "time reset: iris_1"),
        ("map.upload", {"files": {"iris_0": "{}"}}, "map upload: iris_0"),
        ("parameters.set_ros", {"name": "/a", "value": 1}, "parameters set_ros: /a"),
        ("vehicles.command", {"action": {"x": [0] * 99}, "vehicles": 7}, str({"x": [0] * 99})[:120]),
    ],
)  # fmt: skip
def test_actions_in_words(method: str, params: dict[str, Any], words: str) -> None:
    assert in_words(method, params) == words


def test_time_goes_on_after_a_failed_and_during_a_long_action(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))

        def refuse(*_: Any) -> None:
            raise CallError("refused")

        with pytest.raises(CallError, match="refused"):
            await station.do(Method("refuse", refuse, "operate"))
        held, told = station.log[-2:]
        assert (held, told["method"], told["params"]) == ("let go", REFUSED, {"number": 1})
        ready = asyncio.Event()
        long = asyncio.ensure_future(station.do(Method("long", lambda *_: ready.wait(), "operate")))
        while station.log[-1] != "let go":
            await asyncio.sleep(0.01)
        assert (station.log[-2]["method"], station.log[-2]["params"]) == (LET_GO, {"number": 2})
        assert await station.do(Method("short", lambda *_: 1, "operate")) == 1  # it does not wait for the long method
        ready.set()
        assert await long is True
        station.context.close()

    asyncio.run(test())


def test_what_does_not_touch_the_flight_holds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))
        for touches in ("time", "nothing"):
            assert await station.do(Method("m", lambda *_: 1, "operate", touches)) == 1  # type: ignore[arg-type]
        assert [told["number"] for told in station.log] == [0, 0]
        station.context.close()

    asyncio.run(test())


def test_a_long_step_lets_other_actions_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))
        ended = asyncio.Event()
        fly = Method("fly", lambda *_: station.log.append("fly"), "operate")
        step = asyncio.ensure_future(station.do(Method("step", lambda *_: ended.wait(), "operate", "time")))
        await asyncio.wait_for(station.do(fly), 5.0)
        assert [entry for entry in station.log if isinstance(entry, str)] == ["no hold", "fly", "let go"]
        assert not step.done()
        assert await station.do(Method("pause", lambda *_: 1, "operate", "time")) == 1
        ended.set()
        assert await step is True
        station.log.clear()
        await station.do(fly)
        assert station.log[0] == "hold"  # the step has ended
        station.context.close()

    asyncio.run(test())


def test_a_short_step_ends_before_the_next_action(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))
        monkeypatch.setattr(operator_actions, "_LONGEST_ACTION", 5.0)

        async def pass_one_tick(*_: Any) -> None:
            await asyncio.sleep(0)
            station.log.append("tick")

        step = asyncio.ensure_future(station.do(Method("step", pass_one_tick, "operate", "time")))
        await asyncio.gather(step, station.do(Method("fly", lambda *_: station.log.append("fly"), "operate")))
        assert [entry for entry in station.log if isinstance(entry, str)] == ["tick", "hold", "fly", "let go"]
        station.context.close()

    asyncio.run(test())


def test_a_pause_waits_neither_for_a_step_nor_for_an_action(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        station = Station(monkeypatch, Instant(7, 0.5, True))
        monkeypatch.setattr(operator_actions, "_LONGEST_ACTION", 5.0)
        ended = asyncio.Event()
        waiting = [
            asyncio.ensure_future(station.do(Method("step", lambda *_: ended.wait(), "operate", "time"))),
            asyncio.ensure_future(station.do(Method("fly", lambda *_: ended.wait(), "operate"))),
        ]
        pause = Method("pause", lambda *_: ended.set(), "operate", "time")
        await asyncio.wait_for(station.do(pause), 1.0)
        assert await asyncio.gather(*waiting) == [True, True]
        station.context.close()

    asyncio.run(test())


# ---- ports


def test_the_usual_port_moves_with_the_instance_and_a_chosen_one_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    for instance, port in ((0, 8642), (2, 8642 + 1080), ("x", 8642)):
        monkeypatch.setattr(server_port.rospy, "get_param", lambda *_, i=instance: i)
        assert server_port.port_here(8642, 8642) == port
        assert server_port.port_here(9000, 8642) == 9000


def test_a_busy_port_gives_the_next_free_one_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def test() -> None:
        with socket.create_server(("127.0.0.1", 0)) as other:
            busy = other.getsockname()[1]
            server = StationServer(Address("127.0.0.1", busy, Credentials()), tmp_path, [])
            port = station_node._listen(server)
            assert busy < port <= busy + 20
            assert f"port {busy} is in use, it listens on {port}" in capsys.readouterr().out
            server.stop()

    asyncio.run(test())
