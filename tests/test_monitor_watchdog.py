"""A loop that stands still ends the process; one that was stopped as a whole does not."""

import os
import signal
import subprocess
import sys
import threading
import time

from loopback import until

from monitor.service.watchdog import LIMIT, Watchdog

TICK_S = 0.05
"""A thread of a busy machine may wait for its turn for some tenths of a second: less than the limit of ten ticks."""
PROGRAM = f"""
import sys, time
from monitor.service.watchdog import Watchdog
watchdog = Watchdog(tick_s={TICK_S})
end = time.monotonic() + float(sys.argv[1])
print("running", flush=True)
while time.monotonic() < end:
    watchdog.feed()
    time.sleep(0.005)
print("hangs", flush=True)
time.sleep(60)
"""


def started(feeds_s: float) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(feeds_s)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"running\n"
    return process


def test_a_process_whose_loop_stands_still_ends_with_a_failure_and_says_where() -> None:
    with started(0.1) as process:
        _, said = process.communicate(timeout=30)
    assert process.returncode == 1
    assert b"the main loop has not run" in said
    assert b'File "<string>", line 11' in said


def test_a_process_that_was_stopped_as_a_whole_goes_on() -> None:
    with started(1.5) as process:
        process.send_signal(signal.SIGSTOP)
        time.sleep(LIMIT * TICK_S + 0.3)
        process.send_signal(signal.SIGCONT)
        assert process.stdout is not None
        assert process.stdout.readline() == b"hangs\n"
        process.communicate(timeout=30)


def test_a_loop_that_comes_round_is_left_alone_until_it_is_closed() -> None:
    ended = threading.Event()
    watchdog = Watchdog(ended.set, tick_s=TICK_S)
    end = time.monotonic() + 1.5 * LIMIT * TICK_S
    while time.monotonic() < end:
        watchdog.feed()
        time.sleep(0.01)
    assert not ended.is_set()
    until(ended.is_set)
    closed = Watchdog(ended.set, tick_s=0.01)
    ended.clear()
    closed.close()
    time.sleep(0.3)
    assert not ended.is_set()
