"""Byte links for MAVLink: UDP and TCP (either side) and serial, opened by URL.

pymavlink's own connections are not used: they print to standard output, block while they reconnect, and remember every
address that ever sent; its TCP server serves one client for ever.
"""

import contextlib
import os
import select
import socket
import sys
import threading
import time
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any, Protocol, cast

from adapters.errors import TelemetryError
from adapters.mavlink.datagrams import DatagramBox

UDP_BUFFER_BYTES = 1 << 22
"""Kernel memory for packets that wait to be read, bytes. A small packet takes about 1 KiB: seconds of several
vehicles."""

_READ_BYTES = 1 << 16
"""Bytes of one read: the largest datagram, and more than a serial line or TCP delivers at once."""
_MOST_OF_ONE = 256
"""Datagrams of one sender in one read: a dozen times the datagrams that a link of 1,000 packets a second brings in a
batch of 20 ms. More of a sender that floods are not processed, so that they do not take the time of the others."""
_RETRY_S = 0.5
"""Time between attempts to connect. Chosen: a ground station that restarts is back within a second, and trying twice a
second costs nothing."""
_CONNECT_S = 1.0
"""Longest wait for a connection: TCP tries again after a second, so an answer that takes longer was lost, and so would
be the next reads."""
_BAUD = 57_600
"""Default baud rate of telemetry radios (SiK) and of autopilots' TELEM ports."""
_HELP = "use udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD"

# Linux socket options for data about each datagram and for buffer size, which the socket module does not name. See
# socket(7).
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40

Piece = tuple[Hashable, bytes, int]
"""The sender (equal for equal senders), the bytes, and their Unix time of arrival in nanoseconds."""


class ByteLink(Protocol):
    """The interface that all links have in common.

    ``connections`` counts how often a connection was made, including the first time. ``overruns`` counts datagrams
    dropped because they were not read in time, by the kernel (0 if it does not report them) or, if their sender floods,
    here.

    ``stamps_arrivals`` says whether the kernel notes when each piece arrives, so that the piece may wait there without
    harm. Otherwise the time of arrival is the time of reading.
    """

    connections: int
    stamps_arrivals: bool

    @property
    def overruns(self) -> int: ...  # noqa: D102

    def read(self, timeout_s: float) -> list[Piece]:
        """Return what has arrived, each piece with its sender and time; wait at most ``timeout_s`` for the first."""

    def write(self, data: bytes, to: Iterable[Hashable]) -> None:
        """Send to the given senders of earlier pieces, if the link has several; bytes that cannot be sent are lost."""

    def close(self) -> None:
        """Close the link."""


def open_byte_link(url: str, may_send: bool = False) -> ByteLink:
    """Open the link that a URL names.

    Parameters
    ----------
    url : str
        ``udpin:HOST:PORT`` (binds to that address; ``udp:`` is the same), ``udpout:HOST:PORT`` (receives answers from
        that address), ``tcp:HOST:PORT`` (connects, and reconnects), ``tcpin:HOST:PORT`` (listens) or
        ``serial:DEVICE[:BAUD]``.
    may_send : bool
        Whether the user of the link will send; if not, nobody would answer a ``udpout``.

    Raises
    ------
    TelemetryError
        The URL is not understood, the address cannot be bound or resolved, the device cannot be opened, or the link
        works only for those who send.
    """
    kind, _, where = url.partition(":")
    if kind == "serial" and where:
        return _Serial(url, where)
    if kind == "udpout" and not may_send:
        raise TelemetryError(
            f"{url}: the other side only answers, and this monitor never sends; let the vehicle send here and use "
            "udpin:HOST:PORT"
        )
    if kind not in ("udp", "udpin", "udpout", "tcp", "tcpin"):
        raise TelemetryError(f"{url}: unknown kind of link; {_HELP}")
    address = resolve(url, where)
    if kind == "tcp":
        return _TcpClient(address)
    if kind == "tcpin":
        return _TcpServer(url, address)
    connected = kind == "udpout"
    return _Udp(_opened(url, address, socket.SOCK_DGRAM, connected=connected), connected)


