# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Protobuf messages of one type from columns of numbers: one message per row.

The bytes are those that protobuf's own serializer writes, as the tests check; it takes a dictionary of Python objects
per message, which costs about ten times as much. The wire format: https://protobuf.dev/programming-guides/encoding
"""

from cpython.buffer cimport PyBUF_FORMAT, PyBUF_STRIDES, Py_buffer, PyBuffer_Release, PyObject_GetBuffer
from cpython.bytes cimport PyBytes_FromStringAndSize
from cpython.mem cimport PyMem_Free, PyMem_Malloc
from libc.stdint cimport int64_t, uint32_t, uint64_t
from libc.string cimport memcpy, memmove

# By type of field, as numbered in google/protobuf/descriptor.proto: wire type, formats of columns (those of the module
# struct), largest value (of integers), whether negative ones are allowed.
_TYPES = {
    1: (1, b"df", 0, True),
    2: (5, b"df", 0, True),
    3: (0, b"bBhHiIlLqQ", 2**63 - 1, True),
    4: (0, b"bBhHiIlLqQ", 2**64 - 1, False),
    5: (0, b"bBhHiIlLqQ", 2**31 - 1, True),
    8: (0, b"?", 1, False),
    13: (0, b"bBhHiIlLqQ", 2**32 - 1, False),
}

# Wire types, and the most bytes that a varint takes.
cdef enum:
    VARINT = 0
    FIXED_64 = 1
    LENGTH = 2
    FIXED_32 = 5
    LONGEST_VARINT = 10

cdef struct Number:
    int wire
    uint32_t tag
    uint64_t largest
    int is_signed

cdef struct FieldPlan:
    # Rows hold one number (neither flag), a list of numbers, or a message of count numbers.
    int is_message
    int is_repeated
    uint32_t tag
    Py_ssize_t first
    Py_ssize_t count

cdef struct Column:
    # Value (row, k) is at data + row * row_stride + k * stride, of size bytes.
    const char* data
    Py_ssize_t row_stride
    Py_ssize_t stride
    Py_ssize_t width
    Py_ssize_t size
    char format
    int64_t constant


cdef class RowEncoder:
    """Encodes rows of numbers as messages of one protobuf type (proto3).

    Parameters
    ----------
    pb_class : type
        Protobuf class. Its fields are numbers, lists of numbers, or messages of numbers.

    Attributes
    ----------
    names : tuple[str, ...]
        Names of the fields in the order of their numbers: the order of the columns of :meth:`encode`.

    Raises
    ------
    ValueError
        The type has fields of another kind, or fields that distinguish absence from zero.
    """

    cdef readonly tuple names
    cdef FieldPlan* _fields
    cdef Number* _numbers
    cdef Py_ssize_t _count
    cdef tuple _formats

    def __cinit__(self, pb_class):
        fields = sorted(pb_class.DESCRIPTOR.fields, key=lambda field: field.number)
        self.names = tuple(field.name for field in fields)
        plans, numbers = [], []
        for field in fields:
            nested = field.message_type
            if nested is None:
                inner = [field]
            elif field.is_repeated:
                raise ValueError(f"{field.full_name} is repeated")
            else:
                inner = sorted(nested.fields, key=lambda part: part.number)
                if any(part.is_repeated or part.message_type is not None for part in inner):
                    raise ValueError(f"{field.full_name} has fields that are no plain numbers")
            plans.append((nested is not None, field.is_repeated, field.number, len(numbers), len(inner)))
            for part in inner:
                if part.type not in _TYPES or part.has_presence:
                    raise ValueError(f"{part.full_name} is no plain number")
                numbers.append((part.type, part.number))
        self._count = len(plans)
        self._fields = <FieldPlan*>PyMem_Malloc(max(1, len(plans)) * sizeof(FieldPlan))
        self._numbers = <Number*>PyMem_Malloc(max(1, len(numbers)) * sizeof(Number))
        if self._fields == NULL or self._numbers == NULL:
            raise MemoryError
        for k, (is_message, is_repeated, number, first, count) in enumerate(plans):
            self._fields[k] = FieldPlan(is_message, is_repeated, number << 3 | LENGTH, first, count)
        self._formats = tuple(_TYPES[kind][1] for kind, _ in numbers)
        for k, (kind, number) in enumerate(numbers):
            wire, _, largest, is_signed = _TYPES[kind]
            self._numbers[k] = Number(wire, number << 3 | wire, largest, is_signed)

    def __dealloc__(self):
        PyMem_Free(self._fields)
        PyMem_Free(self._numbers)

    def encode(self, columns, Py_ssize_t count):
        """Return ``count`` messages as a list of bytes.

        Parameters
        ----------
        columns : Sequence
            One entry per field, in the order of ``names``: of a number an array (count,), or an int that holds for
            all rows; of a list or a message of k numbers an array (count, k).
        count : int
            Number of rows.

        Raises
        ------
        ValueError
            A column has another shape or kind than its field, or a value out of the field's range.
        """
        if len(columns) != self._count:
            raise ValueError("the columns are not those of the type")
        cdef Py_ssize_t k, row, held = 0, capacity = 16
        cdef Py_buffer* buffers = <Py_buffer*>PyMem_Malloc(max(1, self._count) * sizeof(Py_buffer))
        cdef Column* plan = <Column*>PyMem_Malloc(max(1, self._count) * sizeof(Column))
        cdef char* start = NULL
        cdef char* end
        try:
            if buffers == NULL or plan == NULL:
                raise MemoryError
            for k in range(self._count):
                column = columns[k]
                if isinstance(column, int):
                    plan[k].constant = column
                    plan[k].data = <const char*>&plan[k].constant
                    plan[k].row_stride = plan[k].stride = 0
                    plan[k].width, plan[k].size, plan[k].format = 1, 8, b"q"
                    has_width = False
                else:
                    PyObject_GetBuffer(column, &buffers[held], PyBUF_STRIDES | PyBUF_FORMAT)
                    held += 1
                    _open(&plan[k], &buffers[held - 1])
                    has_width = buffers[held - 1].ndim == 2
                    if not 1 <= buffers[held - 1].ndim <= 2 or buffers[held - 1].shape[0] != count:
                        raise ValueError(f"{self.names[k]} is of another shape than its field")
                self._check(k, &plan[k], has_width)
                capacity += (plan[k].width + 1) * (LONGEST_VARINT + 5)
            start = <char*>PyMem_Malloc(capacity)
            if start == NULL:
                raise MemoryError
            messages = []
            for row in range(count):
                end = start
                for k in range(self._count):
                    end = self._write(end, k, &plan[k], row)
                messages.append(PyBytes_FromStringAndSize(start, end - start))
            return messages
        finally:
            PyMem_Free(start)
            for k in range(held):
                PyBuffer_Release(&buffers[k])
            PyMem_Free(plan)
            PyMem_Free(buffers)

    cdef int _check(self, Py_ssize_t k, const Column* column, bint has_width) except -1:
        """Raise if a column cannot hold the values of its field."""
        cdef const FieldPlan* field = &self._fields[k]
        cdef Py_ssize_t j
        if has_width != (field.is_message or field.is_repeated) or (field.is_message and column.width != field.count):
            raise ValueError(f"{self.names[k]} is of another shape than its field")
        for j in range(field.first, field.first + field.count):
            if column.format == 0 or column.format not in <bytes>self._formats[j]:
                raise ValueError(f"{self.names[k]} is of another kind than its field")
        return 0

    cdef char* _write(self, char* at, Py_ssize_t k, const Column* column, Py_ssize_t row) except NULL:
        """Write a field of a row; return the end."""
        cdef const FieldPlan* field = &self._fields[k]
        cdef const Number* number = &self._numbers[field.first]
        cdef const char* value = column.data + row * column.row_stride
        cdef Py_ssize_t j
        cdef char* body
        if not field.is_message and not field.is_repeated:
            return self._write_number(at, k, number, column, value, 1)
        if field.is_repeated and column.width == 0:
            return at
        at = _varint(at, field.tag)
        # the length is known, and written, after the body
        body = at + LONGEST_VARINT
        end = body
        for j in range(column.width):
            if field.is_message:
                end = self._write_number(end, k, &number[j], column, value + j * column.stride, 1)
            else:
                end = self._write_number(end, k, number, column, value + j * column.stride, 0)
        at = _varint(at, end - body)
        memmove(at, body, end - body)
        return at + (end - body)

    cdef char* _write_number(
        self, char* at, Py_ssize_t k, const Number* number, const Column* column, const char* value, bint tagged
    ) except NULL:
        """Write a number; a tagged one that is zero (plus zero where it has a sign) is left out."""
        cdef double wide
        cdef float narrow
        cdef int64_t whole
        cdef uint64_t bits = 0
        cdef int spare
        # Copied, as values need not be aligned; the machine is little-endian, as protobuf is.
        memcpy(&bits, value, column.size)
        if number.wire == VARINT:
            if column.format in b"bhilq":
                spare = 64 - 8 * column.size
                whole = <int64_t>(bits << spare) >> spare
                bits = <uint64_t>whole
                if whole < 0 and number.is_signed:
                    whole = -(whole + 1)
                in_range = 0 <= whole and <uint64_t>whole <= number.largest
            else:
                in_range = bits <= number.largest
            if not in_range:
                raise ValueError(f"{self.names[k]} is out of its field's range")
        elif column.format == b"f" and number.wire == FIXED_64:
            memcpy(&narrow, &bits, 4)
            wide = narrow
            memcpy(&bits, &wide, 8)
        elif column.format == b"d" and number.wire == FIXED_32:
            memcpy(&wide, &bits, 8)
            narrow = <float>wide
            bits = 0
            memcpy(&bits, &narrow, 4)
        if tagged:
            if bits == 0:
                return at
            at = _varint(at, number.tag)
        if number.wire == VARINT:
            return _varint(at, bits)
        memcpy(at, &bits, 8 if number.wire == FIXED_64 else 4)
        return at + (8 if number.wire == FIXED_64 else 4)


cdef int _open(Column* column, const Py_buffer* view) noexcept:
    """Set where the values of an array are."""
    # "=" stands before the format of numbers that are not aligned; formats of several letters ("Zd", ">d") are refused
    cdef int at = view.format[0] == b"="
    column.data = <const char*>view.buf
    column.row_stride = view.strides[0] if view.ndim else 0
    column.stride = view.strides[1] if view.ndim > 1 else 0
    column.width = view.shape[1] if view.ndim > 1 else 1
    column.size = view.itemsize
    column.format = view.format[at] if view.format[at + 1] == 0 else 0
    return 0


cdef char* _varint(char* at, uint64_t bits) noexcept:
    """Write a number seven bits a byte, the lowest first; all but the last byte have the highest bit set."""
    while bits > 0x7F:
        at[0] = <char>(bits & 0x7F | 0x80)
        bits >>= 7
        at += 1
    at[0] = <char>bits
    return at + 1
