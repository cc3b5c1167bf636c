"""Compressed files are read to the last byte before the damage."""

from __future__ import annotations

import gzip
import lzma
import random
from functools import cache
from pathlib import Path

import pytest

from adapters.errors import TelemetryError
from adapters.logs.compressed import CompressedFile

NOISE = random.Random(1).randbytes(160_000)
CONTENT = b"".join(bytes(4) + NOISE[at : at + 8] for at in range(0, len(NOISE), 8))
PACKERS = {suffix: cache(packer) for suffix, packer in ((".xz", lzma.compress), (".gz", gzip.compress), ("", bytes))}


def read(path: Path) -> tuple[bytes, bool]:
    file = CompressedFile(path)
    return b"".join(file), file.damaged


@pytest.mark.parametrize("suffix", PACKERS)
def test_content_comes_out_as_it_went_in(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.tlog{suffix}"
    path.write_bytes(PACKERS[suffix](CONTENT))
    assert read(path) == (CONTENT, False)


@pytest.mark.parametrize("suffix", [".xz", ".gz"])
def test_streams_one_behind_the_other_are_one_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(PACKERS[suffix](CONTENT) + PACKERS[suffix](b"more") + bytes(4))
    assert read(path) == (CONTENT + b"more", False)


@pytest.mark.parametrize("suffix", [".xz", ".gz"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_truncated_file_gives_what_is_there(tmp_path: Path, suffix: str, share: float) -> None:
    packed = PACKERS[suffix](CONTENT)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(packed[: int(share * len(packed))])
    content, damaged = read(path)
    assert CONTENT.startswith(content)
    assert len(content) >= (share - 0.1) * len(CONTENT)
    assert damaged == (share > 0.0)


@pytest.mark.parametrize("suffix", [".xz", ".gz"])
def test_a_file_that_is_not_compressed_at_all_is_damaged(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"plain text, not what the name says")
    assert read(path) == (b"", True)


def test_a_file_that_is_not_there_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match=r"nothing.tlog: cannot be opened: No such file"):
        read(tmp_path / "nothing.tlog")
    with pytest.raises(TelemetryError, match="directory"):
        read(tmp_path)


def test_a_head_that_asks_for_all_memory_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.xz"
    alone = lzma.compress(CONTENT, format=lzma.FORMAT_ALONE)
    path.write_bytes(alone[:1] + b"\xff\xff\xff\xff" + alone[5:])
    assert read(path) == (b"", True)
