"""Nodes forked from a launch's zygote equal nodes started by the interpreter, and none is left running."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from xtdrone_common.programs import zygote

LAUNCHER = os.environ.get("XTDRONE_NODE_LAUNCHER", "")
AHEAD = [LAUNCHER, "--ahead", "no_such_module,colorsys"]  # before the command line of roslaunch
LIMIT = 240.0  # s of wall time; only a broken run takes it
needs_ros = pytest.mark.skipif(not (LAUNCHER and shutil.which("roslaunch")), reason="ROS is not there")

PROBE = """\
#!{python}
import json, math, os, random, signal, sys, time
import numpy
import rospy
name = next(word[8:] for word in sys.argv if word.startswith("__name:="))
seen = {{
    "argv": [word for word in sys.argv if not word.startswith("__")],
    "cmdline": open("/proc/self/cmdline").read().rstrip("\\0").split("\\0")[:3],
    "comm": open("/proc/self/comm").read(),
    "cwd": os.getcwd(),
    "environment": dict(os.environ),
    "leads": os.getsid(0) == os.getpid() == os.getpgid(0),
    "main": [__name__, __file__, sys.modules["__main__"].__file__, math.pi],
    "mappings": rospy.names._mappings.get("chatter"),
    "path": [folder for folder in sys.path if "/src/xtdrone_" not in folder],  # of catkin's relays
    "signals": [str(signal.getsignal(n)) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)],
    "blocked": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ())),
    "stdin": os.readlink("/proc/self/fd/0"),
    "streams": [[s.encoding, s.errors, s.line_buffering, s.fileno()] for s in (sys.stdin, sys.stdout, sys.stderr)],
}}
json.dump(
    {{
        "seen": seen,
        "ahead": "colorsys" in sys.modules,
        "random": [random.random(), numpy.random.random()],
        "parent": os.getppid(),
        "pid": os.getpid(),
    }},
    open("{folder}/" + name + ".json", "w"),
)
print("output of", name)
while "last" in sys.argv and not os.path.exists("{folder}/end"):
    time.sleep(0.02)
sys.exit(3 if "last" in sys.argv else 0)
"""
SLEEPER = """\
#!{python}
import pathlib, sys, time
name = next(word[8:] for word in sys.argv if word.startswith("__name:="))
pathlib.Path("{folder}/" + name + ".ready").touch()
try:
    time.sleep(600.0)
except KeyboardInterrupt:
    pathlib.Path("{folder}/" + name + ".interrupted").touch()
