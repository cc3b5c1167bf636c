# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Protobuf messages of one type from columns of numbers: one message per row.

The bytes are those that protobuf's own serializer writes, as the tests check; it takes a dictionary of Python objects
per message, which costs about ten times as much. The wire format: https://protobuf.dev/programming-guides/encoding
"""

from cpython.buffer cimport PyBUF_FORMAT, PyBUF_STRIDES, Py_buffer, PyBuffer_Release, PyObject_GetBuffer
from cpython.bytes cimport PyBytes_FromStringAndSize
from cpython.mem cimport PyMem_Free, PyMem_Malloc
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memcpy, memmove

# Types of fields, as numbered in google/protobuf/descriptor.proto.
cdef enum:
    DOUBLE = 1
    FLOAT = 2
    INT64 = 3
    UINT64 = 4
    INT32 = 5
    BOOL = 8
    UINT32 = 13

# Wire types.
cdef enum:
    VARINT = 0
    FIXED_64 = 1
    LENGTH = 2
    FIXED_32 = 5

cdef enum:
    LONGEST_VARINT = 10

cdef struct Number:
    int type
    uint32_t tag

cdef struct FieldPlan:
    # Rows hold one number (is_message and is_repeated both 0), a list of them, or a message of count numbers.
    int is_message
    int is_repeated
    uint32_t tag
    Py_ssize_t first
    Py_ssize_t count

cdef struct Column:
    # Where a column's values are: value (row, k) at data + row * row_stride + k * stride.
    const char* data
    Py_ssize_t row_stride
    Py_ssize_t stride
    Py_ssize_t width
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
    cdef Py_ssize_t _inner

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
                if part.type not in (DOUBLE, FLOAT, INT64, UINT64, INT32, BOOL, UINT32) or part.has_presence:
                    raise ValueError(f"{part.full_name} is no plain number")
                numbers.append((part.type, part.number))
        self._count = len(plans)
        self._fields = <FieldPlan*>PyMem_Malloc(max(1, len(plans)) * sizeof(FieldPlan))
        self._numbers = <Number*>PyMem_Malloc(max(1, len(numbers)) * sizeof(Number))
        if self._fields == NULL or self._numbers == NULL:
            raise MemoryError
        for k, (is_message, is_repeated, number, first, count) in enumerate(plans):
            self._fields[k] = FieldPlan(is_message, is_repeated, number << 3 | LENGTH, first, count)
        for k, (kind, number) in enumerate(numbers):
            wire = FIXED_64 if kind == DOUBLE else FIXED_32 if kind == FLOAT else VARINT
            self._numbers[k] = Number(kind, number << 3 | wire)

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
                    plan[k].format = b"q"
                    plan[k].data = <const char*>&plan[k].constant
                    plan[k].row_stride = plan[k].stride = 0
                    plan[k].width = 1
                    self._check(k, &plan[k], 1)
                else:
                    PyObject_GetBuffer(column, &buffers[held], PyBUF_STRIDES | PyBUF_FORMAT)
                    held += 1
                    self._open(k, &buffers[held - 1], &plan[k], count)
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

    cdef int _open(self, Py_ssize_t k, Py_buffer* view, Column* column, Py_ssize_t count) except -1:
        """Set where the values of an array are."""
        cdef int has_width = self._fields[k].is_message or self._fields[k].is_repeated
        if view.ndim != 1 + has_width or view.shape[0] != count:
            raise ValueError(f"{self.names[k]} is of another shape than its field")
        column.data = <const char*>view.buf
        column.row_stride = view.strides[0]
        column.stride = view.strides[1] if has_width else 0
        column.width = view.shape[1] if has_width else 1
        # "=" stands before the format of numbers that are not aligned, as columns of packed records are
        column.format = view.format[view.format[0] == b"="]
        # formats of several letters ("Zd", ">d") are refused
        if view.format[1 + (view.format[0] == b"=")] != 0:
            column.format = 0
        if self._fields[k].is_message and column.width != self._fields[k].count:
            raise ValueError(f"{self.names[k]} is of another shape than its field")
        self._check(k, column, 0)
        return 0

    cdef int _check(self, Py_ssize_t k, Column* column, int is_constant) except -1:
        """Raise where a column cannot hold the values of its field."""
        cdef Py_ssize_t j
        cdef int kind
        if is_constant and (self._fields[k].is_message or self._fields[k].is_repeated):
            raise ValueError(f"{self.names[k]} is of another shape than its field")
        for j in range(self._fields[k].first, self._fields[k].first + self._fields[k].count):
            kind = self._numbers[j].type
            if kind == DOUBLE or kind == FLOAT:
                fits = column.format in b"df"
            elif kind == BOOL:
                fits = column.format == b"?"
            else:
                fits = column.format != 0 and column.format in b"bBhHiIlLqQ"
            if not fits:
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
            return self._write_number(at, k, number, column.format, value, 1)
        if field.is_repeated and column.width == 0:
            return at
        at = _varint(at, field.tag)
        # the length is known, and written, after the body
        body = at + LONGEST_VARINT
        end = body
        for j in range(column.width):
            if field.is_message:
                end = self._write_number(end, k, &number[j], column.format, value + j * column.stride, 1)
            else:
                end = self._write_number(end, k, number, column.format, value + j * column.stride, 0)
        at = _varint(at, end - body)
        memmove(at, body, end - body)
        return at + (end - body)

    cdef char* _write_number(
        self, char* at, Py_ssize_t k, const Number* number, char format, const char* value, int tagged
    ) except NULL:
        """Write a number; a tagged one that is zero (plus zero where it has a sign) is left out."""
        cdef double wide
        cdef float narrow
        cdef uint64_t bits = 0
        cdef uint32_t short_bits = 0
        if number.type == DOUBLE or number.type == FLOAT:
            if number.type == FLOAT:
                if format == b"f":
                    memcpy(&short_bits, value, 4)
                else:
                    memcpy(&wide, value, 8)
                    narrow = <float>wide
                    memcpy(&short_bits, &narrow, 4)
                if tagged:
                    if short_bits == 0:
                        return at
                    at = _varint(at, number.tag)
                memcpy(at, &short_bits, 4)
                return at + 4
            if format == b"f":
                memcpy(&narrow, value, 4)
                wide = narrow
                memcpy(&bits, &wide, 8)
            else:
                memcpy(&bits, value, 8)
            if tagged:
                if bits == 0:
                    return at
                at = _varint(at, number.tag)
            memcpy(at, &bits, 8)
            return at + 8
        cdef int is_negative = 0
        bits = _integer(format, value, &is_negative)
        if (
            (is_negative and (number.type == UINT32 or number.type == UINT64))
            or (number.type == INT64 and not is_negative and bits >> 63)
            or (number.type == UINT32 and bits >> 32)
            or (number.type == INT32 and (<int64_t>bits > 2147483647 or <int64_t>bits < -2147483648 or
                                          (not is_negative and bits >> 63)))
        ):
            raise ValueError(f"{self.names[k]} is out of its field's range")
        if tagged:
            if bits == 0:
                return at
            at = _varint(at, number.tag)
        return _varint(at, bits)


cdef char* _varint(char* at, uint64_t bits) noexcept:
    """Write a number seven bits a byte, the lowest first; all but the last byte have the highest bit set."""
    while bits > 0x7F:
        at[0] = <char>(bits & 0x7F | 0x80)
        bits >>= 7
        at += 1
    at[0] = <char>bits
    return at + 1


cdef uint64_t _integer(char format, const char* value, int* is_negative) noexcept:
    """Return an integer's bits, those of a negative one as two's complement of 64 bits."""
    # Copied, as they need not be aligned.
    cdef int8_t tiny
    cdef int16_t short_number
    cdef int32_t number
    cdef uint16_t short_bits
    cdef uint32_t word
    cdef uint64_t bits
    cdef int64_t whole
    if format == b"?" or format == b"B":
        return (<const uint8_t*>value)[0]
    if format == b"H":
        memcpy(&short_bits, value, 2)
        return short_bits
    if format == b"I":
        memcpy(&word, value, 4)
        return word
    if format == b"L" or format == b"Q":
        memcpy(&bits, value, 8)
        return bits
    if format == b"b":
        memcpy(&tiny, value, 1)
        whole = tiny
    elif format == b"h":
        memcpy(&short_number, value, 2)
        whole = short_number
    elif format == b"i":
        memcpy(&number, value, 4)
        whole = number
    else:
        memcpy(&whole, value, 8)
    is_negative[0] = whole < 0
    return <uint64_t>whole
