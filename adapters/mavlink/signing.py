"""MAVLink 2 signing: the shared key, and which packets are admitted.

It follows the MAVLink guide (https://mavlink.io/en/guide/message_signing.html), with two differences. The hash is
verified before any content of the packet is used: a forged packet cannot advance a stream's time stamp and so lock its
owner out. And a packet that comes twice or out of order within a second or two is refused like any replay, but not
called one, since networks do that without malice.

A vehicle without a clock stamps its packets with the time that it last knew. Until a ground station with the same key
has sent it a better time, its first packets are too old and refused as replayed, as in the guide.
"""

import enum
import hashlib
import hmac
import json
import logging
import os
import stat
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

from adapters.errors import TelemetryError
from adapters.mavlink.mavlink_message import message_number, packet_sender, packet_signed
from adapters.message import Message
from adapters.output_file import write_file
from adapters.source import LINK

SIGNING = "signing"
"""Name of the messages of source ``link`` that report refused packets."""

_KEY_BYTES = 32
"""MAVLink 2 message signing: a key of 256 bits."""
_HASH_BYTES = 6
"""MAVLink 2 message signing: the first 48 bits of SHA-256."""
_STAMP_BYTES = 6
"""MAVLink 2 message signing: 48 bits of time."""
_EPOCH_NS = 1_420_070_400_000_000_000
"""MAVLink 2 message signing counts from 1 January 2015 GMT."""
_STAMP_NS = 10_000
"""MAVLink 2 message signing counts in units of 10 microseconds."""
_MINUTE = 6_000_000
"""A minute in units of the time stamp. MAVLink refuses a new stream whose time is further behind."""
_LARGEST_KEY_FILE = 4096
"""Largest file of a key, bytes: a key has 32, as text 64 digits."""
# Only holders of the key get a stream; of more than these the one with the longest silence is forgotten.
_STREAMS = 1024
_LATE_NS = 1_000_000_000
_REPORT_NS = 1_000_000_000
# RADIO_STATUS and RADIO: radios insert them on the way and have no key.
_FROM_RADIOS = frozenset((109, 166))
_FINDINGS = ("forged", "replayed", "unsigned")


@dataclass(frozen=True, slots=True)
class SigningKey:
    """The secret, 32 bytes, that both ends of a link share; it is hidden when printed.

    Raises
    ------
    TelemetryError
        It is not 32 bytes.
    """

    secret: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.secret) != _KEY_BYTES:
            raise TelemetryError(f"a signing key has {_KEY_BYTES} bytes, not {len(self.secret)}")

    def signature(self, signed: bytes) -> bytes:
        """Return the six bytes that sign a packet up to and including its time stamp."""
        return hashlib.sha256(self.secret + signed).digest()[:_HASH_BYTES]


def read_key(path: str | os.PathLike[str]) -> SigningKey:
    """Return the key of a file.

    The file holds 64 hexadecimal digits, or a passphrase on one line, whose SHA-256 hash is the key as in Mission
    Planner, QGroundControl and MAVProxy, or 32 bytes that are not such a text.

    Raises
    ------
    TelemetryError
        The file cannot be read, holds no key, or every user of the machine may read it.
    """
    try:
        with Path(path).open("rb") as file:
            open_to_all = os.name == "posix" and os.fstat(file.fileno()).st_mode & (stat.S_IROTH | stat.S_IWOTH)
            content = file.read(_LARGEST_KEY_FILE + 1)
    except OSError as error:
        raise TelemetryError(f"{path}: signing key cannot be read: {error.strerror}") from error
    if open_to_all:
        raise TelemetryError(f"{path}: every user may read or change this signing key; run 'chmod o-rwx {path}'")
    try:
        line = content.decode().rstrip("\r\n")
    except UnicodeDecodeError:
        line = ""
    if line.isprintable() and line.strip() and len(content) <= _LARGEST_KEY_FILE:
        digits = line.strip()
        if len(digits) == 2 * _KEY_BYTES and all(digit in "0123456789abcdefABCDEF" for digit in digits):
            return SigningKey(bytes.fromhex(digits))
        return SigningKey(hashlib.sha256(line.encode()).digest())
    if len(content) == _KEY_BYTES:
        return SigningKey(content)
    raise TelemetryError(
        f"{path}: holds no signing key: give 64 hexadecimal digits, a passphrase on one line, or 32 bytes"
    )


