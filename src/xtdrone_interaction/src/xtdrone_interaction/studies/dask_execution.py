"""Execution on Dask: batches of flights on worker processes of this machine or of a cluster, in a bounded window.

A flight that raises becomes a row with its error, so the only failure that Dask reports is a
lost worker; Dask then repeats the batch on another one. If several workers die under a batch, its runs are repeated one
at a time, and a run that still kills its workers becomes a row with that error.
"""

from __future__ import annotations

import itertools
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed
from distributed.comm import get_address_host

from xtdrone_interaction.studies.result_store import Row

CONNECT_LIMIT = 5.0  # s for a scheduler to answer
BATCH_TIME = 0.5  # s of work per batch, so that Dask's overhead of milliseconds per batch does not matter
_MOST_BATCH = 100  # runs
_WINDOW = 4  # batches per worker thread in Dask's queue: no worker waits, and memory stays bounded
_LEAST_WINDOW = 8
_LOST_WORKERS = 2  # number of workers that may die under a batch before it is given up
_POLL = 0.1  # s
_RECOUNT = 20  # polls between two counts of the workers
_WORKERS_LIMIT = 300.0  # s without any worker; Dask gives up workers that cannot be restarted
_SMOOTHING = 0.2
_LOGGERS = ("distributed", "tornado.application", "asyncio")

Task = Mapping[str, Any]
"""Key, varied parameters and seed of a run."""
Work = Callable[[Mapping[str, Any], Sequence[Task]], list[Row]]
"""Flies a batch: data that all runs share, and tasks; returns their rows in the same order."""


class SweepError(RuntimeError):
    """The sweep cannot continue; finished runs are kept."""


class SchedulerLostError(SweepError):
    """The connection to the scheduler is lost."""


@contextmanager
def local_client(workers: int, dashboard: str | None = None) -> Iterator[Client]:
    """Yield a client of a cluster on this machine: processes of one thread each, on loopback only.

    Its processes end with this one, even if this one is killed.

    Args:
        workers: number of processes.
        dashboard: address of Dask's web page, such as ``127.0.0.1:8787``; None for no page.

    Raises:
        SweepError: the processes cannot be started.
    """
    settings = {
        "distributed.scheduler.allowed-failures": _LOST_WORKERS,
        # numba and the linear algebra of a worker stay on its one core.
        "distributed.nanny.pre-spawn-environ.NUMBA_NUM_THREADS": 1,
        "distributed.nanny.pre-spawn-environ.MPLBACKEND": "Agg",
        "distributed.admin.system-monitor.gil.enabled": False,
    }
    with _quiet(), dask.config.set(settings):
        cluster = _local_cluster(workers, dashboard)
        try:
            with Client(cluster, set_as_default=False) as client:
                yield client
        finally:
            _end_workers(cluster)
            with suppress(TimeoutError):  # on a starved machine; the workers have been killed
                cluster.close(timeout=CONNECT_LIMIT)


def _local_cluster(workers: int, dashboard: str | None) -> LocalCluster:
    try:
        with _signals_for_this_process():
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                protocol="tcp://",
                dashboard_address=dashboard or "127.0.0.1:0",
                scheduler_kwargs={"dashboard": dashboard is not None},
                worker_dashboard_address=None,
                silence_logs=logging.CRITICAL,
            )
    except (RuntimeError, OSError) as error:
        raise SweepError(f"workers: {workers} processes cannot be started ({_first_line(error)})") from error


