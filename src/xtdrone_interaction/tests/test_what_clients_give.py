"""What clients of the servers may name and read, and the end of a server that hangs."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import genpy
import pytest

pytest.importorskip("rospy")

import rosgraph.names
from foxglove import Parameter

from xtdrone_interaction.bridges.foxglove.client_topics import ClientTopics
from xtdrone_interaction.bridges.foxglove.parameter_values import ParameterError, RosParameters
from xtdrone_interaction.bridges.ros_publications import Publications
from xtdrone_interaction.bridges.rosbridge.clients.session import Bridge, Session
from xtdrone_interaction.bridges.rosbridge.rosapi import Rosapi, RosapiError
from xtdrone_interaction.cli import main as xtdrone
from xtdrone_interaction.parameter_secrets import is_secret, without_secrets
from xtdrone_interaction.topics.discovery import TopicGraph
from xtdrone_interaction.topics.raw_subscriptions import RawSubscriptions
from xtdrone_interaction.topics.ros_names import LONGEST_NAME, RosNameError, absolute_name
from xtdrone_interaction.web.server.credentials import TokenError, chosen_token

BAD_NAMES = (
    "", "/", "//", "/a//b", "a b", "/a b", "/\u0000", "/a\u0000b", "/a\n", "/a\x1b", "/\u00fc", "/\ud800", "\uff0f a",
    "0a", "_a", "~a", "../a", "/a/../b", "/a.b", "/a-b", "/" + "a" * LONGEST_NAME, None, 7, ["/a"], "<a>", "&#0;",
)  # fmt: skip
TREE = {
    "web_station": {"token": "secret-1", "url": "http://a"},
    "a": {"Auth_TOKEN": "secret-2", "tokens": 1, "b": [{"mytoken": "secret-3", "c": 2}]},
    "token": {"below": "secret-4"},
}


# ---- names


@pytest.mark.parametrize("name", BAD_NAMES)
def test_what_ros_does_not_resolve_is_no_name(name: Any) -> None:
    with pytest.raises(RosNameError, match=r"^topic: .* is not allowed, a name such as /iris_0/mavros/state$") as no:
        absolute_name(name, "topic")
    assert str(no.value).isascii()
    assert len(str(no.value)) < 160


@pytest.mark.parametrize(
    ("given", "name"), [("/a", "/a"), ("a", "/a"), ("/a/b_1/2c/", "/a/b_1/2c"), ("/_a", "/_a"), ("/0a", "/0a")]
)
def test_names_are_resolved(given: str, name: str) -> None:
    assert absolute_name(given, "topic") == name


def test_every_name_is_one_of_the_master_s_legal_names() -> None:
    draw = random.Random(3)
    accepted = 0
    for _ in range(20_000):
        text = "".join(
            draw.choices("/ab0_~.\0 \u00e9\n", weights=(8, 8, 8, 4, 2, 1, 1, 1, 1, 1, 1), k=draw.randrange(9))
        )
        try:
            name = absolute_name(text, "topic")
        except RosNameError:
            continue
        accepted += 1
        assert rosgraph.names.is_legal_name(text)
        assert name == rosgraph.names.resolve_name(text, "/node")
    assert accepted > 1000


class _Registered:
    """Stands for rospy: keeps the names that reach it."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(self, name: str, *_: Any, **__: Any) -> Any:
        self.names.append(name)
        return types.SimpleNamespace(unregister=lambda: None)


def rosbridge(registered: _Registered, told: list[Any], operate: bool = True) -> Session:
    """A client's session, whose answers are appended to ``told``."""
    publications = Publications(registered, lambda _: "", lambda _: 0)
    graph = types.SimpleNamespace(
        is_open=lambda _: True, topic_type=lambda _: "", read=lambda: TopicGraph({}, {"/there": ("/node",)})
    )
    services = types.SimpleNamespace(type_of=lambda name: registered(name) and "")
    calls = types.SimpleNamespace(submit=lambda function, operation: function(operation))
    api = Rosapi(graph.read, services.type_of, _Master(), ["*"], lambda: (1, 2), operate)
    raw = types.SimpleNamespace(listen=lambda name, _: registered(name))
    parts: dict[str, Any] = {"graph": graph, "raw": raw, "services": services, "calls": calls, "now": genpy.Time}
    bridge = Bridge(
        encoder=None, publications=publications, rosapi=api, serve=registered, call_limit=1.0, operate=operate, **parts
    )  # type: ignore[arg-type]
    connection: Any = types.SimpleNamespace(send=lambda frame: told.append(json.loads(frame)))
    return Session(bridge, connection)


