"""ROS 2 message definitions: the text of .msg files -> fields and their types, found in folders by the type's name."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from adapters.errors import TelemetryError

SHIPPED = Path(__file__).parent.parent / "definitions"

MAX_DEFINITION_CHARACTERS = 1 << 20
"""Longest definition, characters. Chosen: definitions of ROS 2, including all types they use, have some thousands."""

_PRIMITIVES = {
    *("bool", "byte", "char", "float32", "float64", "string", "wstring"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
"""Primitive types of ROS 2's interface definition language."""
_NAME = r"[A-Za-z][A-Za-z0-9_]*"
_TYPE = re.compile(rf"({_NAME}(?:/{_NAME})*)(?:<=\d{{1,9}})?(?:\[(<=)?(\d{{0,9}})\])?", re.ASCII)
_FIELD = re.compile(_NAME, re.ASCII)
_TYPE_NAME = re.compile(rf"({_NAME})(?:/|::)(?:msg(?:/|::))?(?:dds_::)?({_NAME}?)(_?)", re.ASCII)
_SEPARATOR = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)
_STAMP = "int32 sec\nuint32 nanosec"


@dataclass(frozen=True, slots=True)
class MessageField:
    """One field of a message: its type is primitive (``"float64"``) or a message as ``"package/Name"``.

    A fixed-size array has a ``size``. A sequence, which is preceded by its length, may be bounded by ``at_most``.
    """

    name: str
    type: str
    size: int | None = None
    sequence: bool = False
    at_most: int | None = None

    @property
    def primitive(self) -> bool:
        """Whether the type is primitive."""
        return self.type in _PRIMITIVES


Definitions = Mapping[str, Sequence[MessageField]]


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


def parse_definitions(name: str, text: str) -> Definitions:
    """Return the fields of a type, and of those it uses, in their order by type (``"package/Name"``).

    The text is that of .msg files as ROS 2 writes it into MCAP files: further types follow a line of ``===`` and a line
    ``MSG: package/Name``. Time and Duration of builtin_interfaces are built in.

    Raises
    ------
    TelemetryError
        The text is not such a definition, or :func:`canonical_type` cannot read the name.
    """
    if len(text) > MAX_DEFINITION_CHARACTERS:
        raise TelemetryError(f"definition of {name}: longer than {MAX_DEFINITION_CHARACTERS} characters")
    definitions: dict[str, Sequence[MessageField]] = {}
    for kind in ("builtin_interfaces/Time", "builtin_interfaces/Duration"):
        definitions[kind] = tuple(_fields(kind, _STAMP))
    here = canonical_type(name)
    for part in _SEPARATOR.split(text):
        body = part.strip()
        if body.startswith("MSG:"):
            head, _, body = body.partition("\n")
            here = canonical_type(head.removeprefix("MSG:").strip())
        definitions[here] = tuple(_fields(here, body))
    return definitions


def find_definition(name: str, folders: Sequence[Path]) -> str:
    """Return the definition of a type, with those of all types it uses, from .msg files.

    Each folder, then :data:`SHIPPED`, may hold ``package/msg/Name.msg``, ``package/Name.msg``, ``msg/Name.msg`` or
    ``Name.msg``; the first one found is used.

    Raises
    ------
    TelemetryError
        A type is defined nowhere, or its file is not a definition.
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
        try:
            wanted += [field.type for field in _fields(kind, texts[kind]) if not field.primitive]
        except TelemetryError as error:
            raise TelemetryError(f"{path}: {error}") from error
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


def _fields(kind: str, text: str) -> Iterator[MessageField]:
    """Read the fields of one .msg text; constants, defaults and comments are ignored."""
    names: set[str] = set()
    for line in text.splitlines():
        words = line.partition("#")[0].split(maxsplit=2)
        if not words or _is_constant(words):
            continue
        match = _TYPE.fullmatch(words[0])
        if not match or len(words) < 2 or not _FIELD.fullmatch(words[1]) or words[1] in names:
            raise TelemetryError(f"definition of {kind}: '{line.strip()[:60]}' is no field")
        names.add(words[1])
        yield _field(kind, words[1], match)


def _is_constant(words: Sequence[str]) -> bool:
    """Return whether a line is ``type NAME = value``, with or without blanks; a default has no sign before it."""
    return len(words) > 1 and ("=" in words[1] or (words[-1].startswith("=") and len(words) == 3))


def _field(kind: str, name: str, match: re.Match[str]) -> MessageField:
    type_name, bounded, count = match[1], match[2], match[3]
    if type_name not in _PRIMITIVES:
        type_name = canonical_type(type_name if "/" in type_name else f"{kind.partition('/')[0]}/{type_name}")
    if count is None:
        return MessageField(name, type_name)
    if bounded and count:
        return MessageField(name, type_name, sequence=True, at_most=int(count))
    if not count:
        return MessageField(name, type_name, sequence=True)
    if not int(count):
        # Such an array does not exist; elements of no bytes could be claimed without end.
        raise TelemetryError(f"definition of {kind}: '{name}' is an array of no elements")
    return MessageField(name, type_name, size=int(count))
