"""What a campaign's rows come to: errors, reasons, histories and the runs that are named."""

import gc
import json
import pickle
import sys
from dataclasses import asdict, replace

import numpy as np
import pyarrow as pa
import pytest
from fleetalign.align.consistency import mean_band
from fleetalign.cosim.campaign import figures, report, summary
from fleetalign.cosim.campaign.incidents import NAMES
from fleetalign.cosim.campaign.ledger import Ledger, read_points
from fleetalign.cosim.campaign.plan import load_campaign
from fleetalign.cosim.campaign.shard import SCHEMA, encoded, failed_rows, sealed
from fleetalign.cosim.resampling import bootstrap_rms_interval
from fleetalign.cosim.scenario import ScenarioError
from fleetalign.cosim.score import COLUMNS


def row(run, filter="ekf_stamped", failure=None, errors=(3.0, 4.0, 2.0, 0.3, 0.4), nees=3.0, history=True):
    made = {"point": 0, "run": run, "filter": filter, "failure": failure, "nees": nees}
    made |= dict(zip(COLUMNS, [None] * 5 if errors is None else errors, strict=True))
    made |= dict.fromkeys(NAMES)
    made["history_time_s"] = [1.0, 2.0, 3.0] if history else None
    made["level_history_arcsec"] = [10.0 * run, 4.0, np.nan] if history else None
    made["heading_history_arcmin"] = [1.0, run, np.nan] if history else None
    return made


def table(rows):
    return pa.Table.from_pylist(rows, schema=SCHEMA)


def score(rows, independent=True, shard_rows=1000):
    tally = summary._Tally(0, "ekf_stamped")
    for first in range(0, len(rows), shard_rows):
        tally.add(table(rows[first : first + shard_rows]))
    return tally.score(independent)


def test_figures_of_a_point_are_over_the_runs_that_have_them():
    failed = {"errors": None, "nees": None, "history": False}
    rows = [
        row(3),
        row(4, nees=9.0, errors=(5.0, 0.0, 6.0, 0.5, 0.0)) | {"heading_history_arcmin": [1.0, *[np.nan] * 2]},
        row(5, nees=3.0),
        row(6, failure="no_fix", **failed),
        row(7, failure="ValueError: x", **failed),
        row(8, failure="no_fix", **failed),
    ]
    found = score(rows)
    assert (found.runs, found.failed) == (6, 3)
    assert found.reasons == {"no_fix": 2, "ValueError: x": 1}
    assert found.nees == 5.0
    low, high = found.nees_band
    assert low < 3 < high
    assert score(rows * 20).nees_band[1] < high
    # By component: the root of half of 25, in each of the three runs.
    assert found.rms["level"][0] == pytest.approx(np.sqrt(12.5))
    assert found.rms["heading"][0] == pytest.approx(np.sqrt((4 + 36 + 4) / 3))
    assert found.rms["velocity"][0] == pytest.approx(np.sqrt(0.125))
    assert np.isnan(found.rms["level"][1:]).all()
    assert found.time_s == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(found.level_rms_arcsec, [np.sqrt(5000 / 3), 4.0, np.nan])
    np.testing.assert_allclose(found.heading_rms_arcmin, [1.0, np.sqrt(34 / 2), np.nan])


def test_intervals_hold_what_the_runs_were_drawn_from():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(400):
        rows = [row(run, errors=rng.normal(0, 2.0, 5)) for run in range(60)]
        _, low, high = score(rows).rms["heading"]
        covered += low <= 2.0 <= high
    # 95 % of 400 intervals, less some that 60 runs cost a bootstrap: 4 sd below 92 %, and some do not.
    assert 0.92 - 4 * np.sqrt(0.92 * 0.08 / 400) < covered / 400 < 1
    assert np.isnan(score([row(run) for run in range(29)]).rms["heading"][1])


