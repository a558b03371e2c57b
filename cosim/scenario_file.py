"""Scenarios written as files that can be run again, with the data that they name beside them."""

import shutil
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from .files import whole_file
from .scenario import Scenario, data_tables
from .toml import to_toml


def write_scenario(scenario: Scenario, path: Path) -> None:
    """Write a scenario's TOML file, whole or not at all, and copies of its data beside it. Raises OSError."""
    content = _stated(scenario)
    with_data_in(path.parent, content)
    with whole_file(path) as partial:
        partial.write_text(to_toml(content), "utf-8")


def with_data_in(folder: Path, content: dict[str, Any]) -> None:
    """Copy the files that a scenario's content names into a folder, and name the copies. Raises OSError."""
    for table in data_tables(content):
        source = Path(table["file"])
        table["file"] = source.name
        if not (folder / source.name).exists() or not source.samefile(folder / source.name):
            with whole_file(folder / source.name) as partial:
                shutil.copyfile(source, partial)


def scenario_toml(scenario: Scenario) -> str:
    """TOML text of what the scenario states otherwise than by default."""
    return to_toml(_stated(scenario))


def _stated(settings: BaseModel) -> dict[str, Any]:
    """Fields that differ from their defaults; a ``kind`` stands always, for it says what the others mean."""
    stated = {}
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            inner = _stated(value)
            if value != field.default:
                stated[name] = inner
        elif name == "kind" or field.is_required() or value != field.default:
            stated[name] = _plain(value)
    return stated


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return _stated(value)
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value
