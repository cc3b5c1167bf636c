"""Matrices that are affine in unknowns, and what is asked of them: inequalities written as they stand in the theory.

Unknown matrices, products of them with known ones, sums and blocks are matrices whose entries are affine in a vector of
unknowns x. ``X >> Y`` asks that X - Y is positive semidefinite, ``X <= Y`` that no entry of X exceeds that of Y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from gains.plants.plant import FloatArray


class Unknowns:
    """The unknowns of one program, and their values once it is solved."""

    def __init__(self) -> None:
        self.count = 0
        self.values: FloatArray | None = None

    def known(self, values: FloatArray) -> AffineMatrix:
        """Return a matrix without unknowns."""
        return AffineMatrix(self, values, csr_array((values.size, self.count)))

    def matrix(self, rows: int = 1, columns: int = 1) -> AffineMatrix:
        """Return an unknown matrix, without sizes an unknown number."""
        return self._placed(np.arange(rows * columns), (rows, columns))

    def symmetric(self, size: int) -> AffineMatrix:
        """Return an unknown symmetric matrix."""
        places = np.zeros((size, size), dtype=np.intp)
        places[np.triu_indices(size)] = np.arange(size * (size + 1) // 2)
        return self._placed(np.maximum(places, places.T).ravel(), (size, size))

    def diagonal(self, size: int) -> AffineMatrix:
        """Return an unknown diagonal matrix."""
        return self._placed(np.arange(size), (size, size), np.arange(size) * (size + 1))

    def _placed(self, places: Any, shape: tuple[int, int], entries: Any = None) -> AffineMatrix:
        entries = np.arange(len(places)) if entries is None else entries
        first, self.count = self.count, self.count + int(np.max(places, initial=-1)) + 1
        terms = csr_array((np.ones(len(places)), (entries, first + places)), shape=(shape[0] * shape[1], self.count))
        return AffineMatrix(self, np.zeros(shape), terms)


@dataclass(frozen=True, slots=True, eq=False)
class Constraint:
    """A matrix that is zero, whose entries are not negative, or that is positive semidefinite."""

    cone: str
    matrix: AffineMatrix


class AffineMatrix:
    """A matrix constant + sum of x_k times known matrices; products and sums with arrays and numbers are such ones.

    ``terms`` (entries, unknowns) holds, for each entry row by row, what the unknowns add to it.
    """

    __array_ufunc__ = None  # NumPy's arrays leave products and sums to this class

    def __init__(self, unknowns: Unknowns, constant: FloatArray, terms: Any) -> None:
        self.unknowns, self.constant, self.terms = unknowns, constant, terms
        self.shape: tuple[int, int] = constant.shape

    @property
    def value(self) -> Any:
        """The matrix at the solution, NaN where there is none."""
        x = self.unknowns.values
        if x is None:
            return np.full(self.shape, np.nan)
        return self.constant + (self.terms @ x[: self.terms.shape[1]]).reshape(self.shape)

    @property
    def number(self) -> float:
        """The value of a number (1, 1)."""
        return float(self.value[0, 0])

    @property
    def T(self) -> AffineMatrix:
        """The transposed matrix."""
        order = np.arange(self.constant.size).reshape(self.shape).T.ravel()
        return AffineMatrix(self.unknowns, self.constant.T, self.terms[order])

    def __getitem__(self, rows: slice) -> AffineMatrix:
        order = np.arange(self.constant.size).reshape(self.shape)[rows].ravel()
        return AffineMatrix(self.unknowns, self.constant[rows], self.terms[order])

    def __add__(self, other: Any) -> AffineMatrix:
        if not isinstance(other, AffineMatrix):
            return AffineMatrix(self.unknowns, self.constant + other, self.terms)
        terms, others = widened(self.terms, other.terms, self.unknowns)
        return AffineMatrix(self.unknowns, self.constant + other.constant, terms + others)

    def __mul__(self, other: Any) -> AffineMatrix:
        """Return the product with a number, or of a number (1, 1) with an array."""
        if np.ndim(other) == 0:
            return AffineMatrix(self.unknowns, self.constant * other, self.terms * float(other))
        return AffineMatrix(self.unknowns, self.constant * other, csr_array(other.reshape(-1, 1)) @ self.terms)

    def __rmatmul__(self, other: Any) -> AffineMatrix:
        rows, columns = len(other), self.shape[1]
        terms = self.terms.tocoo()
        row, column = np.divmod(terms.coords[0], columns)
        made = other[:, row] * terms.data
        entries = np.arange(rows)[:, None] * columns + column
        unknowns = np.broadcast_to(terms.coords[1], made.shape)
        kept = made != 0.0
        shape = (rows * columns, terms.shape[1])
        product = csr_array((made[kept], (entries[kept], unknowns[kept])), shape=shape)
        return AffineMatrix(self.unknowns, other @ self.constant, product)

    def __matmul__(self, other: Any) -> AffineMatrix:
        return self.T.__rmatmul__(other.T).T

    def __neg__(self) -> AffineMatrix:
        return self * -1.0

    def __sub__(self, other: Any) -> AffineMatrix:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> AffineMatrix:
        return (-self).__add__(other)

    def __truediv__(self, other: float) -> AffineMatrix:
        return self * (1.0 / other)

    __radd__, __rmul__ = __add__, __mul__

    def __rshift__(self, other: Any) -> Constraint:
        return Constraint("PSDTriangle", self - other)

    def __lshift__(self, other: Any) -> Constraint:
        return Constraint("PSDTriangle", other - self)

    def __ge__(self, other: Any) -> Constraint:
        return Constraint("Nonnegative", self - other)

    def __le__(self, other: Any) -> Constraint:
        return Constraint("Nonnegative", other - self)


def zero(matrix: AffineMatrix) -> Constraint:
    """Return the constraint that every entry is zero."""
    return Constraint("Zero", matrix)


def within(matrix: AffineMatrix, bound: float) -> tuple[Constraint, Constraint]:
    """Return the constraints that no entry is larger than a bound by size."""
    return matrix <= bound, matrix >= -bound


def trace(matrix: AffineMatrix) -> AffineMatrix:
    """Return the sum of a square matrix's diagonal (1, 1)."""
    size = len(matrix.constant)
    terms = matrix.terms[np.arange(size) * (size + 1)].sum(axis=0)
    return AffineMatrix(matrix.unknowns, np.trace(matrix.constant).reshape(1, 1), csr_array(terms.reshape(1, -1)))


