"""Plants for `fleetalign lmi` in TOML, and mistakes in them told in one line."""

from importlib import resources
from pathlib import Path
from typing import Any

from ..align.lmi.plant import MATRICES, Plant, checked_polytope
from ..sins.text import shortened
from .command_line import InputError
from .toml import field_name, read_named

PLANT_FOLDER = resources.files("fleetalign.scenarios.plants")
PLANT_KEYS = {"title", "kind", "rho", "vertex", *MATRICES}
PLANT_KINDS = "l2linf", "feedback"
"""Designs that a file can ask for: of a filter beside the plant, or of a gain that corrects its state."""


def plant_names() -> list[str]:
    """Names of the bundled plants."""
    return sorted(f.name.removesuffix(".toml") for f in PLANT_FOLDER.iterdir() if f.name.endswith(".toml"))


def load_plant(name_or_path: str) -> tuple[str, str, tuple[Plant, ...]]:
    """Title, kind of design and vertices of a bundled plant or of a TOML file.

    The file holds ``title``, ``kind`` (l2linf by default, or feedback), ``rho`` (1 by default) and the
    matrices A, B, C, D, H as lists of rows; or, for a polytope, a table ``[[vertex]]`` with the five for
    each. Raises `InputError`: file, field, value,
    what is allowed.
    """
    try:
        path, content = read_named(name_or_path, "plant", Path(str(PLANT_FOLDER)), plant_names())
    except ValueError as error:
        raise InputError(str(error)) from error
    try:
        title = content.get("title", path.stem)
        if not isinstance(title, str):
            raise ValueError(f"title = {shortened(repr(title))}: must be text")
        kind = content.get("kind", PLANT_KINDS[0])
        if kind not in PLANT_KINDS:
            raise ValueError(f"kind = {shortened(repr(kind))}: allowed are {', '.join(PLANT_KINDS)}")
        return title, kind, _vertices(content)
    except ValueError as error:
        raise InputError(f"{name_or_path}: {error}") from error


def _vertices(content: dict[str, Any]) -> tuple[Plant, ...]:
    rho, tables = content.get("rho", 1.0), content.get("vertex")
    if tables is None:
        _refuse_unknown(content, PLANT_KEYS)
        return (_plant(content, rho),)
    _refuse_unknown(content, PLANT_KEYS - set(MATRICES))
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ValueError("vertex: must be tables, each under [[vertex]]")
    plants = []
    for number, table in enumerate(tables, 1):
        try:
            _refuse_unknown(table, set(MATRICES))
            plants.append(_plant(table, rho))
        except ValueError as error:
            raise ValueError(f"vertex {number}: {error}") from error
    return checked_polytope(plants)


def _refuse_unknown(table: dict[str, Any], known: set[str]) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{field_name([key])}: unknown field; known are {', '.join(sorted(known))}")


def _plant(table: dict[str, Any], rho: Any) -> Plant:
    for name in MATRICES:
        if name not in table:
            raise ValueError(f"{name}: missing")
    return Plant(**{name: table[name] for name in MATRICES}, rho=rho)
