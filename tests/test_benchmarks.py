"""The benchmarks run, compare like with like, and write their table."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fleetalign.align.filters import FILTERS, align
from fleetalign.sins import attitude
from fleetalign.sins.mechanization import mechanize
from rich.progress import Progress

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def benchmarks(flight_cache):
    """The package at the root of the repository, which is not installed, and material of its quick size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        import benchmarks
        import benchmarks.__main__
        import benchmarks.harness
        import benchmarks.material
        import benchmarks.numpy_filter
        import benchmarks.peers

        yield benchmarks


@pytest.fixture(scope="module")
def material(benchmarks):
    return benchmarks.material.prepare(benchmarks.harness.QUICK)


def test_quick_run_writes_the_table(benchmarks, tmp_path):
    out = tmp_path / "docs" / "benchmarks.md"
    assert benchmarks.__main__.main(["--quick", "--out", str(out)]) == 0
    text = out.read_text("utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + 20
    assert all(row.count("|") == 7 for row in rows)
    assert "python -m benchmarks --quick" in text
    assert f"- numpy: {np.__version__}" in text
    for name in (*FILTERS, "Mechanisation", "flight", "runs", "gtsam", "filterpy", "sidereon"):
        assert any(name in row for row in rows), name


@pytest.mark.parametrize("name", FILTERS)
def test_numpy_filter_is_the_compiled_one(benchmarks, material, name):
    arguments = material.alignment(name)
    reference = benchmarks.numpy_filter.NumpyFilter(*arguments).align()
    ours = align(*arguments)
    phi = attitude.misalignment(ours.q_nb[-1], reference.navigation.q_nb)
    assert np.max(np.abs(phi) / ours.sd[-1, 6:9]) < 1e-3
    assert np.max(np.abs(ours.v_n[-1] - reference.navigation.v_n) / ours.sd[-1, 3:6]) < 1e-3
    assert np.sqrt(np.diag(reference.P)) == pytest.approx(ours.sd[-1], rel=1e-3, abs=1e-12)


def test_resampled_record_ends_where_the_flight_does(benchmarks, material):
    record = benchmarks.material.resampled(material.flight, 30_000)
    history = mechanize(record.time, record.dtheta_b, record.dv_b, record.initial, material.flight.gravity)
    assert history.v_n[-1] == pytest.approx(record.final.v_n, abs=0.05)
    assert history.lla[-1, 2] == pytest.approx(record.final.lla[2], abs=2.0)


def test_absent_peers_are_named(benchmarks, material, monkeypatch):
    monkeypatch.setattr(benchmarks.peers, "package_version", lambda name: None)
    with Progress(disable=True) as progress:
        rows = benchmarks.peers.rows(benchmarks.harness.Harness(benchmarks.harness.QUICK, progress), material)
    assert len(rows) == len(benchmarks.peers.PEERS)
    assert {row.reference for row in rows} == {"not installed"}


def test_sidereon_does_the_same_work(benchmarks, material):
    pytest.importorskip("sidereon")
    peer = next(p for p in benchmarks.peers.PEERS if p.subject.startswith("StrapdownMechanizer"))
    theirs, ours = peer.make(material)(), benchmarks.peers._mechanization(material)()
    assert theirs.position_ecef_m == pytest.approx(
        benchmarks.peers.earth.ecef_from_lla(ours.lla[-1]), abs=0.1, rel=0
    )


def test_subjects_take_turns(benchmarks):
    calls = []
    with Progress(disable=True) as progress:
        harness = benchmarks.harness.Harness(benchmarks.harness.FULL, progress)
        subjects = {"a": partial(calls.append, "a"), "b": partial(calls.append, "b")}
        times = harness.times("turns", subjects, rounds=2, repeats={"a": 2}, clock=lambda: float(len(calls)))
    assert "".join(calls) == "ab" + "aab" * 2
    assert times["a"].seconds == (1.0,) * 4
    assert times["b"].best == times["b"].median == 1.0