@pytest.mark.parametrize("operate", [True, False])
def test_no_operation_of_rosbridge_passes_a_bad_name_on(operate: bool) -> None:
    registered, told = _Registered(), []  # type: ignore[var-annotated]
    session = rosbridge(registered, told, operate)
    operations = (
        ("subscribe", "topic", {}), ("unsubscribe", "topic", {}), ("unadvertise", "topic", {}),
        ("advertise", "topic", {"type": "std_msgs/String"}), ("publish", "topic", {"msg": {}}),
        ("advertise_service", "service", {"type": "std_srvs/Empty"}), ("unadvertise_service", "service", {}),
        ("call_service", "service", {}),
    )  # fmt: skip
    for op, field, more in operations:
        for name in BAD_NAMES:
            session.handle(json.dumps({"op": op, field: name, **more}))
            answer = told.pop()
            assert answer["op"] in ("status", "service_response"), (op, name)
            text = str(answer.get("msg", answer.get("values")))
            assert "is not allowed" in text or "read-only" in text, (op, name)
    for service, field in (
        ("topic_type", "topic"), ("publishers", "topic"), ("service_type", "service"), ("service_providers", "service"),
        ("node_details", "node"), ("has_param", "name"), ("delete_param", "name"), ("search_param", "name"),
    ):  # fmt: skip
        for name in BAD_NAMES:
            session.handle(json.dumps({"op": "call_service", "service": f"/rosapi/{service}", "args": {field: name}}))
            assert told.pop()["result"] is False
    assert registered.names == []
    if operate:
        session.handle('{"op": "advertise", "topic": "a", "type": "std_msgs/String"}')
        assert registered.names == ["/a"]


def test_no_operation_of_foxglove_passes_a_bad_name_on() -> None:
    registered, told = _Registered(), []  # type: ignore[var-annotated]
    topics = ClientTopics(
        Publications(registered, lambda _: "", lambda _: 0), lambda _: True, lambda *text: told.append(text[1])
    )
    master = _Master()
    parameters = RosParameters(lambda: master, ["*"], operate=True)
    texts = [name for name in BAD_NAMES if isinstance(name, str)]
    for i, name in enumerate(texts):
        topics.advertise(1, i, name, "ros1", "std_msgs/String")
        topics.publish(1, i, b"\0\0\0\0")
        assert "is not allowed, a name such as" in told[-1]
    assert len(told) == len(texts)
    for name in ("/\0", "a b", "/a//b", "/", "/a/token"):
        with pytest.raises(ParameterError, match="is not allowed"):
            parameters.set([Parameter(name, value=1)])
    assert (registered.names, master.changes) == ([], [])


def test_no_subscription_is_made_of_a_bad_name() -> None:
    raw = RawSubscriptions()
    for name in BAD_NAMES:
        with pytest.raises(RosNameError):
            raw.listen(name, lambda _: None)  # type: ignore[arg-type]
    assert raw.counts() == {}


# ---- secrets


class _Master:
    """A parameter server with ``TREE``."""

    def __init__(self) -> None:
        self.changes: list[str] = []

    def getParam(self, name: str) -> Any:  # noqa: N802
        value: Any = TREE
        for part in name.strip("/").split("/") if name != "/" else ():
            value = value[part]
        return value

    def hasParam(self, _: str) -> bool:  # noqa: N802
        return True

    def searchParam(self, name: str) -> str:  # noqa: N802
        return f"/web_station/{name}"

    def getParamNames(self) -> list[str]:  # noqa: N802
        return ["/web_station/token", "/web_station/url", "/a/Auth_TOKEN"]

    def setParam(self, name: str, _: Any) -> None:  # noqa: N802
        self.changes.append(name)

    def deleteParam(self, name: str) -> None:  # noqa: N802
        self.changes.append(name)


def test_names_that_end_in_token_are_secret() -> None:
    for name in ("/token", "/a/token/", "token", "/token/below", "/a/my_Token", "/A_TOKEN/b/c"):
        assert is_secret(name)
    for name in ("/", "/tokens", "/token_file", "/a/b"):
        assert not is_secret(name)
    assert without_secrets(TREE) == {"web_station": {"url": "http://a"}, "a": {"tokens": 1, "b": [{"c": 2}]}}


