"""The station's rooms of inspection, without a ROS master and a browser."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import pytest
from geometry_msgs.msg import PointStamped, Twist
from hypothesis import given, settings
from hypothesis import strategies as st
from rosgraph_msgs.msg import Log

from xtdrone_interaction.topics.discovery import TopicGraph, join_topics
from xtdrone_interaction.topics.raw_subscriptions import RawMessage, RawSubscriptions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.inspection.console_room import KEPT, ConsoleRoom
from xtdrone_interaction.web.inspection.page_subscriptions import MOST_OF_A_PAGE, PageSubscriptions
from xtdrone_interaction.web.inspection.plot_room import PlotRoom
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.server.methods import CallError, MethodTable, invoke
from xtdrone_interaction.web.server.session import Session

GRAPH = join_topics(
    [("/point", ["/n"]), ("/twist", ["/n"])], [], [], {"/point": PointStamped._type, "/twist": Twist._type}
)


class Deaf(RawSubscriptions):
    """Subscriptions without a master."""

    def _subscribe(self, shared: Any) -> Any:
        class Nothing:
            def unregister(self) -> None:
                pass

        return Nothing()


class Page:
    """A socket that keeps the messages sent to it."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def send(self, data: str | bytes, done: Callable[[], None]) -> None:
        self.sent.append(json.loads(data))
        done()

    def close(self) -> None:
        pass

    def events(self, name: str) -> list[Any]:
        return [entry["data"] for entry in self.sent if entry.get("event") == name]


class Known(TopicRoom):
    """A room with a given ROS graph."""

    async def graph(self) -> TopicGraph:
        return GRAPH


class Station:
    """The rooms, and one page on them."""

    def __init__(self) -> None:
        self.context = StationContext("http://127.0.0.1:9", "/web_station")
        self.topics = Deaf()
        pages = PageSubscriptions(self.context, self.topics)
        room = Known(self.context, self.topics, pages)
        self.plots = PlotRoom(self.context, room, pages)
        self.table = MethodTable([*room.methods(), *self.plots.methods()])
        self.page = Page()
        self.session = Session(1, "operate", self.page, lambda action: action())

    async def call(self, name: str, **params: Any) -> Any:
        return await invoke(self.table.find(name, "operate"), self.session, params)

    def say(self, topic: str, message: Any, data: bytes | None = None) -> None:
        buffer = io.BytesIO()
        message.serialize(buffer)
        arrived = type(
            "Any", (), {"_buff": buffer.getvalue() if data is None else data, "_type": "*", "_md5sum": "*"}
        )()
        arrived._connection_header = {"type": message._type, "md5sum": message._md5sum, "callerid": "/n"}
        self.topics.receive(topic, arrived)


def tried(test: Callable[[Station], Awaitable[None]]) -> None:
    async def run() -> None:
        station = Station()
        try:
            await test(station)
        finally:
            station.context.close()

    asyncio.run(run())


def point(x: float, secs: int = 0) -> PointStamped:
    message = PointStamped()
    message.point.x = x
    message.header.stamp.secs = secs
    return message


def test_echo_sends_messages_and_names_what_cannot_be_decoded() -> None:
    async def test(station: Station) -> None:
        number = (await station.call("topics.echo", topic="/point"))["subscription"]
        station.say("/point", point(float("nan")))
        (sent,) = station.page.events("topics.message")
        assert sent["subscription"] == number
        assert sent["message"]["point"] == {"x": "NaN", "y": 0.0, "z": 0.0}
        assert (sent["publisher"], sent["type"]) == ("/n", "geometry_msgs/PointStamped")
        await station.call("topics.close", subscription=number)
        station.say("/point", point(1.0))
        assert len(station.page.sent) == 1
        await station.call("topics.echo", topic="/point", rate=100.0)
        station.say("/point", point(1.0), data=b"cut")
        assert "its 3 bytes are no geometry_msgs/PointStamped" in station.page.events("topics.message")[1]["error"]

    tried(test)


