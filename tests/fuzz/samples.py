"""Values of any type that messages are made of, for targets that need inputs to begin with."""

from __future__ import annotations

from typing import Any

from msgspec import inspect


def sample(kind: Any) -> Any:
    """Return some value of a type, small and within its bounds."""
    return _some(inspect.type_info(kind))


def _some(kind: Any) -> Any:  # noqa: PLR0911, PLR0912 one for each kind of type
    match kind:
        case inspect.StructType():
            return kind.cls(**{field.name: _some(field.type) for field in kind.fields})
        case inspect.IntType():
            return max(1, kind.ge or 0, (kind.gt or 0) + 1)
        case inspect.FloatType():
            return max(0.5, kind.ge or 0.0)
        case inspect.StrType():
            return "a" * max(1, kind.min_length or 0)
        case inspect.BoolType():
            return True
        case inspect.BytesType():
            return b"a"
        case inspect.EnumType():
            return next(iter(kind.cls))
        case inspect.LiteralType():
            return kind.values[0]
        case inspect.TupleType():
            return tuple(_some(item) for item in kind.item_types)
        case inspect.VarTupleType() | inspect.ListType() | inspect.FrozenSetType():
            return (_some(kind.item_type),)
        case inspect.DictType():
            return {_some(kind.key_type): _some(kind.value_type)}
        case inspect.UnionType():
            return _some(kind.types[0])
        case inspect.NoneType():
            return None
    return 1
