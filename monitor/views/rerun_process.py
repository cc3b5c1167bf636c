"""Rerun in a process of its own, fed through its standard input, so that its failures do not affect the monitor.

Rerun's in-process server listens on all interfaces unless told otherwise, grows without bound behind a client that
stalls, and then holds up the process that ends. A child can be killed, and a server does not outlive its parent.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from adapters.errors import UsageError

ViewMode = Literal["serve", "spawn"]

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 9876
"""Rerun's own default."""

_PAGES_FILE = "/proc/{}/statm"
# Seconds until a server that does not end, as one does not while a client stalls, is killed: the daemon's end waits.
_STOP_S = 1.0
# Waits for its standard input to end, as it does when the process at the other end is gone, for whatever reason.
_KILL_AT_EOF = 'read -r _; kill -9 "$1"'
# Seconds to wait for a viewer that may have been closed, so that it leaves no zombie; an open one is left alone.
_LEAVE_S = 0.3


class RerunProcess:
    """A Rerun server on a port of loopback, or a viewer on this machine's screen, fed with ``.rrd`` bytes.

    ``memory_mb`` is that of the server, for viewers that connect later, or of the viewer; the oldest data are dropped.
    """

    def __init__(self, mode: ViewMode, port: int, memory_mb: int) -> None:
        self._mode = mode
        options = [f"--bind={LOOPBACK}"]
        if mode == "serve":
            options += ["--serve-grpc", f"--port={port}", f"--server-memory-limit={memory_mb}MB"]
        else:
            options += ["--new", "--hide-welcome-screen", f"--memory-limit={memory_mb}MB"]
        # Rerun sends no usage statistics from continuous integration: a monitor does not phone home either.
        environment = os.environ | {"CI": "1", "RERUN_APP_ONLY": "true"}
        self._process = subprocess.Popen(  # noqa: S603 - the executable of our own dependency
            [rerun_binary(), "-", *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            env=environment,
            start_new_session=True,
        )
        self._guard = self._guarded() if mode == "serve" else None

    def write(self, data: bytes) -> None:
        """Write bytes, waiting for a process that is slow; raise OSError where the process is gone."""
        if self._process.stdin is None:
            raise BrokenPipeError
        rest = memoryview(data)
        while rest:
            rest = rest[self._process.stdin.write(rest) or 0 :]

    def resident_mb(self) -> float:
        """Return the process's resident memory; 0 where the system does not tell."""
        try:
            pages = int(Path(_PAGES_FILE.format(self._process.pid)).read_text().split()[1])
        except (OSError, IndexError, ValueError):
            return 0.0
        return pages * resource.getpagesize() / 1e6

    def kill(self) -> None:
        """End the process at once, even while another thread waits in :meth:`write`."""
        self._process.kill()

    def close(self) -> None:
        """End a server; leave a viewer open with its data."""
        try:
            self._end()
        finally:
            if self._guard is not None:
                self._guard.kill()
                self._guard.communicate()

    def _guarded(self) -> subprocess.Popen[bytes] | None:
        """Start a process that ends the server when this one was killed and could not; None where there is none."""
        with contextlib.suppress(OSError):
            return subprocess.Popen(  # noqa: S603 - a constant script
                ["/bin/sh", "-c", _KILL_AT_EOF, "sh", str(self._process.pid)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        return None

    def _end(self) -> None:
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self._mode == "spawn":
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_LEAVE_S)
            return
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(_STOP_S)


def rerun_binary() -> str:
    """Return the path of Rerun's executable; ``RERUN_CLI_PATH`` overrides, as in Rerun itself.

    Raises UsageError where there is none.
    """
    package = find_spec("rerun_cli")
    folders = package.submodule_search_locations if package is not None else None
    path = Path(os.environ.get("RERUN_CLI_PATH") or Path(folders[0] if folders else "", "rerun"))
    if not os.access(path, os.X_OK):
        raise UsageError(f"{path}: Rerun's executable is not there; install rerun-sdk again or set RERUN_CLI_PATH")
    return str(path)


def require_free(port: int) -> None:
    """Raise UsageError where a process listens on a port of loopback, or it is no port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"Rerun cannot listen on {LOOPBACK}:{port}: {error}; choose another port (--rerun-port)"
            ) from error
