"""Reads files plain or compressed (.xz, .gz), piece by piece, up to the last byte before any damage."""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO

from adapters.errors import TelemetryError

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
            if self._path.suffix.lower() not in (".xz", ".gz"):
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
                    stream = stream or self._decompressor()
                    yield stream.decompress(piece)
                    piece = b""
                    if stream.eof:
                        # Streams may be padded with zeros to a multiple of four bytes.
                        piece, stream = stream.unused_data.lstrip(b"\0"), None
        except (lzma.LZMAError, zlib.error):
            self.damaged = True
        else:
            self.damaged = stream is not None

    def _decompressor(self) -> Any:
        if self._path.suffix.lower() == ".xz":
            return lzma.LZMADecompressor(memlimit=_DECOMPRESSOR_BYTES)
        return zlib.decompressobj(_AUTO_GZIP)


def _read(file: BinaryIO, count: int) -> bytes:
    piece = file.read(count)
    on_bytes = ON_BYTES.get()
    if on_bytes is not None:
        on_bytes(len(piece))
    return piece