Address = tuple[socket.AddressFamily, Any]


def resolve(url: str, host_port: str) -> Address:
    """Return family and address of ``HOST:PORT``, including ``[IPv6]:PORT``.

    Raises
    ------
    TelemetryError
        It does not have this form, or the host is not known; the message starts with ``url``.
    """
    host, colon, port = host_port.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 0xFFFF:
        raise TelemetryError(f"{url}: no HOST:PORT in it; {_HELP}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host.strip("[]"), int(port))[0]
    except OSError as error:
        raise TelemetryError(f"{url}: host '{host}' cannot be resolved: {error.strerror}") from error
    return family, address


def udp_address(url: str, said: str = "") -> Address:
    """Return the address to which ``udp:HOST:PORT`` or ``udpout:`` sends; errors name ``said``, otherwise the URL."""
    kind, _, where = url.partition(":")
    if kind not in ("udp", "udpout"):
        raise TelemetryError(f"{said or url}: use udp:HOST:PORT")
    return resolve(said or url, where)


def _opened(url: str, address: Address, kind: socket.SocketKind, *, connected: bool = False) -> socket.socket:
    """Return a socket that is bound to an address, or connected to it."""
    opened = socket.socket(address[0], kind)
    try:
        if kind == socket.SOCK_STREAM:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        (opened.connect if connected else opened.bind)(address[1])
    except OSError as error:
        opened.close()
        why = "there is no route to that address" if connected else "cannot listen there"
        raise TelemetryError(f"{url}: {why}: {error.strerror}") from error
    opened.setblocking(False)
    return opened


def _send(connection: socket.socket, data: bytes) -> None:
    with contextlib.suppress(OSError):
        if connection.send(data) < len(data):
            # The rest would come after a gap. The reader sees the end and reconnects.
            connection.shutdown(socket.SHUT_RDWR)


def _readable(*sources: Any, timeout_s: float) -> list[Any]:
    return select.select(sources, (), (), max(0.0, timeout_s))[0]


class _Udp:
    """Datagrams to one address from any sender; of a connected socket, only those from its peer."""

    def __init__(self, opened: socket.socket, connected: bool) -> None:
        self.connections = 1
        self._socket = opened
        self._connected = connected
        # A burst has to fit while the reader is busy; the kernel reduces this to its limit, except for root.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, UDP_BUFFER_BYTES)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, UDP_BUFFER_BYTES)
        self.stamps_arrivals = sys.platform == "linux"
        if self.stamps_arrivals:
            for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
        self._box = DatagramBox(opened.fileno(), _MOST_OF_ONE)
        self._keeper = threading.Thread(target=self._box.keep, name="datagrams", daemon=True)
        self._keeper.start()

    @property
    def overruns(self) -> int:
        return self._box.dropped

    def read(self, timeout_s: float) -> list[Piece]:
        return self._box.read(timeout_s)

    def write(self, data: bytes, to: Iterable[Hashable]) -> None:
        for sender in (None,) if self._connected else to:
            with contextlib.suppress(OSError):
                self._socket.sendmsg((data,), (), 0, cast("Any", sender))

    def close(self) -> None:
        self._box.close()
        self._keeper.join()
        self._socket.close()


class _Tcp:
    """The common part of both sides of a TCP connection: its socket, None while there is none."""

    stamps_arrivals = False
    overruns = 0

    def __init__(self) -> None:
        self.connections = 0
        self._socket: socket.socket | None = None

    def write(self, data: bytes, to: Iterable[Hashable]) -> None:
        del to
        if (connection := self._socket) is not None:
            _send(connection, data)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class _TcpClient(_Tcp):
    """A connection to a TCP server, made anew whenever it is lost."""

    def __init__(self, address: Address) -> None:
        super().__init__()
        self._address = address
        self._retry_at = 0.0

    def read(self, timeout_s: float) -> list[Piece]:
        until = time.monotonic() + timeout_s
        if self._socket is None and not self._connect(until):
            return []
        assert self._socket is not None  # noqa: S101 - tells the type checker what _connect has done
        if not _readable(self._socket, timeout_s=until - time.monotonic()):
            return []
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if data:
            return [(self.connections, data, time.time_ns())]
        self.close()
        return []

    def _connect(self, until: float) -> bool:
        wait_s = self._retry_at - time.monotonic()
        if wait_s > 0.0:
            time.sleep(max(0.0, min(wait_s, until - time.monotonic())))
            if time.monotonic() < self._retry_at:
                return False
        attempt = socket.socket(self._address[0], socket.SOCK_STREAM)
        attempt.settimeout(_CONNECT_S)
        try:
            attempt.connect(self._address[1])
        except OSError:
            attempt.close()
            self._retry_at = time.monotonic() + _RETRY_S
            return False
        attempt.setblocking(False)
        # The kernel notices a peer that vanished without closing; silence alone would not show it.
        attempt.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._socket = attempt
        self.connections += 1
        return True

    def close(self) -> None:
        super().close()
        self._retry_at = time.monotonic() + _RETRY_S


class _TcpServer(_Tcp):
    """A listening TCP socket; only the newest client is received."""

    def __init__(self, url: str, address: Address) -> None:
        super().__init__()
        self._listener = _opened(url, address, socket.SOCK_STREAM)
        self._listener.listen(1)

    def read(self, timeout_s: float) -> list[Piece]:
        sources = [self._listener] if self._socket is None else [self._socket, self._listener]
        ready = _readable(*sources, timeout_s=timeout_s)
        if self._socket in ready and self._socket is not None:
            with contextlib.suppress(OSError):
                if data := self._socket.recv(_READ_BYTES):
                    return [(self.connections, data, time.time_ns())]
            super().close()
        if self._listener in ready:
            with contextlib.suppress(OSError):
                client, _ = self._listener.accept()
                client.setblocking(False)
                super().close()
                self._socket = client
                self.connections += 1
        return []

    def close(self) -> None:
        super().close()
        self._listener.close()


class _Serial:
    """A serial port, opened anew when the device comes back."""

    stamps_arrivals = False

    def __init__(self, url: str, device: str) -> None:
        path, _, baud = device.rpartition(":")
        named_whole = not path or not baud.isdecimal() or Path(device).exists()
        self._device, self._baud = (device, _BAUD) if named_whole else (path, int(baud))
        self.connections = 0
        self.overruns = 0
        self._retry_at = 0.0
        self._port: Any = None
        try:
            self._open()
        except (OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else str(error).split("\n", 1)[0]
            raise TelemetryError(
                f"{url}: cannot be opened: {reason}; is it plugged in, and is the user in the dialout group?"
            ) from error

    def _open(self) -> None:
        import serial

        self._port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0)
        self.connections += 1

    def read(self, timeout_s: float) -> list[Piece]:
        if self._port is None:
            time.sleep(max(0.0, min(timeout_s, self._retry_at - time.monotonic())))
            if time.monotonic() < self._retry_at:
                return []
            self._retry_at = time.monotonic() + _RETRY_S
            with contextlib.suppress(OSError, ValueError):
                self._open()
            return []
        try:
            if not _readable(self._port, timeout_s=timeout_s):
                return []
            # A device that is readable without bytes has gone.
            if data := self._port.read(_READ_BYTES):
                return [(self.connections, bytes(data), time.time_ns())]
        except (OSError, ValueError):
            pass
        self.close()
        self._port = None
        self._retry_at = time.monotonic() + _RETRY_S
        return []

    def write(self, data: bytes, to: Iterable[Hashable]) -> None:
        del to
        if (port := self._port) is not None:
            # A port that the reader closed meanwhile raises one of these; a full port would block for ever.
            with contextlib.suppress(OSError, ValueError, TypeError):
                if select.select((), (port,), (), 0.0)[1]:
                    port.write(data)

    def close(self) -> None:
        if self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()
