"""Shared fixtures: a cache of flights of its own, and the flight of the default scenario."""

import os

import pytest
from fleetalign.aircraft.cache import cached_flight
from fleetalign.cosim.run import alignment_window
from fleetalign.cosim.scenario import load_scenario


@pytest.fixture(scope="session", autouse=True)
def flight_cache(tmp_path_factory):
    """Flights are kept for this test session alone, so that no test rests on an older flight."""
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
