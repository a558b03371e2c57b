"""Shared fixtures: a cache of flights of its own, and the flight of the default scenario."""

import hashlib
import os
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

# As the program has it (`cosim.cli`); numpy reads it when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest

# Compiled loops are kept on disk by the time stamp of their own module alone. A change in a function that
# they call from another module would go unnoticed: keep them by the content of all of them.
_sources = sorted(
    path
    for room in ("sins", "network", "network.localization", "align", "align.lmi")
    for folder in find_spec(f"fleetalign.{room}").submodule_search_locations
    for path in Path(folder).glob("*.py")
)
_digest = hashlib.sha256(b"".join(path.read_bytes() for path in _sources)).hexdigest()[:16]
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir(), f"fleetalign-compiled-{_digest}")))

from fleetalign.aircraft.cache import cached_flight
from fleetalign.cosim import cli
from fleetalign.cosim.run import alignment_window
from fleetalign.cosim.scenario import load_scenario, replaced
from fleetalign.network.localization.problem import NodeOutcome
from fleetalign.network.record import FixFate, NetworkRecord
from fleetalign.sins import earth
from matplotlib.figure import Figure


@pytest.fixture(scope="session", autouse=True)
def flight_cache(tmp_path_factory):
    """Flights are kept for this run of the tests alone, so that none rests on an older flight."""
    previous = os.environ.get("FLEETALIGN_CACHE")
    base = tmp_path_factory.getbasetemp()
    # Side by side, all workers share them: their folders stand in that of the run.
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "flights"
    folder.mkdir(exist_ok=True)
    os.environ["FLEETALIGN_CACHE"] = str(folder)
    yield folder
    if previous is None:
        del os.environ["FLEETALIGN_CACHE"]
    else:
        os.environ["FLEETALIGN_CACHE"] = previous


@pytest.fixture
def command(monkeypatch, capfd):
    """Runs the command line; returns (status, standard output, standard error)."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["fleetalign", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        out, err = capfd.readouterr()
        return exit_.value.code, out, err

    return call


@pytest.fixture
def undrawn(monkeypatch):
    """Figures of reports stay empty: to draw them is most of the work of a short run."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **how: file.write("<svg></svg>"))


@pytest.fixture(scope="session")
def gao2009():
    """The default scenario, on fixes of the fleet's network."""
    return load_scenario("gao2009")[1]


@pytest.fixture(scope="session")
def stated():
    """The same flight and sensors, on fixes of stated noise and delay; without its variants."""
    return replaced(load_scenario("stated_fixes")[1], {"variants": {}}, "test")


@pytest.fixture(scope="session")
def flight(flight_cache, gao2009):
    """Its whole flight."""
    return cached_flight(gao2009.flight)[0]


@pytest.fixture(scope="session")
def window(flight, gao2009):
    """The part of it in which alignment takes place."""
    return alignment_window(gao2009, flight)


@pytest.fixture(scope="session")
def a_network_record():
    """Makes records of a network whose estimator is consistent: nodes fly with the own ship.

    A fifth of the nodes are anchors, node 1 among them; node 2 is never located, the own ship has no fix at
    epochs 0 and 1 and loses that of epoch 2; the others come 5 to 60 ms late.
    """

    def make(time, own_lla, nodes=10, seed=1):
        rng = np.random.default_rng(seed)
        k, n = len(time), nodes
        spot = rng.uniform([-15e3, -15e3, -2e3], [15e3, 15e3, 500.0], (n, 3))
        spot[0] = 0.0
        anchor = np.arange(n) % 5 == 1
        outcome = np.where(anchor, NodeOutcome.ANCHOR, NodeOutcome.LOCATED) * np.ones((k, 1), np.int64)
        outcome[:, 2] = NodeOutcome.SINGULAR
        sd = np.array([10.0, 12.0, 40.0, 0.2, 0.2, 0.5])
        error = sd * rng.standard_normal((k, n, 6))
        error[:, 2] = np.nan
        sd_n = np.where(np.isfinite(error[..., :3]), sd[:3], np.nan)
        fate = np.full(k, FixFate.DELIVERED)
        fate[:2], fate[2] = FixFate.TOO_FEW_NEIGHBOURS, FixFate.LOST
        link_time = np.arange(time[0], time[-1] + 1e-6, 1.0)
        linked = np.linalg.norm(spot[:, None] - spot, axis=2) < 12e3
        np.fill_diagonal(linked, False)
        head = np.zeros((len(link_time), n), bool)
        head[:, 3] = True
        return NetworkRecord(
            time=time,
            lla=earth.displaced(own_lla[:, None], np.tile(spot, (k, 1, 1))),
            anchor=anchor,
            error_n=error[..., :3],
            sd_n=sd_n,
            velocity_error_n=error[..., 3:],
            outcome=outcome,
            cov=np.tile(np.diag(sd**2), (k, 1, 1)),
            fate=fate.astype(np.int64),
            delay=np.where(fate == FixFate.DELIVERED, rng.uniform(0.005, 0.06, k), np.nan),
            fleet_delay=rng.gamma(4.0, 0.006, 20 * k),
            link_time=link_time,
            linked=np.tile(linked, (len(link_time), 1, 1)),
            head=head,
            maker=0,
            sent=22 * k,
            delivered=20 * k,
            queued=k // 2,
            transmissions=33 * k,
            slots_used=30 * k,
            slots=200 * k,
        )

    return make
