"""Makes inputs out of inputs: bits and bytes, words and numbers, and the parts of known formats.

Everything is drawn from one `random.Random`, so that a seed gives the same inputs again. What a
format consists of is taken apart, changed and put together again, with lengths and checksums that
are right: an input that fails at the first checksum tests the checksum and nothing else.
"""

from __future__ import annotations

import copy
import json
import math
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgspec
import tomli_w

from rampart.files import toml
from tests.fuzz.target import MAX_INPUT

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53 + 1, 2**63 - 1,
    2**63, 2**64 - 1, -2**31, -2**63, 10**9, 10**12, 0.0, -0.0, 0.5, 1e-9, 1e-320, 1e9, 1e17, 1e300,
    1.7e308, math.nan, math.inf, -math.inf)
TEXTS = ("", " ", "\0", "\n", "\x1b[2J", "a", "..", "../../x", "/dev/zero", "nan", "1e999", "None",
         "é🛬", "\u202e", "x" * 300, "x" * 20_000, "A and A", "{name}", "%s", "🛬" * 100)
_WRITTEN = (*(repr(number) for number in NUMBERS), "9" * 400, "9" * 5000, "1e400", "0x" + "f" * 40,
            "1_000", "true", "''", "[]", "{}", "null", '"\\ud800"', "--", "+inf")
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_BRACKETS = (b"[", b"{", b"(", b"<a>", b'"', b"'", b'"""', b"{a=", b'{"a":', b"not ", b"a.")
_DEEP = (2, 40, 1100, 20_000)


