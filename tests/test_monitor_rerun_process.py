"""Rerun in a process of its own: a server that nobody can end any more ends by itself."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from loopback import free_port, until

ROOT = Path(__file__).parent.parent
SERVE = """
import sys, time
from monitor.views.live_view import RerunProcess
process = RerunProcess("serve", int(sys.argv[1]), 64)
print(process._process.pid, process._guard.pid, flush=True)
if sys.argv[2] == "close":
    process.close()
else:
    time.sleep(600)
"""


def lives(process: int) -> bool:
    """Return whether a process runs; one that has ended may wait to be noticed by its parent."""
    command = ["ps", "-o", "stat=", "-p", str(process)]
    state = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return bool(state) and not state.startswith("Z")


def start(then: str) -> tuple[subprocess.Popen[str], list[int]]:
    """Start a process that serves; return it, and the ids of the server and of what watches over it."""
    command = [sys.executable, "-c", SERVE, str(free_port()), then]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    return parent, [int(word) for word in parent.stdout.readline().split()]


def test_a_server_does_not_outlive_a_killed_parent() -> None:
    parent, children = start("wait")
    with parent:
        assert all(map(lives, children))
        parent.send_signal(signal.SIGKILL)
    until(lambda: not any(map(lives, children)))


def test_a_server_that_is_closed_leaves_nobody_behind() -> None:
    parent, children = start("close")
    with parent:
        assert parent.wait() == 0
    assert not any(map(lives, children))
