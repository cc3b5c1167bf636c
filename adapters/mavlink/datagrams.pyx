# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Reads datagrams of a UDP socket without Python's lock, and shares memory among senders.

A sender that floods costs no other sender's packets. The kernel has one buffer for all senders to a port, so it is
emptied even while Python is busy, into memory that senders share by dynamic thresholds (Choudhury and Hahne, "Dynamic
queue length thresholds for shared-memory packet switches", 1998): a sender may hold as much as is free, so one that
floods holds half, and the others find room.
"""

from cpython.bytes cimport PyBytes_FromStringAndSize
from cpython.pythread cimport (
    PyThread_acquire_lock, PyThread_allocate_lock, PyThread_free_lock, PyThread_release_lock, PyThread_type_lock,
    WAIT_LOCK,
)
from libc.errno cimport errno
from libc.stdint cimport int64_t, uint8_t, uint32_t
from libc.stdlib cimport free, malloc, qsort
from libc.string cimport memcmp, memcpy, memset

import socket

cdef extern from * nogil:
    """
    #include <errno.h>
    #include <poll.h>
    #include <sys/socket.h>
    #include <time.h>
    #ifndef SO_TIMESTAMPNS  /* not on Linux: the time of reading is that of arrival, and drops are not told */
    #define SO_TIMESTAMPNS -1
    #endif
    #ifndef SO_RXQ_OVFL
    #define SO_RXQ_OVFL -1
    #endif
    """
    int EAGAIN, EWOULDBLOCK, EINTR, CLOCK_REALTIME, CLOCK_MONOTONIC, SO_TIMESTAMPNS, SO_RXQ_OVFL, MSG_DONTWAIT, POLLIN
    struct timespec:
        long tv_sec
        long tv_nsec
    struct iovec:
        void* iov_base
        size_t iov_len
    struct msghdr:
        void* msg_name
        unsigned int msg_namelen
        iovec* msg_iov
        size_t msg_iovlen
        void* msg_control
        size_t msg_controllen
    struct cmsghdr:
        int cmsg_type
    struct pollfd:
        int fd
        short events
    ssize_t recvmsg(int fd, msghdr* message, int flags)
    cmsghdr* CMSG_FIRSTHDR(msghdr* message)
    cmsghdr* CMSG_NXTHDR(msghdr* message, cmsghdr* header)
    unsigned char* CMSG_DATA(cmsghdr* header)
    int poll(pollfd* sources, unsigned long count, int timeout_ms)
    int clock_gettime(int clock, timespec* time)
    int nanosleep(const timespec* time, timespec* left)

cdef enum:
    LARGEST = 1 << 16  # bytes of a datagram
    ADDRESS = 28  # bytes of the address of IPv6, the larger one
    ANCILLARY = 128
    SENDERS = 64  # senders with memory of their own: four for each of 16 vehicles; all others share that of one
    OVERHEAD = 256  # bytes that a datagram counts besides its own: more than it takes here and in Python
    MEMORY = 1 << 24  # bytes; half of it holds half a second of 50,000 small datagrams a second
    AT_ONCE = 4096  # datagrams after which the lock is released during a flood
    BUSY = 128  # datagrams of one turn after which the kernel's buffer may soon be full: a quarter of Linux's usual one
# Pauses of the thread that empties the kernel's buffer while nobody reads: at first half a batch of 20 ms; during a
# flood so short that Linux's usual buffer, of some 550 small datagrams, takes 250,000 a second.
cdef long IDLE_NS = 10_000_000
cdef long BUSY_NS = 2_000_000
# A datagram that seems to have waited longer arrived before the clock was set.
cdef int64_t LONGEST_WAIT_NS = 10_000_000_000
# A datagram that has waited longer for its turn is dropped. Chosen: 3,000 packets that a link held back are read in
# twelve turns of 256, 20 ms apart; of a sender that is always behind, the present packets are wanted.
cdef int64_t OLDEST_NS = 250_000_000
# The memory of a sender that was silent for longer goes to another one, as in packets.pyx.
cdef int64_t AWAY_NS = 10_000_000_000

cdef struct Datagram:
    Datagram* following
    int64_t number, received_ns
    int64_t since_ns  # in this memory, by the monotonic clock
    uint32_t size
    unsigned int address_size
    uint8_t[ADDRESS] address
    # its bytes follow

cdef struct Sender:
    Datagram* first
    Datagram* last
    int64_t held  # bytes of memory
    int64_t seen_ns  # by the monotonic clock; 0: unused
    uint8_t system
    uint8_t[ADDRESS] address


cdef int64_t _now_ns(int clock) noexcept nogil:
    cdef timespec now
    clock_gettime(clock, &now)
    return <int64_t>now.tv_sec * 1_000_000_000 + now.tv_nsec


cdef int _by_number(const void* one, const void* other) noexcept nogil:
    cdef int64_t difference = (<Datagram**>one)[0].number - (<Datagram**>other)[0].number
    return (difference > 0) - (difference < 0)


cdef class DatagramBox:
    """Datagrams of a nonblocking socket. One thread reads, another one is in :meth:`keep` until :meth:`close`.

    Parameters
    ----------
    fd : int
        The socket's descriptor.
    most_of_one : int
        Datagrams of one sender (address and the system id that its packets bear) in one read.

    Attributes
    ----------
    dropped : int
        Datagrams for which the kernel, or the sender's share of the memory, had no room.
    """

    cdef int _fd
    cdef Py_ssize_t _most_of_one
    cdef readonly int64_t dropped
    cdef int64_t _held, _number
    cdef uint32_t _overflow
    cdef bint _closing, _waiting, _busy
    cdef PyThread_type_lock _lock
    cdef uint8_t* _buffer
    cdef Datagram** _taken
    cdef Sender[SENDERS + 1] _senders  # the last one is for all others
    cdef dict _addresses

    def __cinit__(self, int fd, Py_ssize_t most_of_one):
        self._fd, self._most_of_one = fd, most_of_one
        self._addresses = {}
        memset(self._senders, 0, sizeof(self._senders))
        self._lock = PyThread_allocate_lock()
        self._buffer = <uint8_t*>malloc(LARGEST)
        self._taken = <Datagram**>malloc((SENDERS + 1) * most_of_one * sizeof(Datagram*))
        if self._lock == NULL or self._buffer == NULL or self._taken == NULL:
            raise MemoryError

    def __dealloc__(self):
        cdef Py_ssize_t k
        cdef Datagram* one
        for k in range(SENDERS + 1):
            while self._senders[k].first != NULL:
                one = self._senders[k].first
                self._senders[k].first = one.following
                free(one)
        free(self._buffer)
        free(self._taken)
        if self._lock != NULL:
            PyThread_free_lock(self._lock)

    def keep(self):
        """Empty the kernel's buffer while nobody reads; return after :meth:`close`."""
        cdef timespec pause
        with nogil:
            while not self._closing:
                pause.tv_sec, pause.tv_nsec = 0, BUSY_NS if self._busy else IDLE_NS
                nanosleep(&pause, NULL)
                PyThread_acquire_lock(self._lock, WAIT_LOCK)
                # A reading thread reads at once.
                if not self._waiting and not self._closing:
                    self._receive()
                PyThread_release_lock(self._lock)

    def close(self):
        """End :meth:`keep` within a hundredth of a second."""
        self._closing = True

    def read(self, double timeout_s):
        """Return the datagrams that came, each sender's oldest first; wait up to a time for the first one.

        Returns
        -------
        list[tuple[address, bytes, int]]
            In the order of arrival: sender, bytes, and time of arrival in Unix nanoseconds.
        """
        cdef Py_ssize_t count
        cdef pollfd source
        source.fd, source.events = self._fd, POLLIN
        with nogil:
            PyThread_acquire_lock(self._lock, WAIT_LOCK)
            self._receive()
            count = self._take()
            if count == 0 and timeout_s > 0.0:
                self._waiting = True
                PyThread_release_lock(self._lock)
                poll(&source, 1, <int>(timeout_s * 1e3) + 1)
                PyThread_acquire_lock(self._lock, WAIT_LOCK)
                self._waiting = False
                self._receive()
                count = self._take()
            PyThread_release_lock(self._lock)
        cdef Py_ssize_t k
        cdef Datagram* one
        found = []
        for k in range(count):
            one = self._taken[k]
            data = PyBytes_FromStringAndSize(<char*>(one + 1), one.size)
            found.append((self._address(one), data, one.received_ns))
            free(one)
        return found

    cdef object _address(self, const Datagram* one):
        """Return an address in the form of the socket module."""
        cdef bytes raw = one.address[:one.address_size]
        address = self._addresses.get(raw)
        if address is None:
            if len(self._addresses) > 16 * SENDERS:
                self._addresses.clear()
            port = one.address[2] << 8 | one.address[3]
            if one.address_size == ADDRESS:
                flow, scope = int.from_bytes(raw[4:8]), (<const uint32_t*>(one.address + 24))[0]
                address = socket.inet_ntop(socket.AF_INET6, raw[8:24]), port, flow, scope
            else:
                address = socket.inet_ntop(socket.AF_INET, raw[4:8]), port
            self._addresses[raw] = address
        return address

    cdef Py_ssize_t _take(self) noexcept nogil:
        """Take the oldest datagrams of each sender, in the order of arrival; return their number."""
        cdef Py_ssize_t k, _n, count = 0
        cdef Datagram* one
        cdef int64_t oldest_ns = _now_ns(CLOCK_MONOTONIC) - OLDEST_NS
        for k in range(SENDERS + 1):
            for _n in range(self._most_of_one):
                one = self._next(self._senders + k)
                if one == NULL:
                    break
                self._taken[count] = one
                count += 1
            while self._senders[k].first != NULL and self._senders[k].first.since_ns < oldest_ns:
                free(self._next(self._senders + k))
                self.dropped += 1
        qsort(self._taken, count, sizeof(Datagram*), _by_number)
        return count

    cdef Datagram* _next(self, Sender* sender) noexcept nogil:
        """Take a sender's oldest datagram, NULL where there is none."""
        cdef Datagram* one = sender.first
        if one != NULL:
            sender.first = one.following
            sender.held -= one.size + OVERHEAD
            self._held -= one.size + OVERHEAD
        return one

    cdef void _receive(self) noexcept nogil:
        """Take all datagrams that the kernel has."""
        cdef int64_t now_ns = _now_ns(CLOCK_REALTIME), steady_ns = _now_ns(CLOCK_MONOTONIC), received_ns
        cdef Py_ssize_t count = 0
        cdef ssize_t size
        cdef uint8_t[ADDRESS] address
        cdef uint8_t[ANCILLARY] ancillary
        cdef msghdr message
        cdef iovec place
        cdef Sender* sender
        cdef Datagram* one
        place.iov_base, place.iov_len = self._buffer, LARGEST
        while count < AT_ONCE:
            memset(&message, 0, sizeof(msghdr))
            memset(address, 0, ADDRESS)
            message.msg_name, message.msg_namelen = address, ADDRESS
            message.msg_iov, message.msg_iovlen = &place, 1
            message.msg_control, message.msg_controllen = ancillary, ANCILLARY
            size = recvmsg(self._fd, &message, MSG_DONTWAIT)
            if size < 0:
                # Any error but an empty buffer belongs to an answer sent before: it is reported once, and gone.
                if errno == EAGAIN or errno == EWOULDBLOCK or count == AT_ONCE - 1:
                    break
                count += 1
                continue
            count += 1
            received_ns = self._look(&message, now_ns)
            sender = self._sender(address, self._system(size), steady_ns)
            if sender.held + size + OVERHEAD > MEMORY - self._held:
                self.dropped += 1
                continue
            one = <Datagram*>malloc(sizeof(Datagram) + size)
            if one == NULL:
                self.dropped += 1
                continue
            one.following, one.number, one.received_ns, one.size = NULL, self._number, received_ns, <uint32_t>size
            one.since_ns = steady_ns
            one.address_size = min(message.msg_namelen, <unsigned int>ADDRESS)
            memcpy(one.address, address, ADDRESS)
            memcpy(one + 1, self._buffer, size)
            self._number += 1
            if sender.first == NULL:
                sender.first = one
            else:
                sender.last.following = one
            sender.last = one
            sender.held += size + OVERHEAD
            self._held += size + OVERHEAD
        self._busy = count >= BUSY

    cdef int64_t _look(self, msghdr* message, int64_t now_ns) noexcept nogil:
        """Return the time of arrival by the kernel, and count the drops that it reports."""
        cdef cmsghdr* header = CMSG_FIRSTHDR(message)
        cdef timespec stamp
        cdef int64_t kernel_ns, received_ns = now_ns
        cdef uint32_t overflow
        while header != NULL:
            if header.cmsg_type == SO_TIMESTAMPNS:
                memcpy(&stamp, CMSG_DATA(header), sizeof(timespec))
                kernel_ns = <int64_t>stamp.tv_sec * 1_000_000_000 + stamp.tv_nsec
                # A datagram may arrive while the others are read.
                if kernel_ns - now_ns > 0 and kernel_ns - now_ns < LONGEST_WAIT_NS:
                    now_ns = _now_ns(CLOCK_REALTIME)
                    received_ns = now_ns
                if 0 <= now_ns - kernel_ns <= LONGEST_WAIT_NS:
                    received_ns = kernel_ns
            elif header.cmsg_type == SO_RXQ_OVFL:
                memcpy(&overflow, CMSG_DATA(header), sizeof(uint32_t))
                self.dropped += <uint32_t>(overflow - self._overflow)
                self._overflow = overflow
            header = CMSG_NXTHDR(message, header)
        return received_ns

    cdef uint8_t _system(self, ssize_t size) noexcept nogil:
        """Return the system id of the packet at the datagram's begin, 0 where there is none."""
        if size > 5 and self._buffer[0] == 0xFD:
            return self._buffer[5]
        return self._buffer[3] if size > 3 and self._buffer[0] == 0xFE else 0

    cdef Sender* _sender(self, const uint8_t* address, uint8_t system, int64_t steady_ns) noexcept nogil:
        cdef Py_ssize_t k
        cdef Sender* free_one = NULL
        cdef Sender* sender
        for k in range(SENDERS):
            sender = self._senders + k
            if sender.seen_ns and sender.system == system and memcmp(sender.address, address, ADDRESS) == 0:
                sender.seen_ns = steady_ns
                return sender
            if free_one == NULL and sender.first == NULL and (
                not sender.seen_ns or steady_ns - sender.seen_ns > AWAY_NS
            ):
                free_one = sender
        if free_one == NULL:
            return self._senders + SENDERS
        free_one.seen_ns, free_one.system = steady_ns, system
        memcpy(free_one.address, address, ADDRESS)
        return free_one
