# cython: language_level=3, boundscheck=False, wraparound=False
"""Where the records of an onboard log begin: each says by its first bytes how long it is."""


def follow(bytes data, Py_ssize_t at, Py_ssize_t end, Py_ssize_t head_bytes, dict heads, find, list start, list kind):
    """Append the begin of the fields, and the kind, of each wanted record; return the last record's end, and how many.

    The first record begins at ``at``. ``heads`` holds the length and kind (None: not wanted) of a record by its first
    ``head_bytes``; ``find`` returns those that it lacks, and None at the chain's end. The chain also ends before a
    record that reaches beyond ``end``.
    """
    cdef const char* first = data
    cdef Py_ssize_t behind, count = 0
    while True:
        head = first[at : min(at + head_bytes, len(data))]
        known = heads.get(head)
        if known is None:
            known = find(head)
            if known is None:
                break
            heads[head] = known
        behind = at + <Py_ssize_t>(<tuple?>known)[0]
        if behind > end:
            break
        count += 1
        wanted = (<tuple>known)[1]
        if wanted is not None:
            start.append(at + head_bytes)
            kind.append(wanted)
        at = behind
    return at, count
