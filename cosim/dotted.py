"""Fields of nested tables and lists by their dotted names, such as ``faults.imu.0.start_s``."""

from typing import Any

from .toml import field_name


def set_field(content: dict[str, Any], name: str, value: Any) -> None:
    """Give a field of nested tables and lists another value. Parts of its name are keys of tables, and
    numbers of lists' entries, counted from 0.

    Raises ValueError, one line that begins with the name, for what is not there; whether a table has a field
    of the last part is for its schema to say.
    """
    parts: list[str] = name.split(".")
    where: Any = content
    for depth, part in enumerate(parts[:-1]):
        where = where.get(part) if isinstance(where, dict) else where[_key(where, parts, depth)]
    where[_key(where, parts, len(parts) - 1)] = value


def _key(where: Any, parts: list[str], depth: int) -> Any:
    """What a part of a name is in a table, or in a list."""
    told, part = field_name(parts), parts[depth]
    if isinstance(where, dict):
        return part
    if not isinstance(where, list):
        raise ValueError(f"{told}: unknown field")
    count = len(where)
    for number in range(count):
        if part == str(number):
            return number
    entries = f"entries 0 to {count - 1}" if count > 1 else "entry 0" if count else "no entry"
    raise ValueError(f"{told}: {field_name(parts[:depth])} has {entries}, and not {field_name([part])}")
