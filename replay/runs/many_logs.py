"""Replay many logs in several processes, with the same results in the same order even if a process dies."""

import contextlib
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, resource_tracker
from typing import Any

from adapters.errors import TelemetryError, UsageError
from monitor.profile import Profile
from replay.runs.one_log import LogOutcome, LogTask, replay_log

_CONNECT_S = 10
"""Longest wait for a scheduler, seconds. Chosen: a running scheduler answers within a second, even over a slow
network."""
_LEAST_AHEAD = 64
"""Fewest tasks that are handed out before the first is done. Chosen: so that no core waits for the network."""
_AHEAD_PER_CORE = 8
"""Tasks per core that are handed out in advance. Chosen: a log takes about a second; eight of them hide the latency of
handing out more."""


def replay_on_dask(profile: Profile, tasks: Sequence[LogTask], address: str) -> Iterator[LogOutcome]:
    """Replay logs on the cluster of a scheduler, and return the results in the order of the logs.

    Workers need the same version of this package and the tasks' paths, which are absolute, and share nothing else. A
    worker that dies is replaced by another; a log that kills them all fails alone. Unfinished tasks are cancelled when
    the iteration ends. Raises UsageError if Dask is not installed, TelemetryError if there is no cluster.
    """
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise UsageError("--dask: Dask is not installed; run: pip install 'fauio[dask]'") from error
    try:
        get_address_host_port(address)  # a client without a port would fail with a traceback of its own
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise TelemetryError(f"--dask {address}: no cluster answers there: {reason}") from error
    waiting: deque[tuple[LogTask, Any]] = deque()
    with client:
        ahead = max(_LEAST_AHEAD, _AHEAD_PER_CORE * sum(client.ncores().values()))
        # sent once, and again to the worker that replaces a dead one
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


def replay_in_processes(profile: Profile, tasks: Sequence[LogTask], jobs: int) -> Iterator[LogOutcome]:
    """Replay logs in processes, and return the results in the order of the logs.

    If a process dies, only its log fails. All processes end with the iteration, even if that fails.
    """
    own, before = threading.local(), set(active_children())

    def replayed(task: LogTask) -> LogOutcome:
        # a process for each thread, since one that dies would end a whole pool
        if getattr(own, "pool", None) is None:
            own.pool = pools.enter_context(ProcessPoolExecutor(1, get_context("spawn")))
        try:
            with deaf_to_interrupts():
                found = own.pool.submit(replay_log, profile, task)
            outcome: LogOutcome = found.result()
        except BrokenProcessPool:
            own.pool = None
            error = f"{task.log}: the process that replayed it was ended, perhaps for want of memory"
            return LogOutcome(log=task.log, error=error)
        return outcome

    with contextlib.ExitStack() as pools, ThreadPoolExecutor(min(jobs, len(tasks))) as threads:
        try:
            yield from threads.map(replayed, tasks)
        finally:
            for process in set(active_children()) - before:
                process.terminate()


@contextlib.contextmanager
def deaf_to_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which reaches all processes of a terminal: only the first one reacts."""
    # the process that multiprocessing starts beside the first one would undo that
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
