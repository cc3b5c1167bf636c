"""Notify systemd: ready, stopping, reloading, a status line, and keep-alives for its watchdog (sd_notify(3))."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

_MAX_STATUS = 500
"""Largest length of the status line. Chosen: systemctl status shows it as one line."""


class Notifier:
    """Sends datagrams to the service manager, or nothing if there is none. No error of the socket raises.

    ``environment`` is that of the process: ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID``. ``watchdog_ns``
    is the time within which the watchdog expects a keep-alive, None without a watchdog; ``failed`` counts datagrams
    that could not be sent.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self.failed = 0
        self.watchdog_ns = _watchdog_ns(environment)
        self._fed_ns: int | None = None
        self._socket: socket.socket | None = None
        self._address = environment.get("NOTIFY_SOCKET", "")
        if self._address.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            # a service manager that does not read must not stop the monitor
            self._socket.setblocking(False)

    def ready(self, status: str = "") -> None:
        """Notify that the start, or a reload, is finished."""
        self._send("READY=1", *_status(status))

    def reloading(self) -> None:
        """Notify that the configuration is being read again; :meth:`ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """Notify that the daemon is stopping."""
        self._send("STOPPING=1")

    def feed(self, alive: bool, now_ns: int | None = None) -> bool:
        """Feed the watchdog while every part of the daemon is alive, at most three times as often as it expects.

        If a part does not answer nothing is sent, and systemd will restart the daemon. ``now_ns`` is any steadily
        growing time; None: that of the monotonic clock. Return whether the watchdog was fed.
        """
        if not alive or self.watchdog_ns is None:
            return False
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        if self._fed_ns is not None and now_ns - self._fed_ns < self.watchdog_ns // 3:
            return False
        sent = self._send("WATCHDOG=1")
        if sent:
            self._fed_ns = now_ns
        return sent

    def close(self) -> None:
        """Close the socket; later notifications are not sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> bool:
        if self._socket is None or not lines:
            return False
        # an abstract address begins with a zero byte, written as @
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto("\n".join(lines).encode(errors="replace"), address)
        except OSError:
            self.failed += 1
            return False
        return True


def _status(text: str) -> tuple[str, ...]:
    line = "".join(c if c.isprintable() else " " for c in text[:_MAX_STATUS]).strip()
    return (f"STATUS={line}",) if line else ()


def _watchdog_ns(environment: Mapping[str, str]) -> int | None:
    """Return the watchdog's time if it watches this very process (sd_watchdog_enabled(3))."""
    try:
        microseconds = int(environment.get("WATCHDOG_USEC", "0"))
        process = int(environment.get("WATCHDOG_PID", str(os.getpid())))
    except ValueError:
        return None
    return microseconds * 1000 if microseconds > 0 and process == os.getpid() else None
