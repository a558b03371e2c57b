"""Shared fixtures: a cache of flights of its own, and the flight of the default scenario."""

import hashlib
import os
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

# Compiled loops are kept on disk by the time stamp of their own module alone. A change in a function that
# they call from another module would go unnoticed: keep them by the content of all of them.
_sources = sorted(
    path
    for room in ("sins", "align")
    for folder in find_spec(f"fleetalign.{room}").submodule_search_locations
    for path in Path(folder).glob("*.py")
)
_digest = hashlib.sha256(b"".join(path.read_bytes() for path in _sources)).hexdigest()[:16]
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir(), f"fleetalign-compiled-{_digest}")))

from fleetalign.aircraft.cache import cached_flight
from fleetalign.cosim.run import alignment_window
from fleetalign.cosim.scenario import load_scenario


@pytest.fixture(scope="session", autouse=True)
def flight_cache(tmp_path_factory):
    """Flights are kept for this run of the tests alone, so that none rests on an older flight."""
    previous = os.environ.get("FLEETALIGN_CACHE")
    folder = tmp_path_factory.mktemp("flights")
    os.environ["FLEETALIGN_CACHE"] = str(folder)
    yield folder
    if previous is None:
        del os.environ["FLEETALIGN_CACHE"]
    else:
        os.environ["FLEETALIGN_CACHE"] = previous


@pytest.fixture(scope="session")
def gao2009():
    """The bundled scenario."""
    return load_scenario("gao2009")[1]


@pytest.fixture(scope="session")
def flight(flight_cache, gao2009):
    """Its whole flight."""
    return cached_flight(gao2009.flight)[0]


@pytest.fixture(scope="session")
def window(flight, gao2009):
    """The part of it in which alignment takes place."""
    return alignment_window(gao2009, flight)