def unix_stamp(now_ns: int) -> int:
    """Return a Unix time in nanoseconds as a signature's time stamp: 10 microseconds since 2015."""
    return max(0, (now_ns - _EPOCH_NS) // _STAMP_NS)


class SignatureVerdict(enum.Enum):
    """The verdict on a packet's signature."""

    VALID = enum.auto()
    UNSIGNED = enum.auto()
    FORGED = enum.auto()
    REPLAYED = enum.auto()
    LATE = enum.auto()


class _Stream:
    """Time stamps of one (link, system, component)."""

    __slots__ = ("before", "newest", "recent", "since_ns")

    def __init__(self, oldest: int, now_ns: int) -> None:
        self.newest = self.recent = self.before = oldest
        self.since_ns = now_ns

    def take(self, stamp: int, now_ns: int) -> SignatureVerdict:
        age_ns = now_ns - self.since_ns
        if not 0 <= age_ns < _LATE_NS:
            # Sorted by time of arrival: the stamps of a vehicle without a clock only count its packets.
            self.before = self.recent if 0 <= age_ns < 2 * _LATE_NS else self.newest
            self.recent = self.newest
            self.since_ns = now_ns
        if stamp > self.newest:
            self.newest = stamp
            return SignatureVerdict.VALID
        return SignatureVerdict.LATE if stamp > self.before else SignatureVerdict.REPLAYED


class SignatureVerifier:
    """Verifies the packets of all links that share a key; its memory is bounded.

    A stream is a (link id, system, component) of the signatures on any link: a packet that came on one link is a replay
    on every other.
    """

    def __init__(self, key: SigningKey) -> None:
        self._key = key
        self._streams: OrderedDict[tuple[int, int, int], _Stream] = OrderedDict()
        self._newest = 0

    def check(self, packet: bytes, now_ns: int) -> SignatureVerdict:
        """Return the verdict on an intact packet that arrived at a Unix time.

        A stream's time stamps have to increase; its first may be at most a minute behind the present time or the newest
        valid stamp of all streams.
        """
        if not packet_signed(packet):
            return SignatureVerdict.UNSIGNED
        if not hmac.compare_digest(self._key.signature(packet[:-_HASH_BYTES]), packet[-_HASH_BYTES:]):
            return SignatureVerdict.FORGED
        stamp_at = len(packet) - _HASH_BYTES - _STAMP_BYTES
        stamp = int.from_bytes(packet[stamp_at : stamp_at + _STAMP_BYTES], "little")
        name = (packet[stamp_at - 1], *packet_sender(packet))
        stream = self._streams.get(name)
        if stream is None:
            oldest = max(unix_stamp(now_ns), self._newest) - _MINUTE - 1
            if stamp <= oldest:
                return SignatureVerdict.REPLAYED
            stream = self._streams[name] = _Stream(oldest, now_ns)
            if len(self._streams) > _STREAMS:
                self._streams.popitem(last=False)
        else:
            self._streams.move_to_end(name)
        self._newest = max(self._newest, stamp)
        return stream.take(stamp, now_ns)

    def stamps(self) -> dict[str, int]:
        """Return the newest time stamp of each stream, the one with the longest silence first."""
        return {"/".join(map(str, name)): stream.newest for name, stream in self._streams.items()}

    def restore(self, stamps: object, now_ns: int) -> None:
        """Continue from an earlier run's :meth:`stamps` at Unix time ``now_ns``; raise ValueError for invalid ones."""
        if not isinstance(stamps, dict):
            raise ValueError("no table of time stamps")
        streams: OrderedDict[tuple[int, int, int], _Stream] = OrderedDict()
        for name, stamp in stamps.items():
            link_id, system, component = (int(number) for number in name.split("/"))
            if not isinstance(stamp, int) or not 0 <= stamp < 1 << (8 * _STAMP_BYTES):
                raise ValueError(f"{stamp!r:.40} is no time stamp")
            streams[link_id, system, component] = _Stream(stamp, now_ns)
        self._streams = streams
        self._newest = max((stream.newest for stream in streams.values()), default=0)


@dataclass(frozen=True, slots=True)
class SigningStatistics:
    """Packets of one link refused so far.

    A ``forged`` packet has another key's signature, a ``replayed`` one is a valid packet from earlier; a ``late`` one
    is valid, but came twice or after its successor within a second or two. ``unsigned`` packets count if signatures are
    required.
    """

    forged: int = 0
    replayed: int = 0
    unsigned: int = 0
    late: int = 0


class SigningGuard:
    """Admits the packets that may be trusted, and reports the others, by system; all links share one guard.

    If signatures are required, the reports that telemetry radios insert themselves (RADIO_STATUS, RADIO) still need
    none. With a ``state`` file the newest time stamps are read from it, and written to it by :meth:`save`, so that
    packets recorded before a restart are refused after it. Each link may call it from its own thread.
    """

    def __init__(self, key: SigningKey, require_signed: bool = True, state: Path | None = None) -> None:
        self._verifier = SignatureVerifier(key)
        self._require_signed = require_signed
        self._lock = threading.Lock()
        # By claimed system id, which is one byte: at most 256 entries.
        self._refused: dict[int, dict[str, int]] = {}
        self._reported_ns: dict[int, int] = {}
        self._unreported: set[int] = set()
        self._state = state
        self._saved: dict[str, int] = {}
        if state is not None and state.exists():
            try:
                self._verifier.restore(json.loads(state.read_bytes()), time.time_ns())
            except (OSError, ValueError) as error:
                text = "%s: time stamps of signatures cannot be read (%s): packets of the last minute can be replayed"
                logging.getLogger(__name__).error(text, state, error)

    def save(self) -> None:
        """Write the newest time stamps to the state file if they have changed; a failure is logged.

        Call it once a second, in a thread that may wait for a disk: packets that came after the last call can be
        replayed after a crash.
        """
        if self._state is None:
            return
        with self._lock:
            stamps = self._verifier.stamps()
        if stamps == self._saved:
            return
        try:
            self._state.parent.mkdir(parents=True, exist_ok=True)
            write_file(self._state, json.dumps(stamps))
        except OSError as error:
            logging.getLogger(__name__).warning("%s: time stamps of signatures not kept: %s", self._state, error)
        else:
            self._saved = stamps

    def refusal(self, packet: bytes, now_ns: int) -> SignatureVerdict | None:
        """Return why an intact packet is refused, and count it; None if it is admitted."""
        with self._lock:
            verdict = self._verifier.check(packet, now_ns)
            if verdict is SignatureVerdict.VALID:
                return None
            if verdict is SignatureVerdict.LATE:
                return verdict
            if verdict is SignatureVerdict.UNSIGNED and (
                not self._require_signed or message_number(packet) in _FROM_RADIOS
            ):
                return None
            system, _ = packet_sender(packet)
            counts = self._refused.setdefault(system, dict.fromkeys(_FINDINGS, 0))
            counts[verdict.name.lower()] += 1
            self._unreported.add(system)
            return verdict

    def findings(self, now_ns: int) -> list[Message]:
        """Return new refusals of each system, at most once a second.

        They are of source ``link`` and name ``signing``, from the system that the refused packets claimed to come from;
        ``forged``, ``replayed`` and ``unsigned`` count them since the start, over all links.
        """
        if not self._unreported:
            return []
        with self._lock:
            due = [
                system
                for system in sorted(self._unreported)
                if not 0 <= now_ns - self._reported_ns.get(system, now_ns - _REPORT_NS) < _REPORT_NS
            ]
            for system in due:
                self._reported_ns[system] = now_ns
                self._unreported.discard(system)
            return [Message(LINK, SIGNING, now_ns, dict(self._refused[system]), system=system) for system in due]
