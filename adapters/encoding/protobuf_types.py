"""Protobuf message classes built at run time from lists of fields, without protobuf's compiler."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from adapters.encoding.record import Schema

ProtobufScalar = Literal["bool", "double", "float", "int32", "uint32", "int64", "uint64", "string"]
TIMESTAMP: Final = "google.protobuf.Timestamp"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message class to build: a scalar, a time or the fields of a nested message, one or a list of them.

    The name is a protobuf identifier (see :func:`identifiers`). An optional field may be absent, which is not zero.
    """

    name: str
    kind: ProtobufScalar | Literal["google.protobuf.Timestamp"] | tuple[Field, ...]
    repeated: bool = False
    optional: bool = False


def message_class(package: str, name: str, fields: Sequence[Field]) -> Any:
    """Return the protobuf class of a message with these fields, numbered from 1 in their order.

    Each class lives in a descriptor pool of its own, so that classes of equal names never collide.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{package.replace('.', '/')}/{name}.proto", package=package, syntax="proto3"
    )
    pool = descriptor_pool.DescriptorPool()
    if any(field.kind == TIMESTAMP for field in fields):
        pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
        file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    _describe(file.message_type.add(name=name), f".{package}.{name}", fields)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}"))


def _describe(proto: Any, full_name: str, fields: Sequence[Field]) -> None:
    """Write the fields into a DescriptorProto, nested messages as types of their own inside it."""
    for number, field in enumerate(fields, start=1):
        entry = proto.field.add(name=field.name, number=number)
        entry.label = FieldDescriptorProto.LABEL_REPEATED if field.repeated else FieldDescriptorProto.LABEL_OPTIONAL
        if isinstance(field.kind, tuple):
            nested = "".join(word.capitalize() for word in field.name.split("_"))
            entry.type = FieldDescriptorProto.TYPE_MESSAGE
            entry.type_name = f"{full_name}.{nested}"
            _describe(proto.nested_type.add(name=nested), entry.type_name, field.kind)
        elif field.kind == TIMESTAMP:
            entry.type = FieldDescriptorProto.TYPE_MESSAGE
            entry.type_name = f".{TIMESTAMP}"
        else:
            entry.type = FieldDescriptorProto.Type.Value(f"TYPE_{field.kind.upper()}")
        if field.optional:
            # proto3 expresses presence as a union of one, named with a leading underscore
            proto.oneof_decl.add(name=f"_{field.name}")
            entry.oneof_index = len(proto.oneof_decl) - 1
            entry.proto3_optional = True


@functools.lru_cache(maxsize=4096)
def protobuf_schema(pb_class: Any) -> Schema:
    """Return the schema of a topic of such records: the FileDescriptorSet of the class and of all it depends on."""
    files = descriptor_pb2.FileDescriptorSet()
    for file in (*pb_class.DESCRIPTOR.file.dependencies, pb_class.DESCRIPTOR.file):
        file.CopyToProto(files.file.add())
    return Schema(str(pb_class.DESCRIPTOR.full_name), "protobuf", bytes(files.SerializeToString(deterministic=True)))


def class_from_schema(schema: Schema) -> Any:
    """Return the protobuf class that a recording's schema describes.

    Raises
    ------
    ValueError
        The schema is not a FileDescriptorSet or lacks the message.
    """
    pool = descriptor_pool.DescriptorPool()
    try:
        for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (KeyError, TypeError, message.Error) as error:
        raise ValueError(f"schema of {schema.name} cannot be used: {error}") from error


@functools.lru_cache(maxsize=4096)
def identifiers(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return a distinct protobuf identifier for each name, the name itself if it is one.

    Other characters become underscores. Names that would be equal, also in the lower camel case that protobuf derives
    for JSON, are distinguished by trailing numbers.
    """
    taken: set[str] = set()
    chosen = []
    for name in names:
        plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name) or "_"
        plain = f"_{plain}" if plain[0].isdigit() else plain
        candidate, number = plain, 2
        while _json_name(candidate) in taken:
            candidate, number = f"{plain}_v{number}", number + 1
        taken.add(_json_name(candidate))
        chosen.append(candidate)
    return tuple(chosen)


def _json_name(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word[:1].upper() + word[1:] for word in others)
