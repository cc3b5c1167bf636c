# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""The messages of a batch that matter to a vehicle's pipeline, in the order of arrival, and the extent of a segment.

A segment is processed at once: a message, and the following ones that only bring measurements.
"""

from bisect import bisect_left
from copy import copy
from typing import NamedTuple

import numpy as np

from adapters.batch import Batch, Columns, each
from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import Message
from monitor.alarms.command_watch import COMMANDS, commanded_systems
from monitor.sampling.phase import FlightPhase

from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.stdint cimport int64_t

cdef enum:
    # Marks of a message: it carries a channel; an autopilot's heartbeat; it begins a segment.
    CARRIES = 1
    HEARTBEAT = 2
    BEGINS = 4

cdef struct Arrival:
    int64_t received
    int owner
    char marks


cdef class Arrivals:
    """The messages that matter, with what is known of each.

    Parameters
    ----------
    batch : Batch
        Messages of any sender.
    names : Collection[str]
        Names of the messages that matter.
    wanted : Collection[str]
        Those among them that carry a channel.
    system, component : int
        MAVLink ids of the vehicle; component 0: any.
    phase : FlightPhase
        The flight phase before the batch.
    streams : StreamFilter
        Leaves out repeated commands of streams.

    Attributes
    ----------
    batch : Batch
        The messages that matter, numbered anew.
    foreign : int
        Messages of other senders.
    """

    cdef readonly object batch
    cdef readonly Py_ssize_t foreign
    cdef Py_ssize_t _count
    cdef Arrival* _arrivals
    cdef list _owners
    # Messages that tell the flight phase or command the vehicle, by their indices, and these indices in order.
    cdef dict _reports
    cdef list _reported

    def __init__(self, batch, names, wanted, int system, int component, phase, streams):
        cdef Py_ssize_t count = batch.count, i, kept = 0
        self.batch, self._count = batch, count
        self._owners, self._reports, self._reported = [], {}, []
        self._arrivals = <Arrival*>PyMem_Calloc(count + 1, sizeof(Arrival))
        if self._arrivals == NULL:
            raise MemoryError
        for i in range(count):
            self._arrivals[i].owner = -1
        for columns in batch.columns:
            if _commands(columns, system):
                columns = streams.rows(columns, system)
                if len(columns.position):
                    self._add_columns(columns, 0, BEGINS)
            elif not _is_of(columns, system, component):
                self.foreign += len(columns.position)
            elif columns.name in names:
                self._add_columns(columns, columns.name in wanted, 0)
        for i, message in batch.others.items():
            if _commands(message, system):
                if streams.passes(message, system):
                    self._add(i, message.received_ns, 0)
                    self._owners.append(message)
                    self._arrivals[i].marks |= BEGINS
            elif not _is_of(message, system, component):
                self.foreign += 1
            elif message.name in names:
                self._add(i, message.received_ns, message.name in wanted)
                self._owners.append(message)
                if not message.source.is_telemetry:
                    self._arrivals[i].marks |= BEGINS
                elif message.name in FlightPhase.interests:
                    self._reports[i] = message
        self._mark_reports(phase)
        for i in range(count):
            kept += self._arrivals[i].owner >= 0
        if kept < count:
            self._close_up(kept)

    def __dealloc__(self):
        PyMem_Free(self._arrivals)

    def __len__(self):
        return self._count

    cdef int _add(self, Py_ssize_t i, int64_t received, bint carries) except -1:
        if not 0 <= i < self._count:
            raise IndexError("a message lies outside of its batch")
        self._arrivals[i] = Arrival(received, <int>len(self._owners), CARRIES if carries else 0)
        return 0

    cdef int _add_columns(self, columns, bint carries, char marks) except -1:
        cdef const int64_t[:] position = columns.position, received = columns.received_ns
        cdef Py_ssize_t row, i
        for row in range(position.shape[0]):
            i = position[row]
            self._add(i, received[row], carries)
            self._arrivals[i].marks |= marks
        if marks or columns.name in FlightPhase.interests:
            read = FlightPhase.fields.get(columns.name)
            self._reports.update(zip(columns.position.tolist(), each(columns, read)))
        self._owners.append(columns)
        return 0

    cdef int _mark_reports(self, phase) except -1:
        """Mark heartbeats, and the messages that change the flight phase."""
        if not self._reports:
            return 0
        follower = copy(phase)
        state = follower.state
        self._reported = sorted(self._reports)
        for i in self._reported:
            message = self._reports[i]
            if is_autopilot_heartbeat(message):
                self._arrivals[<Py_ssize_t>i].marks |= HEARTBEAT
            follower.feed(message)
            before, state = state, follower.state
            if state != before:
                self._arrivals[<Py_ssize_t>i].marks |= BEGINS
        return 0

    cdef int _close_up(self, Py_ssize_t kept) except -1:
        """Number the messages that matter consecutively."""
        cdef Py_ssize_t i, k = 0, first = 0
        cdef Py_ssize_t[::1] ends
        cdef int64_t[::1] places
        position, others, reports = np.empty(kept, np.int64), {}, {}
        ends, places = np.zeros(len(self._owners) + 1, np.intp), position
        for i in range(self._count):
            if self._arrivals[i].owner >= 0:
                ends[self._arrivals[i].owner + 1] += 1
        for i in range(ends.shape[0] - 1):
            ends[i + 1] += ends[i]
        for i in range(self._count):
            if self._arrivals[i].owner < 0:
                continue
            places[ends[self._arrivals[i].owner]] = k
            ends[self._arrivals[i].owner] += 1
            if i in self._reports:
                reports[k] = self._reports[i]
            self._arrivals[k] = self._arrivals[i]
            k += 1
        columns = []
        for i, owner in enumerate(self._owners):
            if isinstance(owner, Columns):
                here = position[first : ends[i]]
                ids = owner.system, owner.component
                columns.append(Columns(owner.source, owner.name, *ids, here, owner.received_ns, owner.fields))
            else:
                others[int(places[first])] = owner
            first = ends[i]
        self._count, self._reports, self._reported = kept, reports, list(reports)
        self.batch = Batch(kept, tuple(columns), others)
        return 0

    def message(self, Py_ssize_t i):
        """Return a message; one of columns has its fields only if it is a report on the flight phase or a command."""
        cdef Arrival* arrival = self._arrivals + i
        owner = self._owners[arrival.owner]
        if isinstance(owner, Message):
            return owner
        report = self._reports.get(i)
        if report is None:
            return Message(owner.source, owner.name, arrival.received, {}, owner.system, owner.component)
        return report

    def reports(self, Py_ssize_t start, Py_ssize_t stop):
        """Return the reports on the flight phase among the messages start <= i < stop, in order."""
        first, end = bisect_left(self._reported, start), bisect_left(self._reported, stop)
        return [self._reports[i] for i in self._reported[first:end]]

    def received_ns(self, Py_ssize_t i):
        """Return when a message arrived."""
        return self._arrivals[i].received

    def segment(
        self,
        Py_ssize_t start,
        bint processed,
        int64_t due_ns,
        carried_ns,
        int64_t silent_ns,
        int64_t heartbeat_ns,
        int64_t without_heartbeat_ns,
        bint awaits_heartbeat,
        int64_t set_back_ns,
        Py_ssize_t most,
    ):
        """Return the extent of the segment that a message begins, or of its part in this batch.

        It ends before the next message that does more than bring measurements, because of its kind, its time, or the
        silence before it.

        Parameters
        ----------
        start : int
            Index of its first message in this batch.
        processed : bool
            Whether this one begins it, and was processed already.
        due_ns : int
            Time from which a message does more.
        carried_ns : int | None
            When a channel was carried last; None: each message does more.
        silent_ns : int
            Time without a channel after which a message does more.
        heartbeat_ns, without_heartbeat_ns : int
            When the last heartbeat came (0: none), and the time without one after which a message does more.
        awaits_heartbeat : bool
            Whether a heartbeat does more.
        set_back_ns : int
            How much earlier a message shows that the clock was set back.
        most : int
            Index of the first message that it may not contain.
        """
        cdef int64_t carried = 0 if carried_ns is None else carried_ns
        cdef Py_ssize_t stop = start + processed
        cdef Py_ssize_t carrier = start if processed and self._arrivals[start].marks & CARRIES else -1
        cdef Arrival* arrival
        while carried_ns is not None and stop < min(most, self._count):
            arrival = self._arrivals + stop
            if arrival.marks & BEGINS or arrival.received >= due_ns or arrival.received - carried >= silent_ns:
                break
            if awaits_heartbeat:
                if arrival.marks & HEARTBEAT:
                    break
            elif arrival.marks & HEARTBEAT:
                heartbeat_ns = arrival.received
            elif heartbeat_ns and arrival.received - heartbeat_ns >= without_heartbeat_ns:
                break
            if arrival.marks & CARRIES:
                if arrival.received > carried or carried - arrival.received >= set_back_ns:
                    carried = arrival.received
                carrier = stop
            stop += 1
        return Segment(stop, carried, carrier, heartbeat_ns)


class Segment(NamedTuple):
    """The extent of a segment, and what is known at its end.

    Parameters
    ----------
    stop : int
        Index of the first message after it.
    carried_ns : int
        When a channel was carried last.
    carrier : int
        Index of the last message that carries one; -1 where none of the segment does.
    heartbeat_ns : int
        When the last heartbeat came; 0: none.
    """

    stop: int
    carried_ns: int
    carrier: int
    heartbeat_ns: int


cdef bint _is_of(entry, int system, int component):
    """Return whether a message (or columns) comes from the vehicle."""
    source = entry.source
    if not source.has_ids:
        return True
    if entry.system != system:
        return False
    return not source.is_telemetry or component in (0, entry.component)


cdef bint _commands(entry, int system):
    """Return whether a message (or one of columns) commands the vehicle."""
    targets = commanded_systems(entry) if entry.name in COMMANDS else ()
    return bool(targets) and (0 in targets or system in targets)
