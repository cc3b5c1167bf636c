"""The daemon's loop: messages from the inbox to the vehicles they belong to, and what is due in between.

Everything that decides sits in the vehicles' pipelines, which read no clock; the loop moves messages, lets time pass
where nothing comes, and tells the watchdog that it is alive.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from monitor.service.fleet import Fleet
from monitor.service.inbox import Arrival, Inbox
from monitor.service.post import Post

_POLL_S = 0.05
# in between portions of longer work the links' threads get their turn
_PAUSE_S = 0.002
_EVERY_NS = 50_000_000


class Daemon:
    """Runs the vehicles of one process on live links.

    Parameters
    ----------
    inbox : Inbox
        Where messages come from.
    fleet : Fleet
        Which vehicle they belong to.
    posts : Callable[[], Sequence[Post]]
        The vehicles' posts; they may become more.
    troubles : Callable[[], Sequence[str]]
        What is wrong with links and disks, for the status.
    every_turn : Callable[[int], None]
        Called about twenty times a second with Unix time: reloads, retries.
    """

    def __init__(
        self,
        inbox: Inbox,
        fleet: Fleet,
        posts: Callable[[], Sequence[Post]],
        troubles: Callable[[], Sequence[str]],
        every_turn: Callable[[int], None],
    ) -> None:
        self._inbox = inbox
        self._fleet = fleet
        self._posts = posts
        self._troubles = troubles
        self._every_turn = every_turn
        self._stopping = False
        self._clips_turn = 0

    def stop(self) -> None:
        """Ask :meth:`run` to return after the message in hand."""
        self._stopping = True

    def run(self) -> None:
        """Monitor until :meth:`stop`."""
        due_ns = 0
        busy = False
        while not self._stopping:
            arrivals = self._inbox.take(_PAUSE_S if busy else _POLL_S)
            now_ns = time.time_ns()
            # Before the messages: who was frozen has to know who speaks before it says what they cause.
            if not 0 <= due_ns - now_ns <= _EVERY_NS:
                due_ns = now_ns + _EVERY_NS
                self._every_turn(now_ns)
                troubles = self._troubles()
                for post in self._posts():
                    post.work(now_ns, troubles)
            self._hand_out(arrivals)
            # Time may pass only where nothing older waits: a message that is there already ends a silence.
            if self._inbox.empty:
                now_ns = time.time_ns()
                for monitor in self._fleet:
                    monitor.pass_time(now_ns)
                busy = self._work_on_clips(now_ns)

    def finish(self, patience_s: float) -> None:
        """Take what has arrived but waits still, for so long at most: once nothing more comes in."""
        until = time.monotonic() + patience_s
        while not self._inbox.empty and time.monotonic() < until:
            self._hand_out(self._inbox.take(0.0))

    def _work_on_clips(self, now_ns: int) -> bool:
        """Let the next vehicle that has clips to write do some of it; return whether there was one."""
        posts = self._posts()
        for _ in posts:
            self._clips_turn = (self._clips_turn + 1) % len(posts)
            if posts[self._clips_turn].work_on_clips(now_ns):
                return True
        return False

    def _hand_out(self, arrivals: Sequence[Arrival]) -> None:
        for arrival in arrivals:
            vehicle = self._fleet.vehicle_of(arrival)
            if vehicle is not None:
                vehicle.take(arrival.message, time.time_ns)
