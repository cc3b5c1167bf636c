"""Replay many logs on a Dask cluster: each task carries the profile, and the path of a log that workers can reach."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from adapters.errors import TelemetryError, UsageError
from monitor.profile import Profile
from replay.runs.many_logs import profile_of
from replay.runs.one_log import LogOutcome, LogTask, replay_log

_CONNECT_S = 10
"""Chosen: a scheduler that is there answers within a second, also over a slow network."""
_LEAST_AHEAD = 64
"""Chosen: tasks that are handed out before the first is done, so that no core waits for the network."""
_AHEAD_PER_CORE = 8
"""Chosen: a log takes about a second; eight of them hide the latency of handing out more."""
_KEPT_PROFILES = 4
"""Profiles that a worker keeps read. Chosen: several replays may share a cluster."""

Files = tuple[tuple[str, bytes], ...]


def replay_on_dask(files: Mapping[str, bytes], tasks: Sequence[LogTask], address: str) -> Iterator[LogOutcome]:
    """Replay logs on a cluster, and return what was found in the order of the logs.

    Workers need this package in the same version and the paths of the tasks, and share nothing else. A worker that
    dies is replaced by another; the log that kills them all fails alone. What is not done is taken back when the
    iteration ends.

    Parameters
    ----------
    files : Mapping[str, bytes]
        The profile's files by name.
    tasks : Sequence[LogTask]
        The logs, with absolute paths.
    address : str
        The scheduler's (``tcp://127.0.0.1:8786``).

    Raises
    ------
    UsageError
        Dask is not installed.
    TelemetryError
        There is no cluster at that address.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError("--dask: Dask is not installed; run: pip install 'fauio[dask]'") from error
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise TelemetryError(f"--dask {address}: no cluster answers there: {reason}") from error
    sent: Files = tuple(sorted(files.items()))
    waiting: deque[tuple[LogTask, Any]] = deque()
    with client:
        ahead = max(_LEAST_AHEAD, _AHEAD_PER_CORE * sum(client.ncores().values()))
        try:
            for task in tasks:
                if len(waiting) >= ahead:
                    yield _outcome(*waiting.popleft())
                waiting.append((task, client.submit(replay_sent, sent, task, pure=False)))
            while waiting:
                yield _outcome(*waiting.popleft())
        finally:
            client.cancel([future for _, future in waiting], force=True)


def replay_sent(files: Files, task: LogTask) -> LogOutcome:
    """Replay a log on a worker."""
    return replay_log(_profile(files), task)


@functools.lru_cache(_KEPT_PROFILES)
def _profile(files: Files) -> Profile:
    return profile_of(dict(files))


def _outcome(task: LogTask, future: Any) -> LogOutcome:
    try:
        found: LogOutcome = future.result()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return LogOutcome(log=task.log, error=f"{task.log}: not replayed by the cluster: {reason}")
    return found
