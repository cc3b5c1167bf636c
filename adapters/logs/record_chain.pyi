from collections.abc import Callable
from typing import TypeVar

Kind = TypeVar("Kind")
Head = tuple[int, Kind | None]

def follow(
    data: bytes,
    at: int,
    end: int,
    head_bytes: int,
    heads: dict[bytes, Head[Kind]],
    find: Callable[[bytes], Head[Kind] | None],
    start: list[int],
    kind: list[Kind | None],
) -> tuple[int, int]: ...
