"""The suite in several processes, forked from one that has imported and collected all tests: that is done only once.

A process takes one file after the other. Threads do not survive a fork: modules start none that tests need.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

import pytest

File = Sequence[pytest.Item]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let processes be asked for."""
    parser.addoption("--processes", type=int, default=1, help="run the files in so many processes (default 1)")


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Hand out the files in their order, and report what their tests say."""
    count = session.config.option.processes
    if count < 2 or session.config.option.collectonly or session.testsfailed:
        return None
    files = [[*items] for _, items in groupby(session.items, key=lambda item: item.path)]
    waiting = iter(range(len(files)))
    session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]  # one for all
    latest: dict[Connection, str] = {}
    processes = []
    for _ in range(count):
        ours, theirs = Pipe()
        process = os.fork()
        if not process:
            for connection in (ours, *latest):
                connection.close()
            _run(session, files, theirs)
        theirs.close()
        processes.append(process)
        latest[ours] = "its start"
    try:
        while latest:
            for connection in wait([*latest]):
                assert isinstance(connection, Connection)
                _answer(session, connection, latest, waiting)
    finally:
        for connection in latest:
            connection.close()
        for process in processes:
            os.waitpid(process, 0)
    return True


def _answer(
    session: pytest.Session, connection: Connection, latest: dict[Connection, str], waiting: Iterator[int]
) -> None:
    """Take a report from a process, the latest of which is for its error, or give it the next file, or let it end."""
    hook = session.config.hook
    try:
        said = connection.recv()
    except (EOFError, ConnectionResetError):
        raise pytest.UsageError(f"a process of the suite died in or after {latest.pop(connection)}") from None
    if said is None:
        connection.send(next(waiting, None))
    elif said is ...:
        del latest[connection]
    else:
        report = hook.pytest_report_from_serializable(config=session.config, data=said)
        latest[connection] = report.nodeid
        hook.pytest_runtest_logreport(report=report)
        if session.shouldfail:
            raise session.Failed(session.shouldfail)


def _run(session: pytest.Session, files: Sequence[File], connection: Connection) -> None:
    """Run the tests of files until there are no more, in a process that ends with them."""
    try:
        plugins = session.config.pluginmanager
        capture = plugins.getplugin("capturemanager")
        capture.stop_global_capturing()
        # what the terminal shows is up to the first process
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        capture.start_global_capturing()
        plugins.register(_Reports(session.config, connection))
        file = _following(files, connection)
        while file:
            for item, after in pairwise(file):
                item.ihook.pytest_runtest_protocol(item=item, nextitem=after)
            # the first test of the next file tells which fixtures are needed no more
            last, file = file[-1], _following(files, connection)
            last.ihook.pytest_runtest_protocol(item=last, nextitem=file[0] if file else None)
        connection.send(...)
    finally:
        os._exit(0)


def _following(files: Sequence[File], connection: Connection) -> File:
    connection.send(None)
    index = connection.recv()
    return [] if index is None else files[index]


class _Reports:
    """Sends what tests say to the first process."""

    def __init__(self, config: pytest.Config, connection: Connection) -> None:
        self._config = config
        self._connection = connection

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data: Any = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._connection.send(data)
