"""Set-up of all tests: top-level packages in child processes, repeatable draws of Hypothesis, parallel workers.

With ``-n N``, each worker of pytest-xdist has its own network with a loopback only. So the simulations of two
workers use the same ports and abstract sockets without conflict. A file's tests run in one worker, in their order.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import socket
import struct
from pathlib import Path

import pytest

_CLONE_NEWNET = 0x40000000  # <linux/sched.h>
_SIOCSIFFLAGS, _IFF_UP = 0x8914, 0x1  # <linux/sockios.h>, <linux/if.h>

# Programs that tests start import benchmarks and validation, like those that ./xtdrone starts.
os.environ["PYTHONPATH"] = os.pathsep.join(
    filter(None, [os.environ.get("PYTHONPATH"), str(Path(__file__).resolve().parent)])
)

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


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Distribute whole files in collection order."""
    if config.getoption("numprocesses", None):
        config.option.dist = "loadfile"
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order the tests of parallel workers: those of the whole system first, short files last."""
    if hasattr(config, "workerinput"):
        whole_system = Path(__file__).resolve().parent / "tests"
        items.sort(key=lambda item: item.path.parent != whole_system)


def pytest_configure(config: pytest.Config) -> None:
    """Put a worker into its own network."""
    if not hasattr(config, "workerinput"):
        return
    try:
        _enter_own_network()
    except OSError as error:
        raise pytest.UsageError(f"-n: network namespaces: {error.strerror}; leave -n out, or run as root") from error
