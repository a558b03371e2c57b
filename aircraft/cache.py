"""The flight cache: a plan that was flown before is read instead of flown.

An entry is one npz file. Its key is a hash of everything that determines the flight; inside, a digest over
every array and the metadata tells a damaged entry from a sound one.
"""

import hashlib
import io
import json
import os
import platform
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path

import jsbsim
import numpy as np
import platformdirs
from pydantic import TypeAdapter

from ..sins.earth import GravityModel
from ..sins.sources import sources_digest
from .airframe import load_airframe
from .flight import Flight, Phase
from .mission import FlightPlan
from .simulator import Progress, fly

FOLDER_VARIABLE = "FLEETALIGN_CACHE"
"""Environment variable that names another folder for the cache."""
ARRAYS = {"time": (), "lla": (3,), "v_n": (3,), "q_nb": (4,), "dtheta_b": (3,), "dv_b": (3,)}
"""Fields of `Flight` that an entry holds, with the shape of a row."""
ORPHAN_AGE_S = 86400.0
"""Age from which a temporary file counts as left behind."""
_PHASES = TypeAdapter(tuple[Phase, ...])


class CacheWarning(UserWarning):
    """The cache cannot be used; the flight is flown all the same."""


class DamagedEntryError(ValueError):
    """A cache entry that is not what was written."""


def cache_folder() -> Path:
    """``FLEETALIGN_CACHE`` where it is set, else ``flights`` in the user's cache folder for fleetalign."""
    folder = os.environ.get(FOLDER_VARIABLE)
    return Path(folder) if folder else platformdirs.user_cache_path("fleetalign") / "flights"


def flight_key(plan: FlightPlan) -> str:
    """Hash of all that determines the flight: plan, airframe, the code that flies, JSBSim, NumPy, machine.

    The last two decide on rounding, which an unstable moment of the flight can make visible.

    Raises ValueError for an unknown airframe.
    """
    airframe = load_airframe(plan.airframe)
    facts = {
        "plan": plan.model_dump(mode="json"),
        "airframe": airframe.model_dump(mode="json"),
        "jsbsim": jsbsim.__version__,
        "numpy": np.__version__,
        "machine": platform.machine(),
        "code": sources_digest("aircraft/*.py", "sins/earth.py", "sins/attitude.py"),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def is_cached(plan: FlightPlan) -> bool:
    """Whether there is an entry for the plan, sound or not."""
    return (cache_folder() / f"{flight_key(plan)}.npz").is_file()


def cached_flight(
    plan: FlightPlan, use_cache: bool = True, progress: Progress | None = None
) -> tuple[Flight, bool]:
    """The plan's flight, and whether it came from the cache.

    A damaged entry is flown again and replaced. Without ``use_cache`` the cache is neither read nor
    written. A cache that cannot be written is a `CacheWarning`. Raises as `simulator.fly`.
    """
    if not use_cache:
        return fly(plan, progress), False
    path = cache_folder() / f"{flight_key(plan)}.npz"
    try:
        return _decoded(path.read_bytes()), True
    except (OSError, DamagedEntryError):
        flight = fly(plan, progress)
    try:
        _write(path, _encoded(flight))
    except OSError as error:
        warnings.warn(f"the flight is not cached: {error}", CacheWarning, stacklevel=2)
    return flight, False


def _metadata(flight: Flight) -> str:
    phases = _PHASES.dump_python(flight.phases, mode="json")
    return json.dumps({"airframe": flight.airframe, "gravity": flight.gravity.name, "phases": phases})


def _digest(metadata: str, arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(metadata.encode())
    for name in ARRAYS:
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _encoded(flight: Flight) -> bytes:
    arrays = {name: getattr(flight, name) for name in ARRAYS}
    metadata = _metadata(flight)
    buffer = io.BytesIO()
    np.savez(buffer, metadata=metadata, digest=_digest(metadata, arrays), **arrays)
    return buffer.getvalue()


def _decoded(content: bytes) -> Flight:
    """The flight of an entry. Raises DamagedEntryError for anything but what `_encoded` wrote."""
    try:
        return _read(content)
    # Damaged bytes can raise whatever the archive's reader or NumPy knows: NotImplementedError for a
    # compression method, RuntimeError for "encrypted", MemoryError for a shape. Each means the same here.
    except Exception as error:
        raise DamagedEntryError(f"{type(error).__name__}: {error}") from error


def _read(content: bytes) -> Flight:
    with np.load(io.BytesIO(content), allow_pickle=False) as entry:
        arrays = {name: entry[name] for name in ARRAYS}
        metadata, digest = str(entry["metadata"]), str(entry["digest"])
    if digest != _digest(metadata, arrays):
        raise ValueError("the digest does not match")
    facts = json.loads(metadata)
    rows = len(arrays["time"])
    if any(arrays[name].shape != (rows, *row) for name, row in ARRAYS.items()):
        raise ValueError("arrays of unequal length")
    return Flight(
        **arrays,
        phases=_PHASES.validate_python(facts["phases"]),
        airframe=facts["airframe"],
        gravity=GravityModel[facts["gravity"]],
    )


def _write(path: Path, content: bytes) -> None:
    """Whole or not at all: to a temporary file beside it, then renamed.

    Temporary files that a killed process left behind are removed once no writer can still be at work.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for orphan in path.parent.glob("*.tmp"):
        # Another process may remove it, or it may be another user's: neither hinders the writing.
        with suppress(OSError):
            if time.time() - orphan.stat().st_mtime > ORPHAN_AGE_S:
                orphan.unlink()
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
