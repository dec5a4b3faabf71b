"""Types of ROS 2: definitions, hashes, and the encoding of messages (CDR). Pure.

`rosbags` knows the common types of each distribution and does the encoding. The folders
`interfaces/common` and `interfaces/DISTRIBUTION` add types that it lacks, as
`package/msg/Name.msg`, `package/srv/Name.srv` and `package/action/Name.action`. A robot's own
folders have the same layout.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

from rosbags.interfaces import Nodetype
from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rampart.files.reading import read_text

Distribution = Literal["humble", "iron", "jazzy", "kilted", "lyrical", "rolling"]

DISTRIBUTIONS: Final = {"humble": Stores.ROS2_HUMBLE, "iron": Stores.ROS2_IRON,
                        "jazzy": Stores.ROS2_JAZZY, "kilted": Stores.ROS2_KILTED,
                        "lyrical": Stores.ROS2_LYRICAL, "rolling": Stores.ROS2_LYRICAL}
"""Distributions of ROS 2 with `rmw_zenoh`; Rolling has the types of the newest."""

SHIPPED = Path(__file__).with_name("interfaces")

NO_HASH = "TypeHashNotSupported"
"""Stands in place of a type's hash on Humble."""

MOST_BYTES = 8 << 20
"""Longest message that is decoded."""

_MOST_TEXT = 1_000_000
"""Longest file of definitions, bytes."""

_LITTLE, _BIG = b"\0\1", b"\0\0"
_HEADER_BYTES = 4
_UNHASHED = ("humble",)

_UNREADABLE = (SerdeError, struct.error, ValueError, TypeError, AttributeError, IndexError,
               AssertionError, OverflowError, MemoryError)
"""Raised by `rosbags` for bytes that do not decode and values that do not fit; from fuzzing."""

