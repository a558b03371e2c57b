"""The cache of designs: what was designed and confirmed before is read instead of solved for.

An entry is one JSON file. Its key is a hash of everything that determines the design; inside, a digest tells
a damaged entry from a sound one. The folder is beside the flights', in ``FLEETALIGN_CACHE`` where it is set.
"""

import hashlib
import json
import os
import tempfile
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from .plant import MATRICES, Plant

FOLDER_VARIABLE = "FLEETALIGN_CACHE"
"""Environment variable that names another folder for the cache."""
SOLVERS = ("clarabel", "cvxpy", "numpy")
"""Distributions whose versions a design depends on."""


class DesignCacheWarning(UserWarning):
    """The cache cannot be used; the design is made all the same."""


def cache_folder() -> Path:
    """``designs`` in the folder of the flight cache, or in the user's cache folder for fleetalign."""
    folder = os.environ.get(FOLDER_VARIABLE)
    return (Path(folder) if folder else platformdirs.user_cache_path("fleetalign")) / "designs"


def design_key(vertices: Sequence[Plant], kind: str, order: int) -> str:
    """Hash of all that determines a design: plants, kind, order, solver, and the code that designs."""
    facts = {"kind": kind, "order": order, **{name: version(name) for name in SOLVERS}}
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for plant in vertices:
        digest.update(f"rho {plant.rho!r}".encode())
        for name in MATRICES:
            matrix = np.ascontiguousarray(getattr(plant, name))
            digest.update(f"{name} {matrix.shape}".encode() + matrix.tobytes())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.name.encode() + hashlib.sha256(source.read_bytes()).digest())
    return digest.hexdigest()


def read(key: str) -> dict[str, Any] | None:
    """The content of an entry, or None where there is none. A damaged entry is a `DesignCacheWarning`."""
    path = cache_folder() / f"{key}.json"
    try:
        entry = json.loads(path.read_bytes())
        if entry["digest"] != _digest(entry["content"]):
            raise ValueError("the digest does not match")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        warnings.warn(
            f"the cached design is made again: {path.name}: {error}", DesignCacheWarning, stacklevel=3
        )
        return None
    return entry["content"]


def write(key: str, content: dict[str, Any]) -> None:
    """Whole or not at all. A folder that cannot be written is a `DesignCacheWarning`."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".tmp", delete=False) as file:
            json.dump({"digest": _digest(content), "content": content}, file)
        os.replace(file.name, folder / f"{key}.json")
    except OSError as error:
        warnings.warn(f"the design is not cached: {error}", DesignCacheWarning, stacklevel=3)


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
