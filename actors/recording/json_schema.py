"""JSON schemas for viewers: one object without references and unions.

Viewers read a schema to find out what can be plotted. Many support only the basic parts of the
standard: `type`, `properties`, `items`, `enum`.
"""

from __future__ import annotations

from typing import Any

import msgspec

_KEPT = ("title", "description", "enum", "contentEncoding", "required", "default")


def plain_schema(kind: Any) -> bytes:
    """Return the schema of a struct type as JSON."""
    schema = msgspec.json.schema(kind)
    return msgspec.json.encode(_plain(schema, schema.get("$defs", {})))


def _plain(node: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in node:
        return _plain(definitions[node["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in node:  # a number, or null: viewers plot the number
        return _plain(next(n for n in node["anyOf"] if n.get("type") != "null"), definitions)
    found = {key: node[key] for key in _KEPT if key in node}
    kind = node.get("type", "string" if _is_text(node.get("enum", ())) else None)
    if kind is not None:
        found["type"] = kind
    if kind == "object":
        found["properties"] = {
            name: _plain(part, definitions)
            for name, part in node.get("properties", {}).items()}
        if isinstance(node.get("additionalProperties"), dict):
            found["additionalProperties"] = _plain(node["additionalProperties"], definitions)
    elif kind == "array":
        parts = node.get("prefixItems") or [node.get("items") or {}]
        found["items"] = _plain(parts[0], definitions)  # tuples here are of one type each
    elif kind is None and "enum" in node:
        found["type"] = "integer"
    return found


def _is_text(values: Any) -> bool:
    return bool(values) and all(isinstance(value, str) for value in values)