class Mutator:
    """Makes inputs of one kind.

    Args:
        kind: of the format, see `fuzz.target.Target`.
        words: of its language.
    """

    def __init__(self, kind: str, words: Sequence[str] = ()) -> None:
        self._words = [word.encode() for word in words]
        self._changes: list[Callable[[bytes, bytes, Random], bytes]] = [_bits, _pieces]
        codec = _CODECS.get(kind)
        if codec is not None:
            self._changes += [_structured(*codec)] * 4
        if kind in {"text", "toml", "json"}:
            self._changes += [self._text] * 4

    def __call__(self, data: bytes, other: bytes, draw: Random) -> bytes:
        """Return `data` changed, perhaps with pieces of `other`."""
        for _ in range(1 + int(draw.expovariate(1.5))):
            data = draw.choice(self._changes)(data, other, draw)[:MAX_INPUT]
        return data

    def _text(self, data: bytes, other: bytes, draw: Random) -> bytes:
        choice = draw.randrange(6)
        if choice == 0:  # a number by an extreme one
            found = [*_NUMBER.finditer(data)]
            if found:
                one = draw.choice(found)
                return data[:one.start()] + draw.choice(_WRITTEN).encode() + data[one.end():]
        if choice == 1:
            bracket = draw.choice(_BRACKETS) * draw.choice(_DEEP)
            at = draw.randrange(len(data) + 1)
            return data[:at] + bracket + data[at:]
        if choice == 2 and self._words:
            at = draw.randrange(len(data) + 1)
            return data[:at] + draw.choice(self._words) + data[at:]
        lines = data.split(b"\n")
        at = draw.randrange(len(lines))
        if choice == 3:
            del lines[at]
        elif choice == 4:
            line = lines[draw.randrange(len(lines))]
            lines[at:at] = [line] * min(draw.choice((1, 1, 2, 50, 2000)),
                                        1 + MAX_INPUT // (len(line) + 1))
        else:
            lines.insert(at, draw.choice(other.split(b"\n")))
        return b"\n".join(lines)


def _bits(data: bytes, _other: bytes, draw: Random) -> bytes:
    if not data:
        return bytes([draw.randrange(256)])
    changed = bytearray(data)
    at = draw.randrange(len(changed))
    if draw.random() < 0.5:
        changed[at] ^= 1 << draw.randrange(8)
        return bytes(changed)
    number = draw.choice([n for n in NUMBERS if isinstance(n, int)])
    size, written = draw.choice(((1, "B"), (2, "H"), (4, "I"), (8, "Q")))
    changed[at:at + size] = struct.pack(draw.choice("<>") + written, number % (1 << 8 * size))
    return bytes(changed)


def _pieces(data: bytes, other: bytes, draw: Random) -> bytes:
    """Cut a piece out, double it, or put one of another input in."""
    start = draw.randrange(len(data) + 1)
    end = min(len(data), start + int(draw.expovariate(1 / 20)))
    choice = draw.randrange(5)
    if choice == 0:
        return data[:start] + data[end:]
    if choice == 1:
        return data[:end] + data[start:end] * draw.choice((1, 1, 3, 300)) + data[end:]
    if choice == 2:
        at = draw.randrange(len(other) + 1)
        return data[:start] + other[at:at + int(draw.expovariate(1 / 20))] + data[end:]
    if choice == 3:
        return data[:start]
    return data[:start] + draw.randbytes(int(draw.expovariate(1 / 8))) + data[end:]


# -- formats ---------------------------------------------------------------------------------------

_Codec = tuple[Callable[[bytes], Any], Callable[[Any], bytes], Callable[[Any, Any, Random], Any]]


def _structured(take_apart: Callable[[bytes], Any], put_together: Callable[[Any], bytes],
                change: Callable[[Any, Any, Random], Any]
                ) -> Callable[[bytes, bytes, Random], bytes]:
    def changed(data: bytes, other: bytes, draw: Random) -> bytes:
        try:
            parts = take_apart(data)
        except Exception:  # damaged before; the others go on with it
            return _bits(data, other, draw)
        try:
            more = take_apart(other)
        except Exception:
            more = parts
        try:
            return put_together(change(parts, more, draw))
        except Exception:  # what the format cannot say
            return _pieces(data, other, draw)

    return changed


def _tree(value: Any, other: Any, draw: Random) -> Any:
    """Change one place in nested dictionaries and lists."""
    root = [copy.deepcopy(value)]
    places = _places(root)
    holder, key = draw.choice(places)
    choice = draw.randrange(8)
    if choice == 0:
        holder[key] = draw.choice(NUMBERS)
    elif choice == 1:
        holder[key] = draw.choice(TEXTS)
    elif choice == 2:
        holder[key] = draw.choice(([], {}, None, True, [1, 2], {"a": 1}, b"", [[]]))
    elif choice == 3 and holder is not root:
        del holder[key]
    elif choice == 4 and isinstance(holder, list) and holder is not root:
        holder[key:key] = [holder[key]] * draw.choice((1, 1, 3, 100, 2000))
    elif choice == 5:
        from_holder, from_key = draw.choice(_places([other]))
        holder[key] = copy.deepcopy(from_holder[from_key])
    elif choice == 6:
        for _ in range(draw.choice((1, 5, 40, 600))):
            holder[key] = [holder[key]] if draw.random() < 0.5 else {"a": holder[key]}
    elif isinstance(holder, dict):
        holder[draw.choice((*TEXTS, *map(str, holder)))] = holder.pop(key)
    elif isinstance(holder[key], (int, float)):
        holder[key] += draw.choice((-1, 1, 0.5, 1e-9))
    return root[0]


def _places(root: list[Any]) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    left: list[Any] = [root]
    while left and len(found) < 2000:
        holder = left.pop()
        for key in (holder if isinstance(holder, dict) else range(len(holder))):
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                left.append(holder[key])
    return found


def _parts(parts: list[Any], others: list[Any], draw: Random) -> list[Any]:
    """Change a list of (kind, content): one is left out, doubled, moved, or changed inside."""
    parts = list(parts)
    at = draw.randrange(len(parts))
    choice = draw.randrange(6)
    if choice == 0:
        del parts[at]
    elif choice == 1:
        parts[at:at] = [parts[at]] * draw.choice((1, 3, 200))
    elif choice == 2:
        parts.insert(at, draw.choice(others))
    elif choice == 3:
        parts.insert(draw.randrange(len(parts)), parts.pop(at))
    else:
        kind, content = parts[at]
        parts[at] = (kind, draw.choice((_bits, _pieces))(content, draw.choice(others)[1], draw))
    return parts


def _png_apart(data: bytes) -> list[tuple[bytes, bytes]]:
    parts, at = [], 8
    while at < len(data):
        (length,), kind = struct.unpack_from(">I", data, at), data[at + 4:at + 8]
        content = data[at + 8:at + 8 + length]
        parts.append((kind, zlib.decompress(content) if kind == b"IDAT" else content))
        at += 12 + length
    return parts


def _png_together(parts: list[tuple[bytes, bytes]]) -> bytes:
    out = [b"\x89PNG\r\n\x1a\n"]
    for kind, plain in parts:
        content = zlib.compress(plain) if kind == b"IDAT" else plain
        crc = zlib.crc32(kind + content)
        out.append(struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc))
    return b"".join(out)


_MCAP = b"\x89MCAP0\r\n"


def _mcap_apart(data: bytes) -> list[tuple[int, bytes]]:
    parts, at = [], len(_MCAP)
    while at + 9 <= len(data) - len(_MCAP):
        kind, length = struct.unpack_from("<BQ", data, at)
        parts.append((kind, data[at + 9:at + 9 + length]))
        at += 9 + length
    return parts


def _mcap_together(parts: list[tuple[int, bytes]]) -> bytes:
    return _MCAP + b"".join(
        struct.pack("<BQ", kind, len(content)) + content for kind, content in parts) + _MCAP


_CODECS: dict[str, _Codec] = {
    "json": (json.loads, lambda value: json.dumps(value).encode(), _tree),
    "toml": (lambda data: toml.parse(data.decode()),
             lambda value: tomli_w.dumps(value).encode(), _tree),
    "msgpack": (msgspec.msgpack.decode, msgspec.msgpack.encode, _tree),
    "png": (_png_apart, _png_together, _parts),
    "mcap": (_mcap_apart, _mcap_together, _parts),
}