def test_plots_send_batches_by_the_messages_stamps() -> None:
    async def test(station: Station) -> None:
        x = (await station.call("plots.open", topic="/point", field="point.x", rate=None))["subscription"]
        y = (await station.call("plots.open", topic="/twist", field="angular.z", rate=None))["subscription"]
        for i in range(1, 4):
            station.say("/point", point(0.5 * i, i))
            station.say("/twist", Twist())
        station.plots._send()
        (samples,) = station.page.events("plots.samples")
        assert samples[str(x)] == {"t": [1.0, 2.0, 3.0], "v": [0.5, 1.0, 1.5]}
        assert samples[str(y)]["v"] == [0.0, 0.0, 0.0]
        station.say("/point", point(1.0), data=b"cut")
        assert "no geometry_msgs/PointStamped" in station.page.events("plots.fault")[0]["text"]
        station.say("/point", point(1.0))
        assert station.page.events("plots.fault")[1]["text"] == ""

    tried(test)


@pytest.mark.parametrize(
    ("method", "params", "text"),
    [
        ("topics.echo", {}, "topic: 'None' is not allowed, a topic's name"),
        ("topics.echo", {"topic": "a b"}, "topic: 'a b' is not allowed, a name such as"),
        ("topics.echo", {"topic": "/point", "rate": 0}, "rate: 0 is not allowed, more than 0, up to 100 Hz"),
        ("topics.echo", {"topic": "/point", "rate": "all"}, "rate: 'all' is not allowed"),
        ("topics.echo", {"topic": "/point", "longest": -1}, "longest: -1 is not allowed"),
        ("topics.fields", {"topic": "/gone"}, "topic: '/gone' is not there"),
        ("plots.open", {"topic": "/point", "field": "point.w"}, "'w' is not there, but x, y, z"),
        ("plots.open", {"topic": "/point", "field": "header.frame_id"}, "is string, which cannot be plotted"),
        ("topics.publish", {"topic": "/point", "type": "gone_msgs/A"}, "type: 'gone_msgs/A' is not installed"),
        (
            "topics.publish",
            {"topic": "/point", "type": "geometry_msgs/Twist"},
            "is not allowed on /point, geometry_msgs/P",
        ),
        (
            "topics.publish",
            {"topic": "/twist", "type": "geometry_msgs/Twist", "message": {"lin": 1}},
            "'lin' is no field",
        ),
    ],
)
def test_bad_calls_are_refused_by_name_and_value(method: str, params: Mapping[str, Any], text: str) -> None:
    async def test(station: Station) -> None:
        with pytest.raises(ValueError) as error:  # noqa: PT011
            await station.call(method, **params)
        assert text in str(error.value)

    tried(test)


def test_a_page_has_a_bounded_number_of_subscriptions_which_end_with_it() -> None:
    async def test(station: Station) -> None:
        for _ in range(MOST_OF_A_PAGE):
            await station.call("topics.measure", topic="/point")
        with pytest.raises(CallError, match="at most 64 subscriptions"):
            await station.call("topics.echo", topic="/point")
        assert "/point" in station.call.__self__.topics.rates()
        station.session.close()
        while station.topics.rates():
            await asyncio.sleep(0.01)

    tried(test)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    st.dictionaries(
        st.sampled_from(["topic", "rate", "longest", "field", "subscription"]),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5), st.lists, max_leaves=3
        ),
    )
)
def test_any_parameters_are_answered_or_refused(params: dict[str, Any]) -> None:
    async def test(station: Station) -> None:
        for method in ("topics.echo", "topics.fields", "plots.open", "topics.close", "plots.close", "topics.measure"):
            with contextlib.suppress(ValueError):  # any other exception fails the test
                json.dumps(await station.call(method, **params))

    tried(test)


def test_the_console_keeps_the_last_messages_in_order() -> None:
    async def test(station: Station) -> None:
        room = ConsoleRoom(station.context, station.topics)
        for i in range(KEPT + 5):
            log = Log(level=Log.WARN if i % 2 else Log.INFO, name="/n", msg=f"message {i}")
            room.take(RawMessage("/rosout_agg", Log._type, Log._md5sum, "", "/rosout", False, _bytes(log), 0.0, 0.0))
        kept = room._open(station.session, {})["messages"]
        assert [m["text"] for m in (kept[0], kept[-1])] == ["message 5", f"message {KEPT + 4}"]
        assert {m["level"] for m in kept} == {"info", "warn"}
        room._send()
        assert len(station.page.events("console.messages")[0]["messages"]) == KEPT

    tried(test)


def _bytes(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()
