"""Mistakes in a TOML file against its schema: file, field, value, unit, what is allowed, one line each."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

Schema = dict[str, Any]

UNITS = {
    "_deg": "deg",
    "_deg_s": "deg/s",
    "_deg_s2": "deg/s^2",
    "_deg_h": "deg/h",
    "_deg_sqrt_h": "deg/sqrt(h)",
    "_deg_h_g": "deg/h/g",
    "_arcsec": "arcsec",
    "_arcmin": "arcmin",
    "_g": "g",
    "_ug": "ug",
    "_ug_sqrt_hz": "ug/sqrt(Hz)",
    "_ppm": "ppm",
    "_mps": "m/s",
    "_mps2": "m/s^2",
    "_m": "m",
    "_s": "s",
    "_ms": "ms",
    "_hz": "Hz",
}
"""What the endings of field names stand for; the longest that fits counts."""


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


def told_mistakes(origin: str, error: ValidationError, model: type[BaseModel], whole: str = "") -> str:
    """Lines for pydantic's errors about content of ``model`` that comes from ``origin``.

    A mistake of the content as a whole is told of ``whole``, if that has a name.
    """
    schema = model.model_json_schema()
    return "\n".join(_told(origin, mistake, schema, whole) for mistake in error.errors(include_url=False))


def _told(origin: str, mistake: Any, schema: Schema, whole: str) -> str:
    parts, allowed = _declared(mistake["loc"], schema)
    field = ".".join(parts) or whole
    kind, value = mistake["type"], mistake["input"]
    if kind in ("missing", "extra_forbidden"):
        return f"{origin}: {field}: {'missing' if kind == 'missing' else 'unknown field'}"
    if kind == "union_tag_invalid":
        tag, expected = mistake["ctx"]["tag"], mistake["ctx"]["expected_tags"]
        return f"{origin}: {field}.kind = {tag!r}: allowed are {expected}"
    unit = _unit(field)
    shown = "" if isinstance(value, dict) or not field else f" = {shortened(repr(value))} {unit}".rstrip()
    told = (
        f"allowed is {allowed} {unit}".rstrip() if allowed else mistake["msg"].removeprefix("Value error, ")
    )
    return f"{origin}: {field}{shown}: {told}" if field else f"{origin}: {told}"


def shortened(text: str) -> str:
    """A text of at most 60 characters."""
    return text if len(text) <= 60 else f"{text[:57]}..."


def _declared(location: Iterable[str | int], schema: Schema) -> tuple[list[str], str]:
    """Field names of a location in a schema (tags of alternatives dropped), and the range it declares."""
    candidates, parts = [schema], []
    for part in location:
        declared = [p for c in candidates for p in _properties(c, schema)]
        nested = [p[part] for p in declared if part in p]
        # A table under names of the user's own.
        nested += [
            c["additionalProperties"] for c in candidates if isinstance(c.get("additionalProperties"), dict)
        ]
        candidates = nested or candidates
        # What is not a property is an index, an unknown field, or the tag of an alternative: drop the tag.
        tags = [p["kind"].get("const") for p in declared if "kind" in p]
        if nested or part not in tags:
            parts.append(str(part))
    lower = upper = ""
    for candidate in [a for c in candidates for a in (c, *c.get("anyOf", []))]:
        for key, opening in (("minimum", "["), ("exclusiveMinimum", "(")):
            lower = f"{opening}{candidate[key]:g}" if key in candidate else lower
        for key, closing in (("maximum", "]"), ("exclusiveMaximum", ")")):
            upper = f"{candidate[key]:g}{closing}" if key in candidate else upper
    return parts, f"{lower or '(-inf'}, {upper or 'inf)'}" if lower or upper else ""


def _properties(candidate: dict[str, Any], schema: dict[str, Any]) -> list[dict[str, Any]]:
    """Properties of a part of a JSON schema, through references and alternatives."""
    if "$ref" in candidate:
        return _properties(schema["$defs"][candidate["$ref"].rsplit("/", 1)[1]], schema)
    found = [candidate["properties"]] if "properties" in candidate else []
    for alternatives in ("anyOf", "oneOf", "allOf"):
        for alternative in candidate.get(alternatives, []):
            found += _properties(alternative, schema)
    return found


def _unit(field: str) -> str:
    """Unit of a field, from the ending of its name."""
    endings = [ending for ending in UNITS if field.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else ""
