"""The compiled modules of the package, as ``pyproject.toml`` cannot list them by a pattern."""

from pathlib import Path

from setuptools import Extension, setup

CORE = sorted(path for package in ("adapters", "monitor") for path in Path(package).rglob("*.pyx"))

setup(
    ext_modules=[
        Extension(
            ".".join(path.with_suffix("").parts),
            [str(path)],
            # No contraction of a * b + c: the same bits on every processor.
            extra_compile_args=["-O2", "-ffp-contract=off"],
        )
        for path in CORE
    ]
)