_EMPTY = [("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))]
_UNSUPPORTED = ("wstring", "float128", "wchar")
_BOUND = re.compile(r"\bwstring<=\d+")
_PARTS = {"srv": ("_Request", "_Response"), "action": ("_Goal", "_Result", "_Feedback")}
_QUATERNION = "geometry_msgs/msg/Quaternion"
_UUID = "unique_identifier_msgs/msg/UUID"

Fields = list[tuple[str, Any]]


class Types:
    """The types of a distribution and of a robot.

    Args:
        distribution: one of `DISTRIBUTIONS`.
        folders: with a robot's definitions, which replace shipped ones.

    Attributes:
        left_out: type of a folder that cannot be used → the reason, one line.

    Raises:
        ValueError: the distribution or a folder does not exist, or a file does not parse; one line
            with the name of the file.
    """

    def __init__(self, distribution: str, folders: Iterable[Path] = ()) -> None:
        if distribution not in DISTRIBUTIONS:
            raise ValueError(f"distribution = {distribution!r}: unknown; known: "
                             f"{', '.join(DISTRIBUTIONS)}")
        self.distribution = distribution
        self._store = get_typestore(DISTRIBUTIONS[distribution])
        self._described = Typestore()  # for hashes
        for name, (constants, fields) in self._store.fielddefs.items():
            self._described.fielddefs[name] = constants, _read_as_uint8(fields, "char")
            self._store.fielddefs[name] = constants, _read_as_uint8(fields, "char", "byte")
        self._hashes: dict[str, str] = {}
        self._services: set[str] = set()
        self._actions: set[str] = set()
        self._replaced: list[str] = []
        self.left_out: dict[str, str] = {}
        for folder in (SHIPPED / "common", SHIPPED / distribution):
            self._read(folder)
        for folder in folders:
            if not self._read(folder):
                raise ValueError(f"interfaces: {folder}: no package/msg/Name.msg in it")

    @cached_property
    def known(self) -> frozenset[str]:
        """Names of all messages, services and actions."""
        return frozenset((*self._store.fielddefs, *self._services, *self._actions))

    @property
    def notes(self) -> dict[str, str]:
        """Types that the folders replace or leave out → one line about it."""
        replaces = f"its definition replaces the one of {self.distribution}"
        return dict.fromkeys(self._replaced, replaces) | {
            name: f"left out: {why}" for name, why in self.left_out.items()}

    def fields(self, name: str) -> Fields:
        """Return the fields of a message, each with its type as `rosbags` describes it.

        Raises:
            ValueError: the type is not known.
        """
        return [(field, what) for field, what in self._definition(name) if field != _EMPTY[0][0]]

    def hash(self, name: str) -> str:
        """Return the hash of a type (REP-2016), as it is in keys.

        Raises:
            ValueError: the type is not known.
        """
        if self.distribution in _UNHASHED:
            return NO_HASH
        if name not in self._hashes:
            self._definition(name)
            self._hashes[name] = self._described.hash_rihs01(name)
        return self._hashes[name]

    def blank(self, name: str) -> Any:
        """Return a message with default values: fields are 0, empty or false, w of a rotation 1."""
        if name == _QUATERNION:
            return self._store.types[name](x=0.0, y=0.0, z=0.0, w=1.0)
        fields = {field: self._blank_field(what) for field, what in self._definition(name)}
        return self._store.types[name](**fields)

    @staticmethod
    def numbers(values: Sequence[float], kind: str = "float32") -> Any:
        """Return numbers as an array for a message."""
        import numpy as np  # noqa: PLC0415 with the first message

        return np.asarray(values, np.dtype(kind))

    def like(self, name: str, value: Any) -> Any:
        """Return a message with the attributes of a value as its fields, others by default."""
        made = self.blank(name)
        for field, what in self._definition(name):
            if hasattr(value, field):
                setattr(made, field, self.field_like(what, getattr(value, field)))
        return made

    def field_like(self, what: Any, value: Any) -> Any:
        """Return a value in the form of a field, whose type is as in `fields`."""
        import numpy as np  # noqa: PLC0415 with the first message

        kind, detail = what
        if kind == Nodetype.NAME:
            return self.like(detail, value)
        if kind == Nodetype.BASE:
            return value
        inner, of = detail[0]
        if inner == Nodetype.BASE and of[0] != "string":
            return np.asarray(value, np.dtype(_NUMPY[of[0]]))
        return [self.field_like(detail[0], one) for one in value]

    def _blank_field(self, what: Any) -> Any:
        import numpy as np  # noqa: PLC0415 with the first message

        kind, detail = what
        if kind == Nodetype.NAME:
            return self.blank(detail)
        if kind == Nodetype.BASE:
            return _ZERO[detail[0]]
        (inner, of), count = detail
        if inner == Nodetype.BASE and of[0] != "string":
            return np.zeros(count if kind == Nodetype.ARRAY else 0, np.dtype(_NUMPY[of[0]]))
        return [self._blank_field((inner, of)) for _ in range(count)
                ] if kind == Nodetype.ARRAY else []

    def encode(self, name: str, message: Any) -> bytes:
        """Return the encoded message.

        Raises:
            ValueError: a value does not fit its field; one line.
        """
        try:
            return bytes(self._store.serialize_cdr(message, name, little_endian=True))
        except _UNREADABLE as error:
            raise ValueError(f"{name}: {_line(error)}") from None

    def decode(self, name: str, data: bytes) -> Any:
        """Return the decoded message; raises as the function of `decoder`."""
        return self.decoder(name)(data)

    def decoder(self, name: str) -> Callable[[bytes], Any]:
        """Return a function that decodes messages of one type, or raises ValueError; one line.

        Raises:
            ValueError: the type is not known.
        """
        self._definition(name)
        try:
            definition = self._store.get_msgdef(name)
        except Exception as error:  # a library's code generator; what it raises is not documented
            raise ValueError(f"{name}: {_line(error)}") from None
        kind, store = definition.cls, self._store
        ways = {_LITTLE: definition.deserialize_cdr_le, _BIG: definition.deserialize_cdr_be}

        def decode(data: bytes) -> Any:
            way = ways.get(data[:2])
            if way is None or len(data) < _HEADER_BYTES:
                raise ValueError(f"{name}: begins with {data[:4].hex(' ') or 'nothing'}; expected "
                                 "CDR, which begins with 00 01 00 00")
            if len(data) > MOST_BYTES:
                raise ValueError(f"{name}: {len(data)} bytes; expected at most {MOST_BYTES}")
            try:
                message, end = way(memoryview(data)[_HEADER_BYTES:], 0, kind, store)
            except _UNREADABLE as error:
                raise ValueError(f"{name}: cannot decode {len(data)} bytes: "
                                 f"{_line(error)}") from None
            few = end - (len(data) - _HEADER_BYTES)
            if few > 0:  # ROS 2 ignores a tail
                raise ValueError(f"{name}: {few} bytes too few")
            return message

        return decode

    # -- definitions ------------------------------------------------------------------------------

    def _definition(self, name: str) -> Fields:
        try:
            return self._store.fielddefs[name][1]
        except KeyError:
            if name in self.left_out:
                raise ValueError(f"type {name!r}: {self.left_out[name]}") from None
            raise ValueError(f"type {name!r} is not known to {self.distribution}; to add it, put a "
                             f"file {name}."
                             f"{name.split('/')[1] if name.count('/') == 2 else 'msg'} into a "
                             "folder of the gateway's interfaces") from None

    def _read(self, folder: Path) -> bool:
        """Add the definitions in a folder; return whether there are any."""
        if not folder.is_dir():
            raise ValueError(f"interfaces: {folder}: no such folder")
        found = [file for kind in ("msg", "srv", "action")
                 for file in sorted(folder.glob(f"*/{kind}/*.{kind}"))]
        definitions: dict[str, Any] = {}
        for file in found:
            package, kind, name = file.parts[-3], file.parts[-2], file.stem
            try:
                text = "\n".join(read_text(file, _MOST_TEXT).splitlines())  # as ROS 2 reads it
                definitions |= self._parsed(f"{package}/{kind}/{name}", kind, text)
            except (ValueError, OSError) as error:
                raise ValueError(f"{file}: {_line(error)}") from None
        unusable = self._unusable(definitions)
        self.left_out |= unusable
        for names in (self._services, self._actions):
            names.difference_update(unusable)
        try:
            self._add({name: made for name, made in definitions.items() if name not in unusable})
        except ValueError as error:
            raise ValueError(f"{folder}: {error}") from None
        return bool(found)

    def _unusable(self, definitions: Mapping[str, tuple[Any, Fields]]) -> dict[str, str]:
        """Return the definitions with a part that cannot be used, each with the reason."""
        known = self._store.fielddefs.keys() - definitions.keys()
        rest = {name: _parts(fields) for name, (_, fields) in definitions.items()}
        while ready := [name for name, parts in rest.items() if known.issuperset(parts)]:
            known |= set(ready)
            for name in ready:
                del rest[name]
        found = {}
        for name, parts in rest.items():
            part = next(part for part in parts if part not in known)
            what = part.rpartition("/")[2]
            found[name] = f"{name} has a {what}, which is not supported" if (
                what in _UNSUPPORTED) else f"{name}: type {part!r} " + (
                "is left out, too" if part in rest else "is not known")
        return found

    def _add(self, definitions: Mapping[str, tuple[Any, Fields]]) -> None:
        for name, (_, fields) in definitions.items():
            if name in self._store.fielddefs:
                if self._store.fielddefs[name][1] != _read_as_uint8(fields, "char", "byte"):
                    self._replaced.append(name)
                del self._store.fielddefs[name], self._store.types[name]
        self._described.fielddefs |= {
            name: (made, _read_as_uint8(fields, "char"))
            for name, (made, fields) in definitions.items()}
        try:
            self._store.register({name: (made, _read_as_uint8(fields, "char", "byte"))
                                  for name, (made, fields) in definitions.items()})
        except TypesysError as error:
            raise ValueError(_line(error)) from None

    def _parsed(self, name: str, kind: str, text: str) -> dict[str, Any]:
        if kind == "msg":
            return {name: ([], self._fields(name, text) or _EMPTY)}
        parts = [""]
        for line in text.split("\n"):
            if line.strip().startswith("---"):
                parts.append("")
            else:
                parts[-1] += line + "\n"
        names = _PARTS[kind]
        if len(parts) != len(names):
            raise ValueError(f"{len(parts)} parts; expected {len(names)} with --- between them")
        made: dict[str, Any] = {f"{name}{part}": ([], self._fields(f"{name}{part}", body) or _EMPTY)
                for part, body in zip(names, parts, strict=True)}
        if kind == "srv":
            self._services.add(name)
            return made | self._service(name)
        self._actions.add(name)
        goal_id = ("goal_id", (Nodetype.NAME, _UUID))
        sending, result = f"{name}_SendGoal", f"{name}_GetResult"
        self._services |= {sending, result}
        made |= {
            f"{sending}_Request": ([], [goal_id, ("goal", (Nodetype.NAME, f"{name}_Goal"))]),
            f"{sending}_Response": ([], [
                ("accepted", (Nodetype.BASE, ("bool", 0))),
                ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time"))]),
            f"{result}_Request": ([], [goal_id]),
            f"{result}_Response": ([], [
                ("status", (Nodetype.BASE, ("int8", 0))),
                ("result", (Nodetype.NAME, f"{name}_Result"))]),
            f"{name}_FeedbackMessage": ([], [
                goal_id, ("feedback", (Nodetype.NAME, f"{name}_Feedback"))])}
        if self.distribution not in _UNHASHED:  # parts of the action's hash
            made[name] = [], [(field, (Nodetype.NAME, f"{name}_{part}")) for field, part in (
                ("goal", "Goal"), ("result", "Result"), ("feedback", "Feedback"),
                ("send_goal_service", "SendGoal"), ("get_result_service", "GetResult"),
                ("feedback_message", "FeedbackMessage"))]
        return made | self._service(sending) | self._service(result)

    def _service(self, name: str) -> dict[str, Any]:
        """Return the types in a service's hash: its parts and its event."""
        if self.distribution in _UNHASHED:
            return {}
        request, response, event = (f"{name}_{part}" for part in ("Request", "Response", "Event"))

        def at_most_one(what: str) -> Any:
            return Nodetype.SEQUENCE, ((Nodetype.NAME, what), 1)

        return {
            event: ([], [("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")),
                         ("request", at_most_one(request)), ("response", at_most_one(response))]),
            name: ([], [("request_message", (Nodetype.NAME, request)),
                        ("response_message", (Nodetype.NAME, response)),
                        ("event_message", (Nodetype.NAME, event))])}

    @staticmethod
    def _fields(name: str, text: str) -> Fields:
        package, _, last = name.split("/")
        try:
            parsed = get_types_from_msg(_BOUND.sub("wstring", text), f"{package}/msg/{last}")
        except TypesysError as error:
            raise ValueError(_line(error)) from None
        (_, fields), = parsed.values()
        return list(fields)


def _read_as_uint8(fields: Iterable[tuple[str, Any]], *names: str) -> Fields:
    """Return fields with uint8 in place of the named types of one byte.

    In ROS 2 `char` is uint8, in hashes too, and `byte` is unsigned; for `rosbags` both are signed.
    """
    return [(field, _as_uint8(what, names)) for field, what in fields]


def _as_uint8(what: Any, names: Sequence[str]) -> Any:
    kind, detail = what
    if kind == Nodetype.BASE:
        return (kind, ("uint8", detail[1])) if detail[0] in names else what
    return what if kind == Nodetype.NAME else (kind, (_as_uint8(detail[0], names), detail[1]))


def _parts(fields: Fields) -> list[str]:
    """Return the messages in fields or their lists."""
    return [name for _, what in fields if (name := _named(what))]


def _named(what: Any) -> str:
    """Return the message in a field or its list; "" for a number or text."""
    kind, detail = what
    if kind == Nodetype.NAME:
        return str(detail)
    return "" if kind == Nodetype.BASE else _named(detail[0])


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


_NUMPY = {"bool": "bool", "byte": "uint8", "char": "uint8", "int8": "int8", "int16": "int16",
          "int32": "int32", "int64": "int64", "uint8": "uint8", "uint16": "uint16",
          "uint32": "uint32", "uint64": "uint64", "float32": "float32", "float64": "float64"}
_ZERO: dict[str, Any] = {**dict.fromkeys(_NUMPY, 0), "float32": 0.0, "float64": 0.0,
                         "bool": False, "string": ""}
