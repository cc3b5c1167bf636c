"""Solutions of inequalities, kept in files by all that goes into them: each is solved once in a run of the suite."""

import hashlib
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from gains.synthesis.bounded_real import Inequality, Solution, solve_bounded_real

Solve = Callable[[Inequality, tuple[float, float] | None], tuple[Solution | None, float]]


def kept_solutions(folder: Path) -> Solve:
    """Return the solver of inequalities, which looks into a folder first; where it finds one, that is its time."""

    def solved(problem: Inequality, fixed: tuple[float, float] | None = None) -> tuple[Solution | None, float]:
        started = time.perf_counter()
        # the name of the plant is for errors, which are not kept
        kept = folder / f"{digest(asdict(replace(problem, name='')), fixed)}.npz"
        if kept.exists():
            with np.load(kept, allow_pickle=False) as fields:
                found: dict[str, Any] = {name: value if value.ndim else float(value) for name, value in fields.items()}
            return Solution(**found), time.perf_counter() - started
        solution, seconds = solve_bounded_real(problem, fixed)
        if solution is not None:
            partial = kept.with_suffix(f".{os.getpid()}.npz")
            with suppress(OSError):  # a test of full disks lets no file grow
                np.savez(partial, **asdict(solution))
                partial.replace(kept)
        return solution, seconds

    return solved


def digest(*values: Any) -> str:
    """Return SHA-256 (hex) over numbers, texts and arrays, in tables and lists of any depth, each with its type."""
    content = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, Mapping):
            for key, part in value.items():
                content.update(f"{key}:".encode())
                add(part)
        elif isinstance(value, tuple | list):
            content.update(f"{len(value)}:".encode())
            for part in value:
                add(part)
        elif isinstance(value, np.ndarray):
            content.update(f"{value.dtype}{value.shape}:".encode())
            content.update(value.tobytes())
        else:
            content.update(f"{value!r};".encode())

    add(values)
    return content.hexdigest()