def test_shards_one_after_the_other_come_to_what_all_rows_do():
    rng = np.random.default_rng(2)
    failed = {"errors": None, "nees": None, "history": False}
    rows = [row(run, failure="no_fix", **failed) for run in range(10)]  # a first shard without a figure
    for run in range(10, 80):
        made = row(run, errors=rng.normal(0, 2.0, 5), nees=rng.gamma(1.5) * 2)
        made |= {"gated": run if run % 3 else None, "dead_reckoning_s": rng.random()}
        made["largest_jump_sd"] = rng.random() if run < 40 else None
        made["level_history_arcsec"] = np.where(rng.random(3) < 0.9, rng.random(3), np.nan)
        rows.append(made)
    found, aligned = score(rows, shard_rows=10), rows[10:]
    np.testing.assert_equal(asdict(found), asdict(score(rows)) | {"befell": found.befell})
    assert found.befell == pytest.approx(score(rows).befell, rel=1e-12, nan_ok=True)
    assert (found.runs, found.failed) == (80, 10)
    errors = np.array([[r[c] for c in COLUMNS] for r in aligned])
    low, high = bootstrap_rms_interval(errors[:, 2:3])[:, 0]
    assert found.rms["heading"] == pytest.approx((np.sqrt(np.mean(errors[:, 2] ** 2)), low, high), rel=1e-12)
    assert (found.nees, found.nees_band) == (np.mean([r["nees"] for r in aligned]), mean_band(3, 70))
    histories = np.array([r["level_history_arcsec"] for r in aligned], np.float32).astype(float)
    np.testing.assert_allclose(found.level_rms_arcsec, np.sqrt(np.nanmean(histories**2, axis=0)), rtol=1e-12)
    assert found.befell["gated"] == np.mean([run for run in range(10, 80) if run % 3])
    assert found.befell["largest_jump_sd"] == max(r["largest_jump_sd"] for r in rows[10:40])


def test_histories_of_one_point_are_of_one_length():
    tally = summary._Tally(3, "ekf_stamped")
    tally.add(table([row(1)]))
    longer = {key: [1.0] * 4 for key in row(1) if "history" in key}
    with pytest.raises(ScenarioError, match="point 3: histories of several lengths"):
        tally.add(table([row(2) | longer]))


def test_no_point_is_held_whole(monkeypatch, tmp_path):
    """Of a run and filter four numbers are kept, where a row with its histories has some 140."""
    history = dict.fromkeys([key for key in row(1) if "history" in key], np.arange(40.0))
    rows = table([row(run) | history for run in range(50)])
    tally, sizes = summary._Tally(0, "ekf_stamped"), []
    for _ in range(20):
        tally.add(rows)
        sizes.append(len(pickle.dumps(vars(tally))))
    assert (sizes[-1] - sizes[0]) / (19 * 50) == pytest.approx(4 * 8, abs=1)
    plan = {"title": "T", "base": {"fixes": {"kind": "replay"}}, "coordinates": [{}]}
    monkeypatch.setattr(summary, "read_plan", lambda folder: plan)
    in_tables, in_objects = [], []

    def watched(folder):
        for point, rows in read_points(folder):
            in_tables.append(pa.total_allocated_bytes())
            in_objects.append(sys.getallocatedblocks())
            yield point, rows

    monkeypatch.setattr(summary, "read_points", watched)
    (tmp_path / "shards").mkdir()
    for number in range(84):
        (tmp_path / f"shards/p000000_r{50 * number:07d}.parquet").write_bytes(sealed(rows))
    gc.collect()
    assert summary.summarize(tmp_path).scores[0].runs == 50 * 84
    # After the first shards, which load modules: of 80 others less than one, as a table or as objects.
    assert max(in_tables[4:]) - in_tables[3] < 10 * rows.nbytes
    assert in_objects[-1] - in_objects[3] < 80 * 50


