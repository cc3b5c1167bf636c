"""Replay many logs in processes of their own: the same results in the same order, whatever becomes of a process."""

from __future__ import annotations

import contextlib
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from adapters.errors import TelemetryError, UsageError
from monitor.profile import Profile
from replay.runs.one_log import LogOutcome, LogTask, replay_log

_CONNECT_S = 10
"""Chosen: a scheduler that is there answers within a second, also over a slow network."""
_LEAST_AHEAD = 64
"""Chosen: tasks that are handed out before the first is done, so that no core waits for the network."""
_AHEAD_PER_CORE = 8
"""Chosen: a log takes about a second; eight of them hide the latency of handing out more."""


def replay_on_dask(profile: Profile, tasks: Sequence[LogTask], address: str) -> Iterator[LogOutcome]:
    """Replay logs on the cluster of a scheduler, and return what was found in the order of the logs.

    Workers need this package in the same version and the paths of the tasks, which are absolute, and share nothing
    else. A worker that dies is replaced by another; the log that kills them all fails alone. What is not done is taken
    back when the iteration ends. Raises UsageError where Dask is not installed, TelemetryError where there is no
    cluster.
    """
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise UsageError("--dask: Dask is not installed; run: pip install 'fauio[dask]'") from error
    try:
        get_address_host_port(address)  # a client that was not made for want of a port ends in a traceback of its own
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise TelemetryError(f"--dask {address}: no cluster answers there: {reason}") from error
    waiting: deque[tuple[LogTask, Any]] = deque()
    with client:
        ahead = max(_LEAST_AHEAD, _AHEAD_PER_CORE * sum(client.ncores().values()))
        # sent once, and again to whoever takes the place of a worker that died
        sent = client.submit(_sent, profile, pure=False)
        try:
            for task in tasks:
                if len(waiting) >= ahead:
                    yield _outcome(*waiting.popleft())
                waiting.append((task, client.submit(replay_log, sent, task, pure=False)))
            while waiting:
                yield _outcome(*waiting.popleft())
        finally:
            client.cancel([future for _, future in waiting], force=True)


def _sent(profile: Profile) -> Profile:
    return profile


def _outcome(task: LogTask, future: Any) -> LogOutcome:
    try:
        outcome: LogOutcome = future.result()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return LogOutcome(log=task.log, error=f"{task.log}: not replayed by the cluster: {reason}")
    return outcome


# How many logs to go on while one takes long: what is found in them waits in memory.
AHEAD = 256


def replay_in_processes(profile: Profile, tasks: Sequence[LogTask], jobs: int) -> Iterator[LogOutcome]:
    """Replay logs in processes, and return what was found in the order of the logs.

    A process that dies fails its log alone. When the iteration ends, however it ends, so do all processes.
    """
    workers = [_Worker(profile) for _ in range(min(jobs, len(tasks)))]
    done: dict[int, LogOutcome] = {}
    given = yielded = 0
    try:
        while yielded < len(tasks):
            for worker in workers:
                if worker.at is None and given < min(len(tasks), yielded + AHEAD):
                    worker.give(given, tasks[given])
                    given += 1
            busy = {worker.connection: worker for worker in workers if worker.at is not None}
            for connection in wait(list(busy)):
                worker = busy[connection]  # type: ignore[index]
                at, outcome = worker.take()
                done[at] = outcome
                if not worker.alive:
                    workers[workers.index(worker)] = _Worker(profile)
            while yielded in done:
                yield done.pop(yielded)
                yielded += 1
    finally:
        for worker in workers:
            worker.end()


@contextlib.contextmanager
def deaf_to_interrupts() -> Iterator[None]:
    """Start processes that do not hear Ctrl-C, which reaches every process of a terminal: only the first shall act."""
    # what multiprocessing starts beside the first process would undo that
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """A process that replays one log after the other.

    ``connection`` becomes readable when a log is done, or the process; ``at`` is the index of the log it is at,
    ``alive`` says whether it can take another.
    """

    def __init__(self, profile: Profile) -> None:
        # spawned, not forked: whatever runs in this process does not run in that one
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.at: int | None = None
        self.alive = True
        self._log = ""
        self._process = context.Process(target=_work, args=(theirs, profile), daemon=True)
        with deaf_to_interrupts():
            self._process.start()
        # what is left open here would hide the end of the process
        theirs.close()

    def give(self, at: int, task: LogTask) -> None:
        """Let it replay a log."""
        self.at, self._log = at, task.log
        # where it has died, the connection says so
        with contextlib.suppress(OSError):
            self.connection.send(task)

    def take(self) -> tuple[int, LogOutcome]:
        """Return what became of its log."""
        at = self.at
        assert at is not None  # noqa: S101 - only who is at a log is asked
        self.at = None
        try:
            outcome: LogOutcome = self.connection.recv()
        except (EOFError, OSError):
            self.alive = False
            self.end()
            code = self._process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit status {code}"
            return at, LogOutcome(log=self._log, error=f"{self._log}: the process that replayed it ended ({how})")
        return at, outcome

    def end(self) -> None:
        """End the process, whatever it is at."""
        self.connection.close()
        if self.alive:
            self._process.terminate()
        self._process.join()


def _work(connection: Connection, profile: Profile) -> None:
    """Replay the logs that come, until no more can."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send(replay_log(profile, connection.recv()))
