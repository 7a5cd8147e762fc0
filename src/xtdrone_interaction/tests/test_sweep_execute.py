"""Flights on Dask: two worker processes on loopback, killed workers, a scheduler that ends or never existed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
import sweep_standin
from distributed import Client, as_completed

from xtdrone_interaction import command_options
from xtdrone_interaction.studies import dask_execution
from xtdrone_interaction.studies.dask_execution import (
    Executor,
    SchedulerLostError,
    SweepError,
    local_client,
    remote_client,
)
from xtdrone_interaction.studies.list_of_runs import Plan
from xtdrone_interaction.studies.study_file import make_study
from xtdrone_interaction.sweep.fly_one_run import fly_batch

SHORT = {"n": 3, "pattern": "triangle", "limit": 4.0, "hold": 0.5}
PATIENCE = 120.0  # s; bounds a broken test


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """A client of two worker processes."""
    with local_client(2) as client:
        yield client


def tasks(count: int) -> list[dict[str, Any]]:
    return [{"key": f"k{number}", "seed": number, "varied": {"n": 4}} for number in range(count)]


def without_wall(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return rows by key, without wall time; fail if a key occurs twice."""
    found = {row["key"]: {k: v for k, v in row.items() if k != "wall_time"} for row in rows}
    assert len(found) == len(rows)
    return found


def pids(client: Client) -> list[int]:
    return sorted(client.run(os.getpid).values())


def nothing() -> None:
    """Do not stop."""


def test_killed_worker_loses_nothing_and_values_are_those_of_a_serial_run(tmp_path: Path, client: Client) -> None:
    study = make_study(
        {"name": "s", "constants": SHORT, "parameters": {"follower.vel_max": [0.5, 1.0]}, "seeds": 20}, tmp_path
    )
    common = {"engine": study.engine, "flight": study.flight, "constants": study.constants, "sources": {}}
    work = [run.task() for run in Plan(study)]
    rows: list[dict[str, Any]] = []
    killed: list[int] = []

    def deliver(new: list[dict[str, Any]]) -> None:
        rows.extend(new)
        if not killed:
            killed.append(pids(client)[0])
            os.kill(killed[0], signal.SIGKILL)

    Executor(client, fly_batch, common).run(iter(work), deliver, nothing)
    assert killed
    serial = fly_batch(common, work)
    assert without_wall(rows) == without_wall(serial)
    assert all(row["error"] is None for row in rows)
    assert len({row["steady_error"] for row in serial}) == len(serial)  # seeds and limits make a difference


def test_run_that_kills_its_worker_is_a_row_with_that_error(client: Client) -> None:
    rows: list[dict[str, Any]] = []
    executor = Executor(client, sweep_standin.work, {"deadly": 7})
    executor.run(iter(tasks(30)), rows.extend, nothing)
    found = without_wall(rows)
    assert len(found) == 30
    assert [key for key, row in found.items() if row["error"]] == ["k7"]
    assert "workers died while flying it" in found["k7"]["error"]


def test_a_cluster_without_workers_ends_the_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_execution, "_WORKERS_LIMIT", 2.5)
    with local_client(1) as lonely:
        lonely.cluster.scale(0)
        while lonely.nthreads():  # until the scheduler has noticed, which it announces to no client
            time.sleep(0.01)
        executor = Executor(lonely, sweep_standin.work, {})
        with pytest.raises(SweepError, match=r"workers: the cluster has had none for 2.5 s"):
            executor.run(iter(tasks(3)), lambda rows: None, nothing)


def test_rows_of_a_worker_that_dies_after_it_has_handed_them_over_count(client: Client) -> None:
    """Dask then flies the batch again, and reports it as pending."""
    executor = Executor(client, sweep_standin.work, {})
    batch = list(tasks(1))
    future = executor._submit(batch, as_completed(loop=client.loop))
    rows = future.result()
    future._state.reset()
    assert future.status == "pending"
    assert executor._rows(future, rows) == rows


def test_tasks_are_started_in_order(client: Client) -> None:
    taken = flown = most = 0

    def counted() -> Iterator[dict[str, Any]]:
        nonlocal taken
        for task in tasks(3000):
            taken += 1
            yield task

    def deliver(rows: list[dict[str, Any]]) -> None:
        nonlocal flown, most
        flown += len(rows)
        most = max(most, taken - flown)

    Executor(client, sweep_standin.work, {}).run(counted(), deliver, nothing)
    assert flown == 3000
    assert most <= 1000  # ten batches of a hundred, never all


def test_a_stop_acts_at_once_and_aborts_the_running_batches(client: Client, tmp_path: Path) -> None:
    class StopError(Exception):
        pass

    def check() -> None:
        if list(tmp_path.iterdir()):
            raise StopError

    executor = Executor(client, sweep_standin.work, {"folder": str(tmp_path), "seconds": 0.2})
    with pytest.raises(StopError):
        executor.run(iter(tasks(1000)), lambda rows: None, check)
    deadline = time.monotonic() + PATIENCE
    while any(client.processing().values()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert len(list(tmp_path.iterdir())) < 1000


def test_workers_that_cannot_fly_end_the_sweep_with_the_reason(client: Client) -> None:
    def broken(common: Any, batch: Any) -> Any:
        raise ModuleNotFoundError("No module named 'xtdrone_interaction'")

    with pytest.raises(SweepError, match=r"workers cannot fly: ModuleNotFoundError: No module .* need this package"):
        Executor(client, broken, {}).run(iter(tasks(3)), lambda rows: None, nothing)


def test_local_cluster_listens_on_loopback_only(client: Client) -> None:
    sockets = [s for pid in [os.getpid(), *pids(client)] for s in psutil.Process(pid).net_connections("inet")]
    listening = [socket.laddr.ip for socket in sockets if socket.status == psutil.CONN_LISTEN]
    assert len(listening) >= 3  # the scheduler, two workers
    assert set(listening) == {"127.0.0.1"}


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "no address", "ftp://127.0.0.1:80"])
def test_missing_scheduler(address: str) -> None:
    with (
        pytest.raises(SweepError, match=r"scheduler: no Dask scheduler answers at .*start one with"),
        remote_client(address),
    ):
        pass


@contextmanager
def scheduler_of_its_own(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start a scheduler like a user's, and a worker."""
    address = f"tcp://127.0.0.1:{port}"
    begin = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--no-dashboard",
    ]
    join = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    scheduler = subprocess.Popen(begin, **quiet)
    worker = subprocess.Popen(join, **quiet)
    try:
        yield scheduler
    finally:
        for process in (worker, scheduler):
            process.terminate()
        for process in (worker, scheduler):
            process.wait(PATIENCE)


def test_scheduler_lost_during_a_sweep_ends_it_with_the_results_so_far() -> None:
    port = command_options.free_port()
    rows: list[dict[str, Any]] = []
    with scheduler_of_its_own(port) as scheduler:
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                with remote_client(f"tcp://127.0.0.1:{port}") as remote:

                    def deliver(new: list[dict[str, Any]]) -> None:
                        rows.extend(new)
                        if scheduler.poll() is None:
                            scheduler.kill()

                    with pytest.raises(SchedulerLostError, match="the connection to it is lost"):
                        Executor(remote, sweep_standin.work, {"seconds": 0.05}).run(iter(tasks(1000)), deliver, nothing)
                break
            except SweepError:  # it is still starting
                assert time.monotonic() < deadline
    assert 0 < len(without_wall(rows)) < 1000