def block(rows: Sequence[Sequence[Any]]) -> Any:
    """Return a matrix of blocks, affine ones and arrays; without an affine one an array."""
    found = next((part for row in rows for part in row if isinstance(part, AffineMatrix)), None)
    constant = np.block([[part.constant if isinstance(part, AffineMatrix) else part for part in row] for row in rows])
    if found is None:
        return constant
    data, entries, unknowns, top = [], [], [], 0
    for row in rows:
        left = 0
        for part in row:
            if isinstance(part, AffineMatrix):
                terms = part.terms.tocoo()
                i, j = np.divmod(terms.coords[0], part.shape[1])
                data.append(terms.data)
                entries.append((top + i) * constant.shape[1] + left + j)
                unknowns.append(terms.coords[1])
            left += part.shape[1]
        top += row[0].shape[0]
    places = (np.concatenate(entries), np.concatenate(unknowns))
    shape = (constant.size, found.unknowns.count)
    return AffineMatrix(found.unknowns, constant, csr_array((np.concatenate(data), places), shape=shape))


def widened(terms: Any, others: Any, unknowns: Unknowns) -> tuple[Any, Any]:
    """Return both for all unknowns there are by now."""
    for matrix in (terms, others):
        matrix.resize((matrix.shape[0], unknowns.count))
    return terms, others