"""


THREADED = """\
#!{python}
import pathlib, sys, threading
import with_thread
name = next(word[8:] for word in sys.argv if word.startswith("__name:="))
pathlib.Path("{folder}/" + name + ".threads").write_text(str(threading.active_count()))
"""
MODULES = {
    "ending": "raise SystemExit(5)",
    "with_thread": "import threading; threading.Thread(target=threading.Event().wait, daemon=True).start()",
}


class Launch:
    """A running roslaunch with its own master."""

    def __init__(self, folder: Path, nodes: str, before: list[str]) -> None:
        self.folder = folder
        file = folder / "test.launch"
        file.write_text(f"<launch>{nodes}</launch>")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.log = folder / "roslaunch.log"
        # roslaunch writes the master's URI in another way
        environment = {**os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_LOG_DIR": str(folder / "logs")}
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                [*before, "roslaunch", "-p", str(port), str(file)],
                env={**environment, "ROS_HOME": str(folder), "ZYGOTE_TEST": str(folder)},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def wait_for(self, words: str) -> re.Match[str]:
        """Wait for a regular expression in roslaunch's log."""
        end = time.monotonic() + LIMIT
        while not (found := re.search(words, self.log.read_text(errors="replace"))):
            assert time.monotonic() < end, (words, self.log.read_text(errors="replace"))
            time.sleep(0.02)
        return found

    def wait_for_file(self, name: str) -> None:
        end = time.monotonic() + LIMIT
        while not (self.folder / name).exists():
            assert time.monotonic() < end, (name, self.log.read_text(errors="replace"))
            time.sleep(0.02)

    def processes(self) -> dict[int, str]:
        """Return id and command line of every living process of the launch."""
        found = {}
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdigit() and f"ZYGOTE_TEST={self.folder}\0".encode() in (entry / "environ").read_bytes():
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        return found

    def pid(self, *words: str) -> int:
        """Return the only process with these words in its command line."""
        (found,) = [pid for pid, command in self.processes().items() if all(word in command for word in words)]
        return found

    def gone(self, words: str) -> bool:
        """Wait until no process has these words in its command line."""
        end = time.monotonic() + LIMIT
        while any(words in command for command in self.processes().values()) and time.monotonic() < end:
            time.sleep(0.02)
        return time.monotonic() < end

    def interrupt(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(LIMIT)


def interpreter() -> str:
    """Return the Python interpreter in the first line of the workspace's node scripts."""
    return (Path(LAUNCHER).parent / "fleet_text.py").read_text().partition("\n")[0].removeprefix("#!")


@pytest.fixture
def launches(tmp_path: Path) -> Iterator[Callable[..., Launch]]:
    ender = "#!{python}\nimport ending\n"
    for name, text in (("probe", PROBE), ("sleeper", SLEEPER), ("ender", ender), ("threaded", THREADED)):
        script = tmp_path / name
        script.write_text(text.format(python=interpreter(), folder=tmp_path))
        script.chmod(0o755)
    made = []

    def launch(nodes: str, before: Sequence[str] = ()) -> Launch:
        made.append(Launch(tmp_path, nodes, [*before]))
        return made[-1]

    yield launch
    for one in made:
        for pid in (one.process.pid, *one.processes()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        one.process.wait()


def node(folder: Path, script: str, name: str, *, prefix: str = LAUNCHER, more: str = "") -> str:
    """Return a node element that runs a script of ``folder``; its program is the script's first argument."""
    return f'<node pkg="rosbag" type="record" name="{name}" launch-prefix="{prefix} {folder}/{script}" {more}/>'


@needs_ros
@pytest.mark.parametrize("before", [(), AHEAD], ids=["by_first_node", "ahead"])
def test_a_forked_node_is_as_one_started_by_the_interpreter(tmp_path, launches, before):
    args = 'args="forked chatter:=other"'
    launch = launches(
        node(tmp_path, "probe", "plain", prefix="", more=args)
        + node(tmp_path, "probe", "first", more=args)
        + node(tmp_path, "probe", "second", more=args)
        + node(tmp_path, "probe", "other_environment", more=args).replace("/>", '><env name="A" value="b"/></node>')
        + node(tmp_path, "probe", "last", more='args="last" required="true"'),
        before,
    )
    for name in ("plain", "first", "second", "other_environment"):
        launch.wait_for(rf"\[{name}-\d+\] process has finished cleanly")
    (tmp_path / "end").touch()
    launch.wait_for(r"REQUIRED process \[last-\d+\] has died!\nprocess has died \[pid \d+, exit code 3")
    assert launch.process.wait(LIMIT) == 0
    assert launch.gone("")
    results = {name: json.loads((tmp_path / f"{name}.json").read_text()) for name in ("plain", "first", "second")}
    assert results["first"]["seen"] == results["second"]["seen"] == results["plain"]["seen"]
    assert results["first"]["seen"]["mappings"] == "other"
    assert results["first"]["parent"] == results["second"]["parent"] != results["plain"]["parent"]
    assert [result["ahead"] for result in results.values()] == [False, bool(before), bool(before)]
    assert len({number for result in results.values() for number in result["random"]}) == 6
    assert json.loads((tmp_path / "other_environment.json").read_text())["seen"]["environment"]["A"] == "b"
    outputs = [path.read_text() for path in tmp_path.glob("logs/latest/first-*-stdout.log")]
    assert outputs == ["output of first\n"]


@needs_ros
def test_no_process_outlives_those_it_belongs_to(tmp_path, launches):
    names = ("node_killed", "launcher_killed", "terminated", "kept", "again")
    launch = launches(
        "".join(node(tmp_path, "sleeper", name, more='respawn="true"' * (name == "again")) for name in names)
    )
    for name in names:
        launch.wait_for_file(f"{name}.ready")
    zygote_pid = launch.pid("xtdrone_common.programs.zygote")
    kept = launch.pid("sleeper", "__name:=kept")
    assert launch.pid("node_launcher", f"__name:=kept {kept}")

    os.kill(launch.pid("sleeper", "__name:=node_killed"), signal.SIGKILL)
    launch.wait_for(r"\[node_killed-\d+\] process has died \[pid \d+, exit code -9")
    os.kill(launch.pid("node_launcher __name:=launcher_killed"), signal.SIGKILL)
    launch.wait_for(r"\[launcher_killed-\d+\] process has died \[pid \d+, exit code -9")
    assert launch.gone("__name:=launcher_killed")
    os.kill(launch.pid("node_launcher __name:=terminated"), signal.SIGTERM)
    launch.wait_for(r"\[terminated-\d+\] process has died \[pid \d+, exit code -15")
    assert launch.gone("__name:=terminated")

    (tmp_path / "again.ready").unlink()
    os.kill(zygote_pid, signal.SIGKILL)
    launch.wait_for(r"\[kept-\d+\] process has died \[pid \d+, exit code -9")
    assert launch.gone("__name:=kept")
    launch.wait_for_file("again.ready")  # respawned, by another zygote
    assert launch.pid("xtdrone_common.programs.zygote") != zygote_pid

    launch.interrupt()
    assert (tmp_path / "again.interrupted").exists()
    assert launch.gone("")


@needs_ros
@pytest.mark.parametrize("before", [(), AHEAD], ids=["by_first_node", "ahead"])
def test_nodes_are_interrupted_when_roslaunch_is_killed(tmp_path, launches, before):
    launch = launches(node(tmp_path, "sleeper", "node"), before)
    launch.wait_for_file("node.ready")
    launch.process.kill()
    launch.wait_for_file("node.interrupted")
    assert launch.gone("sleeper")
    assert launch.gone("xtdrone_common.programs.zygote")


@needs_ros
def test_the_zygote_of_a_launcher_whose_roslaunch_is_gone_ends_after_its_node(tmp_path, launches):
    launch = launches("")
    environment = {**os.environ, "ZYGOTE_TEST": str(tmp_path)}
    orphan = f"(cat; exec {LAUNCHER} {tmp_path}/sleeper __name:=orphan) <&0 &"
    begin, shell_has_ended = os.pipe()
    subprocess.run(["bash", "-c", orphan], env=environment, stdin=begin, check=True)
    os.close(begin)
    os.close(shell_has_ended)
    launch.wait_for_file("orphan.ready")
    zygote_pid = launch.pid("xtdrone_common.programs.zygote")
    assert f"PPid:\t{launch.process.pid}\n" not in status(zygote_pid)
    os.kill(launch.pid("node_launcher __name:=orphan"), signal.SIGINT)
    launch.wait_for_file("orphan.interrupted")
    assert launch.gone("xtdrone_common.programs.zygote")


@needs_ros
def test_a_module_that_ends_its_interpreter_or_starts_a_thread_harms_no_other_node(tmp_path, launches, monkeypatch):
    modules = tmp_path / "modules"
    modules.mkdir()
    for name, text in MODULES.items():
        (modules / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", f"{modules}:{os.environ['PYTHONPATH']}")
    for name in ("LANG", "LC_ALL", "LC_CTYPE"):  # the interpreter then sets LC_CTYPE itself
        monkeypatch.delenv(name, raising=False)
    script_names = ("sleeper", "ender", "threaded")
    launch = launches("".join(node(tmp_path, name, name) for name in script_names))
    launch.wait_for_file("sleeper.ready")
    launch.wait_for(r"\[ender-\d+\] process has died \[pid \d+, exit code 5")
    launch.wait_for(r"\[threaded-\d+\] process has finished cleanly")
    assert (tmp_path / "threaded.threads").read_text() == "2"
    sleeper = launch.pid("/sleeper", "__name:=sleeper")
    assert launch.pid(f"node_launcher __name:=sleeper {sleeper}")
    launch.interrupt()
    assert (tmp_path / "sleeper.interrupted").exists()


@needs_ros
def test_nodes_beyond_the_zygotes_descriptors_run_without_it(tmp_path, launches):
    launch = launches("")
    names = [f"node{number}" for number in range(10, 22)]
    starts = "".join(f"{LAUNCHER} {tmp_path}/sleeper __name:={name} & " for name in names)
    command = ["sh", "-c", f"ulimit -n 24; {starts} wait"]
    environment = {**os.environ, "ZYGOTE_TEST": str(tmp_path)}
    shell = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL)
    try:
        for name in names:
            launch.wait_for_file(f"{name}.ready")
        zygote_pid = launch.pid("xtdrone_common.programs.zygote")
        forked = [
            name
            for name in names
            if f"PPid:\t{zygote_pid}\n" in status(launch.pid("/sleeper", f"__name:={name}", "python"))
        ]
        assert 0 < len(forked) < len(names)
    finally:
        shell.kill()
        shell.wait()


def status(pid: int) -> str:
    return Path(f"/proc/{pid}/status").read_text()


def test_the_launcher_runs_other_programs_itself(tmp_path):
    for program in (shutil.which("true"), shutil.which("false"), str(tmp_path / "none")):
        expected = {"true": 0, "false": 1, "none": 127}[Path(program).name]
        assert subprocess.run([LAUNCHER, program], check=False, capture_output=True).returncode == expected


# ---- requests


def request(words: list[bytes], environment: list[bytes]) -> bytes:
    parts = [b"".join(word + b"\0" for word in group) for group in (words, environment)]
    return struct.pack("=II", *(len(part) for part in parts)) + b"".join(parts)


@pytest.mark.parametrize(
    ("data", "files"),
    [
        (b"", 4),
        (b"\0" * 3, 4),
        (request([b"script"], [])[:-1], 4),
        (request([], []), 4),
        (request([b"script"], []), 3),
        (struct.pack("=II", 1, 2**32 - 1) + b"\0", 4),
    ],
)
def test_a_malformed_request_is_rejected_without_leaving_descriptors_open(data, files):
    before = os.listdir("/proc/self/fd")
    ours, theirs = socket.socketpair()
    with ours, theirs:
        socket.send_fds(theirs, [data or b"\0"], [0] * files)
        theirs.close()
        with pytest.raises(zygote.NodeRequestError):
            zygote.receive(ours)
    assert os.listdir("/proc/self/fd") == before


def test_a_long_request_arrives_whole():
    ours, theirs = socket.socketpair()
    words, environment = [b"script", b"", b"x" * 100_000], [b"A=b=c", b"B="]
    with ours, theirs:
        socket.send_fds(theirs, [request(words, environment)], [0] * 4)
        received = zygote.receive(ours)
    received.close()
    assert (received.command, received.environment) == (words, environment)


def test_modules_are_those_that_the_script_behind_a_relay_imports(tmp_path):
    script = tmp_path / "nodes" / "node.py"
    script.parent.mkdir()
    script.write_text("import a.b, c\nfrom d import e\nfrom . import f\nif True:\n    import g\nimport beside\n")
    relay = tmp_path / "relay.py"
    relay.write_text(f"python_script = {str(script)!r}\nexec(open(python_script).read())\n")
    (tmp_path / "beside.py").touch()
    assert zygote.imported_modules(relay) == ["a.b", "c", "d", "d.e"]