def _end_workers(cluster: LocalCluster) -> None:
    """Kill the workers: their runs have been given up, and an orderly shutdown takes seconds."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)


@contextmanager
def remote_client(address: str) -> Iterator[Client]:
    """Yield a client of the cluster with the scheduler at ``address``, such as ``tcp://host:8786``.

    Raises:
        SweepError: no scheduler answers.
    """
    with _quiet(), dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECT_LIMIT:g}s"}):
        try:
            get_address_host(address)  # a client with an invalid address fails late and with a traceback
            client = Client(address, timeout=CONNECT_LIMIT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SweepError(
                f"scheduler: no Dask scheduler answers at {address!r} ({_first_line(error)}); "
                "start one with 'dask scheduler', or leave --scheduler out"
            ) from error
        try:
            yield client
        finally:
            client.close(timeout=CONNECT_LIMIT)


class Executor:
    """Sends tasks to workers and delivers their rows.

    Attributes:
        workers: number of worker threads at the last count.
        lost: number of batches that were given up because several workers died under them.
    """

    def __init__(self, client: Client, work: Work, common: Mapping[str, Any]) -> None:
        """Prepare.

        Args:
            client: of the cluster.
            work: function that flies a batch, importable by the workers.
            common: data that all runs share, sent with each batch.
        """
        self._client = client
        self._work = work
        self._common = dict(common)
        self._running: dict[Future, list[Task]] = {}
        self._suspects: list[Task] = []  # runs of batches under which workers died
        self._alone: Future | None = None
        self._seconds = BATCH_TIME  # per run; the first batches have one run
        self._numbers = itertools.count()
        self._last_worker = time.monotonic()  # time of the last count with a worker
        self.workers = 0
        self.lost = 0

    def run(self, tasks: Iterator[Task], deliver: Callable[[list[Row]], None], check: Callable[[], None]) -> None:
        """Fly all tasks.

        Args:
            tasks: consumed as workers become free.
            deliver: callback with the rows of finished runs, in order of completion.
            check: called several times a second; its exceptions stop the sweep.

        Raises:
            SchedulerLostError: the connection to the scheduler is lost.
            SweepError: the workers cannot import the work, or there has been none for _WORKERS_LIMIT seconds.
        """
        self._last_worker = time.monotonic()
        completed = as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        try:
            for poll in itertools.count():
                check()
                if poll % _RECOUNT == 0:
                    self._count()
                self._fill(tasks, completed)
                if not self._running:
                    return
                for future, result in _finished(completed):
                    rows = self._rows(future, result)
                    if rows:
                        deliver(rows)
        finally:
            self._abandon()

    def _count(self) -> None:
        """Count the worker threads and check that the scheduler answers."""
        if self._client.status != "running":
            raise self._scheduler_lost()
        try:
            self.workers = sum(self._client.nthreads().values())
        except (OSError, TimeoutError) as error:
            raise self._scheduler_lost() from error
        now = time.monotonic()
        if self.workers:
            self._last_worker = now
        elif now - self._last_worker > _WORKERS_LIMIT:
            raise SweepError(f"workers: the cluster has had none for {_WORKERS_LIMIT:g} s")

    def _fill(self, tasks: Iterator[Task], completed: as_completed) -> None:
        """Fill the window; a suspect run flies alone, so that its failure is its own."""
        if self._suspects:
            if not self._running:
                self._alone = self._submit([self._suspects.pop()], completed)
            return
        if self._alone is not None:
            return
        window = max(_LEAST_WINDOW, _WINDOW * self.workers)
        while len(self._running) < window:
            size = max(1, min(_MOST_BATCH, int(BATCH_TIME / self._seconds)))
            batch = list(itertools.islice(tasks, size))
            if not batch:
                return
            self._submit(batch, completed)

    def _submit(self, batch: list[Task], completed: as_completed) -> Future:
        key = f"xtdrone-{batch[0]['key']}-{next(self._numbers)}"
        future = self._client.submit(self._work, self._common, batch, key=key, pure=False)
        self._running[future] = batch
        completed.add(future)
        return future

    def _rows(self, future: Future, result: Any) -> list[Row]:
        """Return the rows of a batch that has ended; none if its runs have to be repeated."""
        batch = self._running.pop(future)
        alone = future is self._alone
        if alone:
            self._alone = None
        # Check the result, not the status: a future is pending again if its worker died after delivering the rows.
        if isinstance(result, list):
            self._learn(result)
            return result
        if future.status != "error":
            raise self._scheduler_lost()
        error = result[1] if isinstance(result, tuple) else result
        if not isinstance(error, KilledWorker):
            raise SweepError(
                f"workers cannot fly: {type(error).__name__}: {_first_line(error)}; a cluster's workers need this "
                "package and its Python packages in the same versions"
            ) from error
        self.lost += 1
        if not alone:
            self._suspects += batch
            return []
        return [_killed_row(batch[0])]

    def _learn(self, rows: Sequence[Row]) -> None:
        """Update the duration of a run; quickly upwards, because small batches cost little."""
        for row in rows:
            share = 1.0 if row["wall_time"] > self._seconds else _SMOOTHING
            self._seconds += share * (max(row["wall_time"], 1e-4) - self._seconds)

    def _abandon(self) -> None:
        """Cancel unfinished batches."""
        if self._running and self._client.status == "running":
            self._client.cancel(list(self._running), asynchronous=False)
        self._running.clear()

    def _scheduler_lost(self) -> SchedulerLostError:
        return SchedulerLostError("scheduler: the connection to it is lost")


def _finished(completed: as_completed) -> list[tuple[Future, Any]]:
    """Return the finished batches, waiting up to _POLL seconds for the first."""
    with completed.thread_condition:
        if not completed.has_ready():
            completed.thread_condition.wait(_POLL)
    return completed.next_batch(block=False)


def _killed_row(task: Task) -> Row:
    return {
        "key": task["key"],
        "seed": task["seed"],
        **task["varied"],
        "error": f"KilledWorker: {_LOST_WORKERS + 1} workers died while flying it (out of memory, a crash, or killed)",
        "wall_time": 0.0,
    }


@contextmanager
def _signals_for_this_process() -> Iterator[None]:
    """Block a terminal's signals in threads started within the context, and in the processes that they start.

    Ctrl-C reaches every process of the terminal's group, but the workers are to be stopped by this one.
    """
    ours = {signal.SIGINT, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ours)
    try:
        resource_tracker.ensure_running()  # so that Python's helper process survives SIGHUP, too; it unblocks SIGINT
        signal.pthread_sigmask(signal.SIG_BLOCK, ours)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's log of its workers; the sweep reports failures itself."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
