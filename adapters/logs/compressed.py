"""Reads files plain or compressed (.xz, .gz), piece by piece, up to the last byte before any damage."""

import lzma
import zlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO

from adapters.errors import TelemetryError

COMPRESSED = (".xz", ".gz")
_PIECE_BYTES = 1 << 16
"""Bytes of a piece. Chosen: small for memory and cache, and thousands a second are read."""
# A decompressor that finds damage loses what it has decompressed of the piece: pieces are kept small.
_COMPRESSED_BYTES = 128
_AUTO_GZIP = 31
# Memory limit of the decompressor, bytes: `xz -9` needs 65 MB; a damaged header may ask for 4 GB.
_DECOMPRESSOR_BYTES = 1 << 28

ON_BYTES: ContextVar[Callable[[int], None] | None] = ContextVar("ON_BYTES", default=None)
"""Callback for the number of bytes read from files, before decompression: progress bars set it.

It is a variable of the context, because the readers of all kinds of recordings are between them and the files.
"""


class CompressedFile:
    """The bytes of a file, decompressed from ``.xz`` and ``.gz``; ``damaged`` if the compressed data broke off.

    Iterate over it once. Concatenated streams are read as one; damage ends the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.damaged = False

    def __iter__(self) -> Iterator[bytes]:
        """Return the file's bytes in pieces.

        Raises
        ------
        TelemetryError
            The file cannot be opened.
        """
        try:
            file = self._path.open("rb")
        except OSError as error:
            raise TelemetryError(f"{self._path}: cannot be opened: {error.strerror}") from error
        with file:
            if self._path.suffix.lower() not in COMPRESSED:
                while piece := _read(file, _PIECE_BYTES):
                    yield piece
                return
            piece = b""
            for data in self._decompressed(file):
                piece += data
                if len(piece) >= _PIECE_BYTES:
                    yield piece
                    piece = b""
            if piece:
                yield piece

    def _decompressed(self, file: BinaryIO) -> Iterator[bytes]:
        stream: Any = None
        try:
            while piece := _read(file, _COMPRESSED_BYTES):
                while piece:
                    stream = stream or (
                        lzma.LZMADecompressor(memlimit=_DECOMPRESSOR_BYTES)
                        if self._path.suffix.lower() == ".xz"
                        else zlib.decompressobj(_AUTO_GZIP)
                    )
                    yield stream.decompress(piece)
                    piece = b""
                    if stream.eof:
                        # Streams may be padded with zeros to a multiple of four bytes.
                        piece, stream = stream.unused_data.lstrip(b"\0"), None
        except (lzma.LZMAError, zlib.error):
            self.damaged = True
        else:
            self.damaged = stream is not None


def _read(file: BinaryIO, count: int) -> bytes:
    piece = file.read(count)
    on_bytes = ON_BYTES.get()
    if on_bytes is not None:
        on_bytes(len(piece))
    return piece


class Window:
    """The bytes of a file from a position on, at least as many as were requested, plain or decompressed.

    It reads ``read_ahead_bytes`` ahead whenever it has to read. ``data`` is the part of the file that is held, another
    object after each read; ``at`` is the position, as an index of ``data``, which the reader advances.
    """

    def __init__(self, path: Path, read_ahead_bytes: int) -> None:
        self._source = CompressedFile(path)
        self._pieces = iter(self._source)
        self._read_ahead_bytes = read_ahead_bytes
        self._dropped = 0
        self._ended = False
        self.data = b""
        self.at = 0

    def fill(self, count: int) -> bool:
        """Hold at least ``count`` bytes from the position on; return whether the file has as many."""
        if self.left >= count or self._ended:
            return self.left >= count
        pieces = [self.data[self.at :]]
        missing = max(count, self._read_ahead_bytes) - len(pieces[0])
        while missing > 0 and (piece := next(self._pieces, None)) is not None:
            pieces.append(piece)
            missing -= len(piece)
        self._dropped += self.at
        self._ended = missing > 0
        self.data, self.at = b"".join(pieces), 0
        return self.left >= count

    @property
    def offset(self) -> int:
        """The position as a number of bytes from the start of the (decompressed) file."""
        return self._dropped + self.at

    def index(self, offset: int) -> int:
        """Return a position of the file as an index of ``data``."""
        return offset - self._dropped

    @property
    def left(self) -> int:
        """Number of bytes that are held from the position on."""
        return len(self.data) - self.at

    @property
    def cut(self) -> bool:
        """Whether the compressed data was damaged in the part that was read."""
        return self._source.damaged
