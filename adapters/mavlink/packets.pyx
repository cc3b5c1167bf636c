# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""MAVLink packets, versions 1 and 2, in the bytes of links and telemetry logs: found, checked, counted, grouped.

A packet (https://mavlink.io/en/guide/serialization.html) is

    version 1: FE, length, sequence, system, component, id (1 byte), payload, checksum (2)
    version 2: FD, length, flags (2), sequence, system, component, id (3), payload, checksum (2), signature (13)

where the signature is present if the first bit of the first flags is set; other flags are not defined. The checksum
(X.25) includes a byte that stands for the message's definition.
"""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from cpython.mem cimport PyMem_Calloc, PyMem_Free, PyMem_Malloc, PyMem_Realloc
from libc.stdint cimport int16_t, int64_t, uint8_t, uint16_t, uint64_t
from libc.string cimport memcpy, memset

import numpy as np

from adapters.message import LATEST_NS

cdef uint64_t LATEST_US = LATEST_NS // 1_000  # no record begins with a later time

# How long a packet's number is remembered. A vehicle that restarts is away for longer; otherwise conflicts end after
# this time, as the numbers before the restart are forgotten.
cdef int64_t FRESH_NS = 2_000_000_000
# Duplicates over a slower radio come up to this much later; as in core/sampling.pyx.
cdef int64_t HELD_NS = 5_000_000_000
# A packet further behind, which was not missing, is the first after a restart. Chosen: more than networks reorder.
cdef int REORDERED = 32
# After a longer silence a number counts as ahead: so many may have been lost that it seems to be behind. Chosen: of
# 1,000 packets a second, the most that a link carries, less than half a turn is lost in this time.
cdef int64_t SILENT_NS = 100_000_000
# Conflicts with longer pauses are not one series. Chosen: an attacker who sends once a second, half of whose packets
# collide.
cdef int64_t PAUSE_NS = 5_000_000_000
# The memory of a sender that was silent for longer goes to another one. Chosen: as long as a link waits for a
# heartbeat.
cdef int64_t AWAY_NS = 10_000_000_000

cdef enum:
    MAGIC_1 = 0xFE
    MAGIC_2 = 0xFD
    PAYLOAD_1 = 6  # bytes before the payload
    PAYLOAD_2 = 10
    CHECKSUM = 2
    SIGNATURE = 13
    SIGNED = 1  # MAVLINK_IFLAG_SIGNED
    UNKNOWN = -1  # kind of a message that is not in the dialect
    TYPE = 4  # index of the byte of HEARTBEAT, the first message of the dialect, with the type of its sender
    GROUND_STATION = 6  # MAV_TYPE_GCS
    MISSING = -1
    SENDERS = 128  # whose numbers are compared: two of each of 64 vehicles, 6 KB each
    CONFLICTS = 3  # that are two senders: chance makes one, a sender's restart another
    STAMP = 8  # bytes of a telemetry log before each packet: microseconds since 1970, big-endian
    # Results where no record begins, and where its end has not come yet.
    NONE = 0
    UNDECIDED = -1

cdef struct Packet:
    int64_t start  # in the bytes of the list
    int64_t received_ns
    uint16_t size
    int16_t kind
    uint8_t payload  # bytes before it
    uint8_t length
    uint8_t sequence
    uint8_t system
    uint8_t component


cdef uint16_t _checksum(const uint8_t* data, Py_ssize_t size, uint8_t extra) noexcept nogil:
    """Return the checksum of a packet whose head and payload are ``size`` bytes; the first one is left out."""
    cdef uint16_t crc = 0xFFFF
    cdef uint8_t low
    cdef Py_ssize_t k
    for k in range(1, size + 1):
        low = (data[k] if k < size else extra) ^ <uint8_t>crc
        low ^= low << 4
        crc = (crc >> 8) ^ (<uint16_t>low << 8) ^ (<uint16_t>low << 3) ^ (low >> 4)
    return crc


def checksum(bytes packet not None, uint8_t extra):
    """Return the checksum of a packet's head and payload; ``extra`` stands for the message's definition."""
    return _checksum(<const uint8_t*>PyBytes_AS_STRING(packet), len(packet), extra)


cdef class Dialect:
    """The parts of n messages' definitions by which packets are checked.

    Parameters
    ----------
    numbers : Sequence[int]
        Ids of the messages; a message's index here is its ``kind``.
    extras : Sequence[int]
        The byte of each in the checksum.
    sizes : Sequence[int]
        Bytes of a full payload.
    """

    cdef int16_t* kinds  # by id
    cdef uint8_t* extras
    cdef uint8_t* sizes
    cdef Py_ssize_t largest
    cdef readonly Py_ssize_t count

    def __cinit__(self, numbers, extras, sizes):
        cdef Py_ssize_t k
        self.count, self.largest = len(numbers), max(numbers)
        self.kinds = <int16_t*>PyMem_Malloc((self.largest + 1) * sizeof(int16_t))
        self.extras = <uint8_t*>PyMem_Malloc(self.count)
        self.sizes = <uint8_t*>PyMem_Malloc(self.count)
        if self.kinds == NULL or self.extras == NULL or self.sizes == NULL:
            raise MemoryError
        for k in range(self.largest + 1):
            self.kinds[k] = UNKNOWN
        for k, (number, extra, size) in enumerate(zip(numbers, extras, sizes)):
            self.kinds[<Py_ssize_t>number], self.extras[k], self.sizes[k] = k, extra, size

    def __dealloc__(self):
        PyMem_Free(self.kinds)
        PyMem_Free(self.extras)
        PyMem_Free(self.sizes)


cdef class PacketList:
    """Intact packets in the order of arrival."""

    cdef Dialect dialect
    cdef Packet* rows
    cdef uint8_t* content
    cdef Py_ssize_t count, capacity, size, room

    def __cinit__(self, Dialect dialect not None):
        self.dialect = dialect

    def __dealloc__(self):
        PyMem_Free(self.rows)
        PyMem_Free(self.content)

    def __len__(self):
        return self.count

    cdef int add(self, Packet packet, const uint8_t* data) except -1:
        """Append a packet with the bytes at ``data``."""
        if self.count == self.capacity:
            self.capacity = 2 * self.capacity + 16
            self.rows = <Packet*>_resized(self.rows, self.capacity * sizeof(Packet))
        if self.size + packet.size > self.room:
            self.room = 2 * self.room + 1024
            self.content = <uint8_t*>_resized(self.content, self.room)
        packet.start = self.size
        memcpy(self.content + self.size, data, packet.size)
        self.rows[self.count] = packet
        self.size += packet.size
        self.count += 1
        return 0

    def items(self, Py_ssize_t first=0, bytes wanted=None):
        """Return time of arrival and bytes of the packets from index ``first`` on, of wanted kinds only.

        ``wanted`` has a byte for each kind, not zero where it is wanted.
        """
        cdef Packet* row
        found = []
        for k in range(first, self.count):
            row = &self.rows[k]
            if wanted is None or wanted[row.kind]:
                packet = PyBytes_FromStringAndSize(<char*>self.content + row.start, row.size)
                found.append((row.received_ns, packet))
        return found

    def keep(self, Py_ssize_t first, list admitted not None):
        """Keep, of the packets from index ``first`` on, only those that are admitted (bool)."""
        cdef Py_ssize_t k, kept = first
        for k in range(first, self.count):
            if admitted[k - first]:
                self.rows[kept] = self.rows[k]
                kept += 1
        self.count = kept

    def groups(self, bytes wanted not None):
        """Return the packets of wanted kinds by kind and sender.

        Returns
        -------
        list[tuple[int, int, int, int, int, int]]
            For each group: kind, system, component, number of packets, and where it begins in the arrays and the bytes.
        NDArray[np.int64], NDArray[np.int64]
            Index of each packet among all wanted ones, and time of arrival, group after group.
        bytes
            Payloads, group after group, each as long as in its definition: cut, or filled with zeros.
        """
        cdef Py_ssize_t k, at, group, place, index = 0
        cdef Packet* row
        cdef dict numbers = {}
        # By packet: its group. By group: number of packets, next index, next offset of a payload.
        cdef Py_ssize_t* work = <Py_ssize_t*>PyMem_Malloc(4 * (self.count + 1) * sizeof(Py_ssize_t))
        if work == NULL:
            raise MemoryError
        cdef Py_ssize_t* counts = work + self.count
        cdef Py_ssize_t* places = counts + self.count
        cdef Py_ssize_t* offsets = places + self.count
        try:
            for k in range(self.count):
                row = &self.rows[k]
                work[k] = -1
                if not wanted[row.kind]:
                    continue
                key = row.kind << 16 | row.system << 8 | row.component
                known = numbers.get(key)
                if known is None:
                    known = numbers[key] = len(numbers)
                    counts[<Py_ssize_t>known] = 0
                work[k] = known
                counts[work[k]] += 1
                index += 1
            found, at, place = [], 0, 0
            for group, key in enumerate(numbers):
                found.append((key >> 16, key >> 8 & 0xFF, key & 0xFF, counts[group], at, place))
                places[group], offsets[group] = at, place
                at += counts[group]
                place += counts[group] * self.dialect.sizes[key >> 16]
            positions, received = np.empty(index, np.int64), np.empty(index, np.int64)
            content = PyBytes_FromStringAndSize(NULL, place)
            self._fill(work, places, offsets, positions, received, <uint8_t*>PyBytes_AS_STRING(content))
            return found, positions, received, content
        finally:
            PyMem_Free(work)

    cdef int _fill(
        self, Py_ssize_t* groups, Py_ssize_t* places, Py_ssize_t* offsets, int64_t[::1] positions,
        int64_t[::1] received, uint8_t* content,
    ) except -1:
        """Write the arrays and bytes of :meth:`groups`, each group from its index and offset on."""
        cdef Py_ssize_t k, group, size, length, index = 0
        cdef Packet* row
        for k in range(self.count):
            group = groups[k]
            if group < 0:
                continue
            row = &self.rows[k]
            positions[places[group]] = index
            received[places[group]] = row.received_ns
            size = self.dialect.sizes[row.kind]
            length = min(size, <Py_ssize_t>row.length)
            memcpy(content + offsets[group], self.content + row.start + row.payload, length)
            memset(content + offsets[group] + length, 0, size - length)
            places[group] += 1
            offsets[group] += size
            index += 1
        return 0


cdef class PacketScanner:
    """Finds the intact packets in a stream of bytes that may be cut anywhere and hold anything.

    After a wrong checksum the search goes on at the next byte, so damage costs no intact packet. What is found and
    counted does not depend on how the stream is cut.

    Parameters
    ----------
    dialect : Dialect
        Definitions of the messages.
    stamped : bool
        Whether a time of arrival stands before each packet, as in telemetry logs.

    Attributes
    ----------
    intact : int
        Intact packets of known messages.
    unknown : int
        Packets of unknown messages. They cannot be checked, so where bytes were damaged just before, or no packet
        follows, they count as damage; they are left out.
    bad_checksums : int
        Packets of known messages with a wrong checksum that begin where the packet before ends.
    damaged : int
        Places where bytes that belong to no intact packet were skipped, the one at the end among them.
    skipped_bytes : int
        Those bytes.
    in_damage : bool
        Whether the last byte decided was skipped.
    waiting : int
        Bytes at the end of which it is not decided yet whether they begin a packet.
    """

    cdef readonly int64_t intact, unknown, bad_checksums, damaged, skipped_bytes
    cdef readonly bint in_damage
    cdef Dialect _dialect
    cdef Py_ssize_t _stamp, _expected
    cdef bytes _unfinished

    def __cinit__(self, Dialect dialect not None, bint stamped=False):
        self._dialect = dialect
        self._stamp = self._expected = STAMP if stamped else 0
        self._unfinished = b""

    @property
    def waiting(self):
        return len(self._unfinished)

    def scan(self, bytes data not None, PacketList packets not None, int64_t received_ns=0, bint is_end=False):
        """Take the next bytes; append the packets that they complete.

        Parameters
        ----------
        data : bytes
            The bytes.
        packets : PacketList
            Where the packets go.
        received_ns : int
            Time of arrival of these bytes, where the stream holds none.
        is_end : bool
            Whether nothing follows.
        """
        if self._unfinished:
            data = self._unfinished + data
        cdef const uint8_t* bytes_ = <const uint8_t*>PyBytes_AS_STRING(data)
        cdef Py_ssize_t end, following, size = len(data), start = self._stamp
        cdef Packet packet
        while start < size:
            end = self._find_end(bytes_, start, size, is_end, &packet)
            if end == UNDECIDED:
                break
            if end != NONE:
                if packet.kind == UNKNOWN:
                    self.unknown += 1
                else:
                    packet.received_ns = _stamp_us(bytes_ + start - STAMP) * 1_000 if self._stamp else received_ns
                    packets.add(packet, bytes_ + start)
                    self.intact += 1
                self.in_damage = False
                start = self._expected = end + self._stamp
                continue
            following = start + 1
            while following < size and bytes_[following] != MAGIC_1 and bytes_[following] != MAGIC_2:
                following += 1
            self.damaged += not self.in_damage
            self.in_damage = True
            self.skipped_bytes += following - start
            start = following
        start -= self._stamp
        self._unfinished = data[start:]
        self._expected -= start

    cdef Py_ssize_t _find_end(
        self, const uint8_t* data, Py_ssize_t start, Py_ssize_t size, bint is_end, Packet* packet
    ) noexcept:
        """Return the end of the packet at ``start``, NONE where there is none; describe the packet."""
        cdef Py_ssize_t end, missing = NONE if is_end else UNDECIDED
        cdef const uint8_t* at = data + start
        cdef bint is_2 = at[0] == MAGIC_2
        cdef Py_ssize_t number
        if not is_2 and at[0] != MAGIC_1:
            return NONE
        if start + (2 if is_2 else 1) >= size:
            return missing
        if is_2 and at[2] & ~SIGNED:
            return NONE
        packet.payload = PAYLOAD_2 if is_2 else PAYLOAD_1
        packet.length = at[1]
        packet.size = packet.payload + packet.length + CHECKSUM + (SIGNATURE if is_2 and at[2] else 0)
        end = start + packet.size
        if end > size:
            return missing
        packet.sequence = at[4 if is_2 else 2]
        packet.system = at[5 if is_2 else 3]
        packet.component = at[6 if is_2 else 4]
        number = at[7] | at[8] << 8 | at[9] << 16 if is_2 else at[5]
        packet.kind = self._dialect.kinds[number] if number <= self._dialect.largest else UNKNOWN
        if packet.kind == UNKNOWN:
            if self.in_damage:
                return NONE
            if end == size and is_end:
                return end
            if end + self._stamp >= size:
                return missing
            return end if data[end + self._stamp] == MAGIC_1 or data[end + self._stamp] == MAGIC_2 else NONE
        # Version 1 has no fields beyond the definition; version 2 may carry fields of a newer one.
        if (is_2 or packet.length <= self._dialect.sizes[packet.kind]) and not (
            self._stamp and _stamp_us(at - STAMP) >= LATEST_US
        ):
            at += packet.payload + packet.length
            if _checksum(data + start, at - data - start, self._dialect.extras[packet.kind]) == (at[0] | at[1] << 8):
                return end
            if start == self._expected:
                self.bad_checksums += 1
                self._expected = end + self._stamp
        return NONE


cdef struct Numbered:
    int64_t index  # its sequence number without wrapping
    int64_t received_ns  # MISSING where it has not come
    uint16_t checksum


cdef struct Sender:
    Py_ssize_t ids  # system and component; -1: nobody
    int64_t newest  # number of its newest packet, without wrapping
    uint8_t counted  # sequence number up to which losses are counted
    int64_t advanced  # the same at the last conflict
    int64_t received_ns
    int64_t first_ns, last_ns  # times of the first and the last conflict of the present series
    int64_t lasting, conflicts  # length of the series; number of all conflicts
    Numbered[256] packets


cdef class SequenceCounter:
    """Compares sequence numbers of each system and component: counts lost packets, and finds two senders of one id.

    Two packets with one number, neither more than a turn of 256 behind the other, are a conflict unless they are the
    same packet, which came twice. A sender that restarts makes conflicts, too, but only with its packets from before:
    three conflicts over more than 2 s come from two senders. A missing packet counts as lost until it comes, up to half
    a turn behind the newest; a gap of half a turn and more does not count. No losses are counted for ground stations:
    they number all packets that they send, of which only heartbeats are forwarded. Memory does not grow with senders:
    packets may claim any id.
    """

    cdef int64_t[::1] _lost
    cdef int64_t[::1] _told
    cdef uint8_t[256] _stations
    cdef Sender* _senders

    def __cinit__(self):
        cdef Py_ssize_t k
        self._lost = np.zeros(1 << 8, np.int64)
        self._told = np.zeros(1 << 8, np.int64)
        self._senders = <Sender*>PyMem_Calloc(SENDERS, sizeof(Sender))
        if self._senders == NULL:
            raise MemoryError
        for k in range(SENDERS):
            self._senders[k].ids = -1

    def __dealloc__(self):
        PyMem_Free(self._senders)

    def count(self, PacketList packets not None, bytes wanted=None):
        """Process the next packets.

        Parameters
        ----------
        packets : PacketList
            The packets.
        wanted : bytes | None
            A byte for each kind, not zero where it is counted in the result; None: each is.

        Returns
        -------
        list[tuple[int, int, int, int, int]]
            For packets that show two senders: number of wanted packets up to this one, time of arrival, system and
            component, and the conflicts so far.
        """
        cdef Py_ssize_t k, place = 0
        cdef Packet* row
        cdef Sender* known
        found = []
        for k in range(packets.count):
            row = &packets.rows[k]
            place += wanted is None or wanted[row.kind] != 0
            if row.kind == 0 and row.length > TYPE:
                self._stations[row.system] = packets.content[row.start + row.payload + TYPE] == GROUND_STATION
            known = self._sender(row.system << 8 | row.component, row.received_ns)
            if known != NULL and self._conflicts(known, row, packets.content + row.start + row.payload + row.length):
                found.append((place, row.received_ns, row.system, row.component, known.conflicts))
        return found

    cdef Sender* _sender(self, Py_ssize_t ids, int64_t received_ns) noexcept:
        """Return the memory of a sender, NULL where there are too many senders."""
        cdef Py_ssize_t k
        cdef Sender* oldest = self._senders
        for k in range(SENDERS):
            if self._senders[k].ids == ids:
                return self._senders + k
            if self._senders[k].received_ns < oldest.received_ns:
                oldest = self._senders + k
        if oldest.ids >= 0 and 0 <= received_ns - oldest.received_ns < AWAY_NS:
            return NULL
        memset(oldest, 0, sizeof(Sender))
        oldest.ids = ids
        return oldest

    cdef bint _conflicts(self, Sender* known, const Packet* row, const uint8_t* end) noexcept:
        """Remember a packet; return whether it shows that there are two senders."""
        cdef Numbered* before = known.packets + row.sequence
        cdef uint16_t checksum = end[0] | end[1] << 8
        cdef int64_t index, ahead, gone
        cdef bint conflict, fresh, first = known.received_ns == 0
        cdef bint silent = row.received_ns - known.received_ns >= SILENT_NS
        fresh = before.received_ns > 0 and 0 <= row.received_ns - before.received_ns < FRESH_NS
        known.received_ns = row.received_ns
        ahead = (row.sequence - known.newest) & 0xFF
        index = known.newest + (ahead if ahead < 128 or silent else ahead - 256)
        # A duplicate, over two radios for instance. One turn of numbers later one packet of 65,536 has the same
        # checksum, too, but it is the next one by number.
        if 0 <= row.received_ns - before.received_ns < HELD_NS and before.checksum == checksum and (
            before.index == index or ahead != 1
        ):
            return False
        gone = (row.sequence - known.counted) & 0xFF
        if before.received_ns == MISSING and before.index == index:
            self._lost[row.system] -= 1
        elif first or 128 <= gone < 256 - REORDERED:
            known.counted = row.sequence
        elif 0 < gone < 128:
            self._lost[row.system] += self._miss(known, index - gone + 1, index)
            known.counted = row.sequence
        known.newest = max(known.newest, index)
        # A sender that does not count up always sends one number.
        conflict = fresh and before.index == index and known.newest > known.advanced
        before.index, before.received_ns, before.checksum = index, row.received_ns, checksum
        if not conflict:
            return False
        known.conflicts += 1
        known.advanced = known.newest
        if not 0 <= row.received_ns - known.last_ns < PAUSE_NS:
            known.first_ns, known.lasting = row.received_ns, 0
        known.last_ns = row.received_ns
        known.lasting += 1
        return known.lasting >= CONFLICTS and known.last_ns - known.first_ns > FRESH_NS

    cdef int64_t _miss(self, Sender* known, int64_t start, int64_t stop) noexcept:
        """Mark the packets of a gap as missing; return their number."""
        cdef Numbered* one
        cdef int64_t index, count = 0
        for index in range(start, stop):
            one = known.packets + (index & 0xFF)
            if one.index != index:
                one.index, one.received_ns = index, MISSING
                count += 1
        return count

    def lost(self):
        """Return the lost packets by system, of vehicles that lost any; a result never decreases."""
        self._told = np.maximum(self._told, self._lost)
        return {system: lost for system, lost in enumerate(self._told) if lost and not self._stations[system]}


cdef uint64_t _stamp_us(const uint8_t* data) noexcept nogil:
    """Return the time of arrival before a packet, microseconds."""
    cdef uint64_t stamp = 0
    cdef Py_ssize_t k
    for k in range(STAMP):
        stamp = stamp << 8 | data[k]
    return stamp


cdef void* _resized(void* buffer, Py_ssize_t size) except NULL:
    cdef void* resized = PyMem_Realloc(buffer, size)
    if resized == NULL:
        raise MemoryError
    return resized