@pytest.mark.parametrize("kind", ["replay", "simulated"])
def test_runs_on_the_same_recorded_fixes_have_neither_interval_nor_band(monkeypatch, tmp_path, kind):
    rows = [row(run, errors=(1.0 + run % 3,) * 5) for run in range(40)]
    monkeypatch.setattr(summary, "read_points", lambda folder: [(0, table(rows))])
    plan = {"title": "T", "base": {"fixes": {"kind": kind}}, "coordinates": [{}]}
    monkeypatch.setattr(summary, "read_plan", lambda folder: plan)
    (point,) = summary.summarize(tmp_path).content["points"]
    assert (point["nees"], point["rms"]["level"][0]) == (3.0, pytest.approx(np.sqrt(183 / 40)))
    known = [bound is not None for bound in point["rms"]["level"]]
    assert known == ([True, False, False] if kind == "replay" else [True] * 3)
    assert (point["nees_band"] is None) == (kind == "replay")


def test_points_without_a_run_that_aligned_have_no_figures():
    found = score([row(1, failure="no_fix", errors=None, nees=None, history=False)])
    assert np.isnan(found.nees)
    assert found.nees_band is None
    assert np.isnan(found.rms["velocity"]).all()
    assert found.time_s == found.level_rms_arcsec == []


def test_a_point_has_means_and_the_greatest_jump():
    rows = [
        row(run) | {"gated": gated, "largest_jump_sd": jump}
        for run, (gated, jump) in enumerate([(3, 1.0), (5, 7.5), (None, None)])
    ]
    found = score(rows).befell
    assert (found["gated"], found["largest_jump_sd"]) == (4.0, 7.5)
    assert np.isnan(found["late"])


