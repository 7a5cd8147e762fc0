"""Set-up of all tests: top-level packages in child processes, repeatable draws of Hypothesis, parallel workers.

With ``-n N``, each worker of pytest-xdist has its own network with a loopback only. So the simulations of two
workers use the same ports and abstract sockets without conflict. A file's tests run in one worker, in their order.

With ``--fast``, only quick files are collected: they start no process and need no ROS master, and took at most
``_FAST_SECONDS`` when ``--store-seconds`` last wrote ``tests/seconds.txt``.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import signal
import socket
import struct
from pathlib import Path

import pytest

_CLONE_NEWNET = 0x40000000  # <linux/sched.h>
_SIOCSIFFLAGS, _IFF_UP = 0x8914, 0x1  # <linux/sockios.h>, <linux/if.h>

_ROOT = Path(__file__).resolve().parent
_SECONDS_FILE = (
    _ROOT / "tests" / "seconds.txt"
)  # file and seconds a line, of files that took longer than _STORED_SECONDS
_STORED_SECONDS = 1.0
_FAST_SECONDS = 5.0
_SYSTEM_FILES_WITHOUT_ROS = tuple(
    f"test_{name}.py" for name in ("architecture", "code_size", "commit_subjects", "documents", "version")
)
_STARTS_PROCESSES = re.compile(r"\b(?:rospy|roscore|roslaunch|Popen|ProcessTree|multiprocessing|fake_roslaunch)\b")

# Programs that tests start import benchmarks and validation, like those that ./xtdrone starts.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(_ROOT)]))

# A shell without job control starts background jobs with SIGINT ignored, and all programs below inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

try:
    import hypothesis
    from hypothesis.internal.conjecture import providers
except ImportError:
    pass
else:
    # No deadlines by wall time, and the same examples in each run.
    hypothesis.settings.register_profile(
        "repeatable",
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[hypothesis.HealthCheck.too_slow],
    )
    hypothesis.settings.load_profile("repeatable")
    # Hypothesis also draws constants from all modules that happen to be loaded, including other tests and edited code.
    providers.is_local_module_file = lambda path: False


def _enter_own_network() -> None:
    """Move this thread, and all processes that it starts, into a new network namespace whose loopback is up.

    Raises:
        OSError: this user or this machine cannot create one.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNET) != 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        fcntl.ioctl(probe, _SIOCSIFFLAGS, struct.pack("16sH14s", b"lo", _IFF_UP, b""))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the fast tier."""
    parser.addoption("--fast", action="store_true", help="only quick files that start no process (see CONTRIBUTING.md)")
    parser.addoption("--store-seconds", action="store_true", help="write tests/seconds.txt, by which --fast chooses")


def is_fast(path: Path, seconds: dict[str, float]) -> bool:
    """Return whether a test file belongs to the fast tier.

    Args:
        path: Test file.
        seconds: Measured time of slow files by their path in the repository, s.
    """
    if path.parent == _ROOT / "tests" and path.name not in _SYSTEM_FILES_WITHOUT_ROS:
        return False
    if seconds.get(str(path.relative_to(_ROOT)), 0.0) > _FAST_SECONDS:
        return False
    return not _STARTS_PROCESSES.search(path.read_text(encoding="utf-8"))


def _read_seconds() -> dict[str, float]:
    lines = _SECONDS_FILE.read_text(encoding="utf-8").splitlines() if _SECONDS_FILE.is_file() else []
    return {name: float(seconds) for name, seconds in (line.split() for line in lines)}


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the slow files with ``--fast``; None leaves the decision to pytest."""
    if not config.getoption("fast") or not collection_path.name.startswith("test_") or collection_path.suffix != ".py":
        return None
    return None if is_fast(collection_path, _read_seconds()) else True


_seconds: dict[str, float] = {}  # of each test file in this run


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add the time of a test's phase to that of its file."""
    name = report.nodeid.partition("::")[0]
    _seconds[name] = _seconds.get(name, 0.0) + report.duration


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the measured times, those of files that did not run as before."""
    config = session.config
    if not config.getoption("store_seconds") or hasattr(config, "workerinput"):
        return
    known = {name: seconds for name, seconds in _read_seconds().items() if (_ROOT / name).is_file()} | _seconds
    lines = [f"{name} {seconds:.1f}\n" for name, seconds in sorted(known.items()) if seconds > _STORED_SECONDS]
    _SECONDS_FILE.write_text("".join(lines), encoding="utf-8")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Distribute whole files in collection order."""
    if config.getoption("numprocesses", None):
        config.option.dist = "loadfile"
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order the tests of parallel workers: those of the whole system first, short files last."""
    if hasattr(config, "workerinput"):
        whole_system = _ROOT / "tests"
        items.sort(key=lambda item: item.path.parent != whole_system)


def pytest_configure(config: pytest.Config) -> None:
    """Put a worker into its own network."""
    if not hasattr(config, "workerinput"):
        return
    try:
        _enter_own_network()
    except OSError as error:
        raise pytest.UsageError(f"-n: network namespaces: {error.strerror}; leave -n out, or run as root") from error
