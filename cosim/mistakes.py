"""Mistakes in a TOML file against its schema: file, field, value, unit, what is allowed, one line each."""

from collections.abc import Iterable
from datetime import date, time
from functools import cache
from typing import Any

from pydantic import BaseModel, ValidationError

from ..sins.text import shortened
from .toml import field_name

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


MOST_LINES = 20
"""Of mistakes in one file."""
MOST_LETTERS = 500
"""Of what is told of one."""
_WORDS = {
    **dict.fromkeys(("string_type", "string_sub_type"), "must be text"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "must be true or false"),
    **dict.fromkeys(
        ("int_type", "int_parsing", "int_from_float", "int_parsing_size"), "must be a whole number"
    ),
    **dict.fromkeys(("float_type", "float_parsing"), "must be a number"),
    "finite_number": "must be a finite number",
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "must be a table"),
    **dict.fromkeys(("tuple_type", "list_type"), "must be a list"),
    "path_type": "must be the name of a file",
    **dict.fromkeys(("literal_error", "enum"), "allowed are {expected}"),
    "too_short": "has {actual_length} entries: allowed are {min_length} or more",
    "too_long": "has too many entries: allowed are {max_length}",
    "string_pattern_mismatch": "must fit {pattern}",
    "greater_than_equal": "must be {ge} or more",
    "less_than_equal": "must be {le} or less",
}
"""For kinds of pydantic's errors; in braces what their context has."""


def told_mistakes(origin: str, error: ValidationError, model: type[BaseModel], whole: str = "") -> str:
    """Lines for pydantic's errors about content of ``model`` that comes from ``origin``.

    A mistake of the content as a whole is told of ``whole``, if that has a name.
    """
    told: dict[str, None] = {}
    fields, left = set(), error.error_count()
    for mistake in error.errors(include_url=False):
        if len(told) >= MOST_LINES:
            told[f"{origin}: and {left} more mistakes"] = None
            break
        left -= 1
        # A value that fits none of several types is one mistake.
        field, what = _told(mistake, _schema(model), whole)
        if not (field in fields and mistake["type"] in _WORDS):
            told |= {f"{origin}: {shortened(line, MOST_LETTERS)}": None for line in what.splitlines()}
        fields.add(field)
    return "\n".join(told)


@cache
def _schema(model: type[BaseModel]) -> Schema:
    return model.model_json_schema()


def _told(mistake: Any, schema: Schema, whole: str) -> tuple[str, str]:
    """The field, and what is told of it."""
    kind, value = mistake["type"], mistake["input"]
    parts, allowed = _declared(mistake["loc"], schema, kind == "extra_forbidden")
    field = field_name(parts) or whole
    if kind in ("missing", "extra_forbidden"):
        return field, f"{field}: {'missing' if kind == 'missing' else 'unknown field'}"
    if kind == "union_tag_not_found":
        return field, f"{field}.kind: missing"
    if kind == "union_tag_invalid":
        tag, expected = mistake["ctx"]["tag"], mistake["ctx"]["expected_tags"]
        return field, f"{field}.kind = {_shown(tag)}: allowed are {expected}"
    unit = _unit(parts)
    shown = "" if isinstance(value, dict) or not field else f" = {_shown(value)} {unit}".rstrip()
    told = f"allowed is {allowed} {unit}".rstrip() if allowed else _words(mistake)
    return field, f"{field}{shown}: {told}" if field else told


def told_option(option: str, error: ValidationError) -> str:
    """The line for pydantic's error about the value of an option of the command line."""
    mistake = error.errors(include_url=False)[0]
    return f"{option} = {_shown(mistake['input'])}: {_words(mistake)}"


def _words(mistake: Any) -> str:
    if mistake["type"] in _WORDS:
        return _WORDS[mistake["type"]].format_map(mistake.get("ctx", {}))
    ours = mistake["type"] == "value_error"
    return mistake["msg"].removeprefix("Value error, ") if ours else "is not allowed"


def _shown(value: Any) -> str:
    return shortened(str(value) if isinstance(value, date | time) else repr(value))


def _declared(location: Iterable[str | int], schema: Schema, unknown: bool) -> tuple[list[str], str]:
    """Field names of a location in a schema (alternatives' tags dropped), and the range it declares.

    ``unknown``: the last part is a name that is in no schema.
    """
    location = list(location)
    candidates, parts = _alternatives(schema, schema), []
    for place, part in enumerate(location):
        nested = [found for c in candidates if (found := _inside(c, part)) is not None]
        if nested:
            candidates = [a for found in nested for a in _alternatives(found, schema)]
        # What is neither a property nor an index is the tag of an alternative, or a name that nobody knows.
        if nested or isinstance(part, int) or (unknown and place == len(location) - 1):
            parts.append(str(part))
        else:
            tagged = [c for c in candidates if c.get("properties", {}).get("kind", {}).get("const") == part]
            candidates = tagged or candidates
    lower = upper = ""
    for candidate in candidates:
        for key, opening in (("minimum", "["), ("exclusiveMinimum", "(")):
            lower = f"{opening}{candidate[key]:g}" if key in candidate else lower
        for key, closing in (("maximum", "]"), ("exclusiveMaximum", ")")):
            upper = f"{candidate[key]:g}{closing}" if key in candidate else upper
    return parts, f"{lower or '(-inf'}, {upper or 'inf)'}" if lower or upper else ""


def _inside(candidate: Schema, part: str | int) -> Schema | None:
    """The schema of a property, of a table under names of the user's own, or of an entry of a list."""
    if isinstance(part, int):
        entries = candidate.get("prefixItems", [])
        found = entries[part] if part < len(entries) else candidate.get("items")
    else:
        found = candidate.get("properties", {}).get(part, candidate.get("additionalProperties"))
    return found if isinstance(found, dict) else None


def _alternatives(candidate: Schema, schema: Schema) -> list[Schema]:
    """The parts of a JSON schema that it may be, through references."""
    if "$ref" in candidate:
        candidate = schema["$defs"][candidate["$ref"].rsplit("/", 1)[1]]
    inner = [a for key in ("anyOf", "oneOf", "allOf") for a in candidate.get(key, [])]
    return [candidate, *(b for a in inner for b in _alternatives(a, schema))]


def _unit(parts: list[str]) -> str:
    """Unit of a field, from the ending of its name."""
    name = next((part for part in reversed(parts) if not part.isdigit()), "")
    endings = [ending for ending in UNITS if name.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else ""