@pytest.mark.parametrize(("others", "joined"), [(2, True), (7, False)])
def test_points_are_joined_that_are_alike_on_the_other_axes(others, joined):
    """Three values of one axis and some of another; where these are many, a line through medians."""
    coordinates = [{"a": a, "b": b} for a in (1.0, 10.0, 100.0) for b in range(others)]
    names = "ekf_stamped", "l2linf"
    scores = [
        replace(score([row(1, errors=[p["a"] + p["b"]] * 5)]), point=i, filter=name)
        for i, p in enumerate(coordinates)
        for name in names
    ]
    axes = {"a": {"kind": "range", "log": True}, "b": {"kind": "values"}}
    plan = {"title": "T", "settings": {"axes": axes}, "coordinates": coordinates}
    figure = figures._along(summary.CampaignSummary(plan, scores, []), "a")
    ax = figure.axes[1]  # of the heading
    lines = [line for line in ax.get_lines() if len(line.get_xdata()) == 3 and line.get_linestyle() == "-"]
    assert len(lines) == (others if joined else 1) * len(names)
    expected = [[a + b for a in (1.0, 10.0, 100.0)] for b in (range(others) if joined else [others // 2])]
    for number in range(len(names)):
        mine = lines[number * len(expected) : (number + 1) * len(expected)]
        np.testing.assert_allclose([line.get_ydata() for line in mine], expected)
    assert ax.get_xscale() == "log"
    assert [text.get_text() for text in ax.texts] == ([str(b) for b in range(others)] if joined else [])
    # Dots of two filters stand beside each other.
    assert not np.isclose(lines[0].get_xdata(), lines[-1].get_xdata(), rtol=1e-3).any()


def test_points_of_a_hypercube_are_joined_by_no_line():
    rng = np.random.default_rng(3)
    coordinates = [{"a": float(a), "n": n % 3, "c": c} for n, (a, c) in enumerate(rng.random((12, 2)))]
    scores = [replace(score([row(1)]), point=i) for i in range(12)]
    plan = {"title": "T", "settings": {"axes": {"a": {}, "n": {}, "c": {}}}, "coordinates": coordinates}
    told = {axis: figures.joined(coordinates, axis) for axis in "anc"}
    assert told == {"a": figures.APART, "n": figures.MEDIANS, "c": figures.APART}
    for axis, how in told.items():
        ax = figures._along(summary.CampaignSummary(plan, scores, []), axis).axes[0]
        lengths = [len(line.get_xdata()) for line in ax.get_lines() if line.get_linestyle() == "-"]
        assert max(lengths, default=0) == (3 if how == figures.MEDIANS else 0)
        assert next(len(line.get_xdata()) for line in ax.get_lines() if line.get_marker() == "o") == 12
    assert figures.joined([{"a": 1.0}], "a") == figures.joined([{"a": 1.0}, {"a": 2.0}], "a") == figures.ALIKE


def test_replays_have_folders_of_their_own_and_runs_without_a_flight_none(tmp_path, undrawn):
    assert report.replay_command(tmp_path, {"point": 5, "run": 16, "failure": "no_fix"}) == (
        f"fleetalign run {tmp_path}/points/000005.toml --run-id 16 --out {tmp_path}/replays/p000005_r0000016"
    )
    file, folder = tmp_path / "campaign.toml", tmp_path / "out"
    file.write_text('title = "T"\nscenario = "stated_fixes"\nruns = 3\nfilters = ["ekf"]\nshard_runs = 1\n')
    campaign = load_campaign(file)
    reasons = "FlightError: phase climb", "ScenarioError: alignment", "ZeroDivisionError: of a run"
    with Ledger(folder, campaign, resume=False) as ledger:
        for shard, reason in zip(campaign.shards, reasons, strict=True):
            ledger.add(shard, encoded(failed_rows(campaign.scenario(0), 0, shard.first_run, reason)))
    found = report.write_report(folder, "fleetalign report")
    page = (folder / "report.html").read_text()
    assert [f"--run-id {run}" in page for run in range(3)] == [False, False, True]
    assert page.count(report.NO_FLIGHT) == 2
    (line,) = report.told_worst(folder, found.worst)
    assert line == f"worst      ekf, {reasons[0]}: {report.NO_FLIGHT}"


def test_failed_runs_are_named_first_and_then_those_furthest_out(monkeypatch, tmp_path):
    failed = {"errors": None, "nees": None}
    first = [row(run, nees=float(run)) for run in range(20)] + [row(90, failure="no_fix", **failed)]
    second = [row(91, "l2linf", nees=1.0), row(92, failure="no_fix", **failed), row(93, nees=12.5)]
    # A run that has a figure of no size, though it did not fail: there is nothing to name it by.
    second.append(row(94, nees=None))
    # The first point in two shards.
    points = [(0, table(first[:8])), (0, table(first[8:])), (1, table([{**r, "point": 1} for r in second]))]
    monkeypatch.setattr(summary, "read_points", lambda folder: points)
    plan = {"title": "T", "base": {}, "coordinates": [{"a": 1.0}, {"a": 2.0}]}
    monkeypatch.setattr(summary, "read_plan", lambda folder: plan)
    found = summary.summarize(tmp_path)
    named = [(r["point"], r["run"]) for r in found.worst if r["filter"] == "ekf_stamped"]
    assert named == [(0, 90), (1, 92), *((0, run) for run in range(19, 12, -1)), (1, 93)]
    assert [r["run"] for r in found.worst if r["filter"] == "l2linf"] == [91]
    assert [(s.point, s.filter, s.runs) for s in found.scores] == [
        (0, "ekf_stamped", 21),
        (1, "l2linf", 1),
        (1, "ekf_stamped", 3),
    ]
    content = found.content
    assert [p["at"] for p in content["points"]] == [{"a": 1.0}, {"a": 2.0}, {"a": 2.0}]
    assert content["points"][2]["rms"]["heading"][1] is None
    json.dumps(content, allow_nan=False)


def test_axes_are_told_by_the_ends_of_their_names():
    names = {
        "alignment.filters.0": "filters.0",
        "fixes.rate_hz": "rate_hz",
        "faults.imu.0.start_s": "imu.0.start_s",
        "faults.imu.1.start_s": "imu.1.start_s",
        "outages.0.start_s": "outages.0.start_s",
        "seed": "seed",
        "flight.air.seed": "air.seed",
    }
    assert report.shortest(list(names)) == list(names.values())