def test_no_bridge_tells_or_changes_a_secret() -> None:
    master = _Master()
    api = Rosapi(lambda: TopicGraph({}, {}), lambda _: "", master, ["*"], lambda: (0, 0), True)
    for name in ("/", "/web_station", "web_station", "/a", "/a/b"):
        assert "secret" not in str(api.call("/rosapi/get_param", {"name": name}))
    for name in ("/web_station/token", "web_station/token/", "/a/Auth_TOKEN", "/token", "/token/below"):
        for service in ("get_param", "has_param", "set_param", "delete_param"):
            with pytest.raises((RosapiError, RosNameError), match="is not allowed"):
                api.call(f"/rosapi/{service}", {"name": name, "value": "1", "default": "2"})
    assert api.call("/rosapi/get_param_names", {}) == {"names": ["/web_station/url"]}
    assert api.call("/rosapi/search_param", {"name": "token"}) == {"global_name": ""}
    assert api.call("/rosapi/search_param", {"name": "url"}) == {"global_name": "/web_station/url"}
    parameters = RosParameters(lambda: master, ["*"], operate=True)
    assert sorted(p.name for p in parameters.get([])) == ["/a/b", "/a/tokens", "/web_station/url"]
    assert "secret" not in str([p.get_value() for p in parameters.get([])])
    assert parameters.get(["/web_station/token", "/token/below"]) == []
    assert master.changes == []


READ = """
import os, subprocess, sys
from xtdrone_interaction.web.server.credentials import chosen_token
assert chosen_token("") == "my-own-token"
assert chosen_token("") == ""
assert "XTDRONE_WEB_TOKEN" not in os.environ
assert b"my-own-token" not in open("/proc/self/environ", "rb").read()
assert b"OTHER=kept" in open("/proc/self/environ", "rb").read()
assert "my-own-token" not in subprocess.run(["env"], capture_output=True, text=True).stdout
"""


def test_a_token_is_erased_from_the_environment_once_read() -> None:
    environment = {**_plain_environment(), "XTDRONE_WEB_TOKEN": "my-own-token", "OTHER": "kept"}
    subprocess.run([sys.executable, "-c", READ], env=environment, check=True, timeout=60)


def _plain_environment() -> dict[str, str]:
    return {"PYTHONPATH": ":".join(path for path in sys.path if path), "PATH": "/usr/bin:/bin"}


def test_a_file_with_a_token_is_the_user_s_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XTDRONE_WEB_TOKEN", raising=False)
    file = tmp_path / "token"
    file.write_text("my-own-token\n")
    file.chmod(0o600)
    assert chosen_token(str(file)) == "my-own-token"
    assert chosen_token("") == ""
    for mode in (0o644, 0o640, 0o602, 0o610):
        file.chmod(mode)
        with pytest.raises(
            TokenError, match=r"token_file: .* is not allowed, a regular file of mode 600 that belongs to you"
        ):
            chosen_token(str(file))
    file.chmod(0o600)
    for text in ("", "short", "with a space in", "t\u00f6ken-token-token"):
        file.write_text(text)
        with pytest.raises(TokenError, match="its token is not allowed, 8 or more") as no:
            chosen_token(str(file))
        assert not text or text not in str(no.value)
    for path in (tmp_path, tmp_path / "none", Path("/dev/zero")):
        with pytest.raises(TokenError, match="token_file: "):
            chosen_token(str(path))
    file.write_text("my-own-token")
    monkeypatch.setenv("XTDRONE_WEB_TOKEN", "another-token")
    with pytest.raises(TokenError, match="together with XTDRONE_WEB_TOKEN"):
        chosen_token(str(file))


def test_a_token_on_the_command_line_is_refused_and_not_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--token", "my-own-token"], ["--token=my-own-token"], ["--tok", "my-own-token"]):
        with pytest.raises(SystemExit) as end:
            xtdrone(["web", *arguments])
        assert end.value.code == 2
        told = capsys.readouterr().err
        assert "my-own-token" not in told
        assert "XTDRONE_WEB_TOKEN" in told or "ambiguous option" in told


# ---- the end

HANGING = """
import signal, sys, threading
from xtdrone_interaction.ending import end_within_limit
signal.signal(signal.SIGTERM, lambda *_: threading.Lock().acquire() and LOCK.acquire())
LOCK = threading.Lock()
LOCK.acquire()
threading.Thread(target=LOCK.acquire).start()
end_within_limit("a_bridge", 0.2)
print("ready", flush=True)
signal.pause()
"""
ENDING = HANGING.replace("threading.Lock().acquire() and LOCK.acquire()", "(LOCK.release(), sys.exit(3))")


@pytest.mark.parametrize(("program", "status"), [(HANGING, 1), (ENDING, 3)])
def test_a_server_ends_by_a_signal_also_if_it_hangs(program: str, status: int) -> None:
    environment = _plain_environment()
    with subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        _, told = process.communicate(timeout=60)
        assert process.returncode == status
        assert ("a_bridge: the shutdown takes longer than 0.2 s" in told) is (status == 1)
