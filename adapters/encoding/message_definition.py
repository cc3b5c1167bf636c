"""ROS 2 message definitions: names of types, and the .msg files of a type and of all types it uses."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from adapters.errors import TelemetryError

SHIPPED = Path(__file__).parent.parent / "definitions"

_PRIMITIVES = {
    *("bool", "byte", "char", "float32", "float64", "string", "wstring"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
"""Primitive types of ROS 2's interface definition language."""
_NAME = r"[A-Za-z][A-Za-z0-9_]*"
_TYPE_NAME = re.compile(rf"({_NAME})(?:/|::)(?:msg(?:/|::))?(?:dds_::)?({_NAME}?)(_?)", re.ASCII)


def canonical_type(name: str) -> str:
    """Return a type's name as ``"package/Name"``.

    ``sensor_msgs/msg/Imu``, ``sensor_msgs/Imu``, ``sensor_msgs::msg::Imu`` and ``sensor_msgs::msg::dds_::Imu_`` are
    the same type.

    Raises
    ------
    TelemetryError
        It is not the name of a message type.
    """
    match = _TYPE_NAME.fullmatch(name)
    if not match or not match[2] or bool(match[3]) != ("::dds_::" in name):
        raise TelemetryError(f"'{name}' is not a message type; write it like sensor_msgs/msg/Imu")
    return f"{match[1]}/{match[2]}"


def find_definition(name: str, folders: Sequence[Path]) -> str:
    """Return the definition of a type, with those of all types it uses, from .msg files.

    Each folder, then :data:`SHIPPED`, may hold ``package/msg/Name.msg``, ``package/Name.msg``, ``msg/Name.msg`` or
    ``Name.msg``; the first one found is used.

    Raises
    ------
    TelemetryError
        A type is defined nowhere, or its file cannot be read.
    """
    texts: dict[str, str] = {}
    wanted = [canonical_type(name)]
    while wanted:
        kind = wanted.pop()
        if kind in texts:
            continue
        path = _definition_file(kind, [*folders, SHIPPED])
        try:
            texts[kind] = path.read_text(errors="replace")
        except OSError as error:
            raise TelemetryError(f"{path}: cannot be read: {error.strerror}") from error
        wanted += _used_types(kind, texts[kind])
    first, *others = texts.items()
    return first[1] + "".join(f"\n{'=' * 80}\nMSG: {kind}\n{text}" for kind, text in others)


def _definition_file(kind: str, folders: Sequence[Path]) -> Path:
    package, _, name = kind.partition("/")
    for folder in folders:
        for place in (folder / package / "msg", folder / package, folder / "msg", folder):
            path = place / f"{name}.msg"
            if path.is_file():
                return path
    where = ", ".join(map(str, folders[:-1])) or "what is shipped"
    raise TelemetryError(f"no definition of {kind} in {where}; put {name}.msg into a folder of definitions and name it")


def _used_types(kind: str, text: str) -> Iterator[str]:
    """Return the types of a definition's fields that are messages themselves."""
    for line in text.splitlines():
        name = re.split(r"[#\[<\s]", line.strip(), maxsplit=1)[0]
        if name and name not in _PRIMITIVES:
            yield canonical_type(name if "/" in name else f"{kind.partition('/')[0]}/{name}")
