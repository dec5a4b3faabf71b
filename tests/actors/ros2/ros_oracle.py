"""Run by the Python that has the wheels of ROS 2: messages as ROS 2 itself writes them.

    python ros_oracle.py COUNT TYPE ...

One line of JSON a message: type, fields, and the bytes, hexadecimal.
"""

import importlib
import json
import math
import random
import struct
import sys

from rclpy.serialization import serialize_message

RANGES = {"int8": (-128, 127), "uint8": (0, 255), "int16": (-2**15, 2**15 - 1),
          "uint16": (0, 2**16 - 1), "int32": (-2**31, 2**31 - 1), "uint32": (0, 2**32 - 1),
          "int64": (-2**63, 2**63 - 1), "uint64": (0, 2**64 - 1)}
EXTREMES = [0.0, -0.0, math.inf, -math.inf, 1e-300, 1e30]
WORDS = ["", "a", "base_link", "höhe", "x" * 300, "\U0001f916"]


def class_of(name):
    """Return the class of a type, or of a part of a service."""
    package, kind, last = name.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    for part in ("_Request", "_Response"):
        if last.endswith(part):
            return getattr(getattr(module, last.removesuffix(part)), part[1:])
    return getattr(module, last)


def value(kind, dice):
    """Return a value of a field's type."""
    if kind.startswith("sequence<"):
        inner, _, bound = kind[len("sequence<"):-1].partition(",")
        most = int(bound) if bound else 8
        return [value(inner.strip(), dice) for _ in range(dice.randint(0, min(most, 8)))]
    if kind.endswith("]"):
        inner, _, count = kind[:-1].partition("[")
        return [value(inner, dice) for _ in range(int(count))]
    if "/" in kind:
        package, name = kind.split("/")
        return filled(class_of(f"{package}/msg/{name}"), dice)
    if kind in RANGES:
        return dice.choice([*RANGES[kind], dice.randint(*RANGES[kind])])
    kind, _, most = kind.partition("<")
    simple = {"octet": lambda: bytes([dice.randint(0, 255)]),
              "boolean": lambda: dice.random() < 0.5,
              "string": lambda: dice.choice(WORDS)[:int(most[:-1]) if most else None]}
    if kind in simple:
        return simple[kind]()
    number = dice.choice(EXTREMES) if dice.random() < 0.3 else dice.uniform(-1e6, 1e6)
    return struct.unpack("f", struct.pack("f", number))[0] if kind == "float" else number


def filled(made, dice):
    """Return a message with random fields."""
    message = made()
    for field, kind in made.get_fields_and_field_types().items():
        setattr(message, field, value(kind, dice))
    return message


def plain(what):
    """Return a value as JSON can hold it."""
    if hasattr(what, "get_fields_and_field_types"):
        return {name: plain(getattr(what, name)) for name in what.get_fields_and_field_types()}
    if isinstance(what, bytes):
        return what[0]
    if isinstance(what, (str, bool, int)):
        return what
    if not hasattr(what, "__len__"):
        what = what.item() if hasattr(what, "item") else what
        return repr(what) if isinstance(what, float) else what
    return [plain(item) for item in what]


def main():
    """Write messages."""
    for name in sys.argv[2:]:
        dice, made = random.Random(name), class_of(name)
        for _ in range(int(sys.argv[1])):
            message = filled(made, dice)
            print(json.dumps([name, plain(message), serialize_message(message).hex()]))


if __name__ == "__main__":
    main()
