"""TOML files: as users write them, read within bounds, so that one that is none costs little; and written."""

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..sins.text import printable, shortened

MOST_BYTES = 1_000_000
MOST_ENTRIES = 50_000
MOST_DEPTH = 32
"""Of tables and lists in each other, and parts of a dotted name."""

# Strings and comments hold dots of their own.
_NO_NAMES = re.compile(
    r'"""(?:\\.|[^\\])*?"""|' + r"'''.*?'''|" + r'"(?:\\.|[^"\\\n])*"|' + r"'[^'\n]*'|#[^\n]*", re.DOTALL
)
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""What a terminal obeys rather than shows: control characters, line separators, changes of direction."""
_CONTROL_IN_NAME = re.compile(f"[\t\n]|{_CONTROL.pattern}")


def read_toml(path: Path, told: str = "") -> dict[str, Any]:
    """Content of a TOML file. Raises ValueError, one line that begins with ``told``, by default the path."""
    told = told or printable(str(path))
    try:
        with path.open("rb") as file:
            raw = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{told}: cannot be read: {error.strerror}") from error
    if len(raw) > MOST_BYTES:
        raise ValueError(f"{told}: too long: allowed are {MOST_BYTES} bytes")
    try:
        text = raw.decode("utf-8-sig")
        if text.count(",") + text.count("\n") > MOST_ENTRIES:
            raise ValueError(f"more than {MOST_ENTRIES} entries")
        # tomllib takes time by the square of a name's parts.
        if any(piece.count(".") > MOST_DEPTH for piece in re.split(r"[=,\n{]", _NO_NAMES.sub("", text))):
            raise ValueError(f"a name of more than {MOST_DEPTH} parts")
        content = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"{told}: not UTF-8 text, at byte {error.start}") from error
    except RecursionError as error:
        raise ValueError(f"{told}: not TOML: nested more than {MOST_DEPTH} deep") from error
    except ValueError as error:
        raise ValueError(f"{told}: not TOML: {shortened(printable(str(error)), 200)}") from error
    try:
        check_content(content)
    except ValueError as error:
        raise ValueError(f"{told}: {error}") from error
    return content


def read_named(name_or_path: str, what: str, folder: Path, names: list[str]) -> tuple[Path, dict[str, Any]]:
    """File and content of one of the bundled ``names`` in ``folder``, or of a TOML file of the user's.

    Raises ValueError, one line; ``what`` is what bundled ones are called.
    """
    own = name_or_path not in names
    path, told = Path(name_or_path) if own else folder / f"{name_or_path}.toml", printable(name_or_path)
    try:
        return path, read_toml(path, told)
    except ValueError as error:
        if isinstance(error.__cause__, OSError) and path.suffix != ".toml":
            known = f"neither a bundled {what} ({', '.join(names)}) nor a .toml file"
            raise ValueError(f"{shortened(told)}: {known}") from error
        raise


def check_content(content: dict[str, Any]) -> None:
    """Refuse what no field takes: deep nesting, integers beyond 64 bits (TOML's own limit) and
    control characters.

    Raises ValueError, one line that begins with the field.
    """
    waiting: list[tuple[tuple[str, ...], Any]] = [((), content)]
    while waiting:
        where, table = waiting.pop()
        if len(where) > MOST_DEPTH:
            raise ValueError(f"{field_name(where[:3])}...: nested more than {MOST_DEPTH} deep")
        for key, value in table.items() if isinstance(table, dict) else enumerate(table):
            if isinstance(value, dict | list):
                waiting.append(((*where, str(key)), value))
            found = _CONTROL.search(value) if isinstance(value, str) else None
            found = found or (_CONTROL_IN_NAME.search(key) if isinstance(key, str) else None)
            if found:
                raise ValueError(f"{field_name((*where, str(key)))}: holds a control character, {found[0]!r}")
            if isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise ValueError(f"{field_name((*where, str(key)))}: a whole number beyond 64 bits")


def field_name(parts: Iterable[str]) -> str:
    """A field's dotted name as it can be shown."""
    return shortened(printable(".".join(parts)), 120)


def to_toml(content: Mapping[str, Any]) -> str:
    """TOML text of nested tables and lists of numbers, texts and truth values; None is left out."""
    return "\n".join(_lines(content, ())).strip() + "\n"


def _lines(table: Mapping[str, Any], where: tuple[str, ...]) -> list[str]:
    plain = {key: value for key, value in table.items() if value is not None and not isinstance(value, dict)}
    lines = [f"{_key(key)} = {_value(value)}" for key, value in plain.items()]
    if where and lines:
        lines = ["", f"[{'.'.join(map(_key, where))}]", *lines]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += _lines(value, (*where, key))
    return lines


def _value(value: Any) -> str:
    if isinstance(value, dict):
        inner = ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)


def _key(key: str) -> str:
    """A key, in quotes where its letters ask for them."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)
