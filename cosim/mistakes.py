"""Mistakes in a TOML file against its schema: file, field, value, unit, what is allowed, one line each."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from .scenario import UNITS

Schema = dict[str, Any]


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file. Raises ValueError, one line that begins with the file."""
    try:
        return tomllib.loads(path.read_text("utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not UTF-8 text, at byte {error.start}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not TOML: {error}") from error


def told_mistakes(origin: str, error: ValidationError, model: type[BaseModel]) -> str:
    """Lines for pydantic's errors about content of ``model`` that comes from ``origin``."""
    schema = model.model_json_schema()
    return "\n".join(_told(origin, mistake, schema) for mistake in error.errors(include_url=False))


def _told(origin: str, mistake: Any, schema: Schema) -> str:
    field = ".".join(str(part) for part in mistake["loc"])
    kind, value = mistake["type"], mistake["input"]
    if kind in ("missing", "extra_forbidden"):
        return f"{origin}: {field}: {'missing' if kind == 'missing' else 'unknown field'}"
    unit = _unit(field)
    shown = "" if isinstance(value, dict) or not field else f" = {_shortened(repr(value))} {unit}".rstrip()
    allowed = _range(schema, mistake["loc"])
    told = (
        f"allowed is {allowed} {unit}".rstrip() if allowed else mistake["msg"].removeprefix("Value error, ")
    )
    return f"{origin}: {field}{shown}: {told}" if field else f"{origin}: {told}"


def _shortened(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


def _unit(field: str) -> str:
    """Unit of a field, from the ending of its name."""
    endings = [ending for ending in UNITS if field.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else ""


def _range(schema: Schema, location: Iterable[str | int]) -> str:
    """The range that a schema declares for a place, empty if it declares none."""
    candidates = [schema]
    for part in location:
        declared = [properties for c in candidates for properties in _properties(c, schema)]
        candidates = [properties[part] for properties in declared if part in properties] or candidates
    lower = upper = ""
    for candidate in [a for c in candidates for a in (c, *c.get("anyOf", []))]:
        for key, opening in (("minimum", "["), ("exclusiveMinimum", "(")):
            lower = f"{opening}{candidate[key]:g}" if key in candidate else lower
        for key, closing in (("maximum", "]"), ("exclusiveMaximum", ")")):
            upper = f"{candidate[key]:g}{closing}" if key in candidate else upper
    return f"{lower or '(-inf'}, {upper or 'inf)'}" if lower or upper else ""


def _properties(candidate: Schema, schema: Schema) -> list[dict[str, Any]]:
    """Properties of a part of a schema, through references and alternatives."""
    if "$ref" in candidate:
        return _properties(schema["$defs"][candidate["$ref"].rsplit("/", 1)[1]], schema)
    found = [candidate["properties"]] if "properties" in candidate else []
    for alternative in [*candidate.get("anyOf", []), *candidate.get("allOf", [])]:
        found += _properties(alternative, schema)
    return found
