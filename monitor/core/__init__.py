"""The compiled core: rules that process rows in order, each written once, in Cython, for one row and for many.

Each module here is the only form of its rules. Floating-point arithmetic is that of IEEE 754 as written, without
contraction and without reordering, so results do not depend on how a stream is cut into batches.
"""
