"""What a campaign's rows come to: errors, reasons, histories and the runs that are named."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fleetalign.cosim.campaign import figures, report, summary
from fleetalign.cosim.campaign.incidents import NAMES
from fleetalign.cosim.score import COLUMNS


def row(run, filter="ekf_stamped", failure=None, errors=(3.0, 4.0, 2.0, 0.3, 0.4), nees=3.0, history=True):
    made = {"point": 0, "run": run, "filter": filter, "failure": failure, "nees": nees}
    made |= dict(zip(COLUMNS, [None] * 5 if errors is None else errors, strict=True))
    made |= dict.fromkeys(NAMES)
    made["history_time_s"] = [1.0, 2.0, 3.0] if history else None
    made["level_history_arcsec"] = [10.0 * run, 4.0, np.nan] if history else None
    made["heading_history_arcmin"] = [1.0, run, np.nan] if history else None
    return made


def score(rows, independent=True):
    return summary._score(0, "ekf_stamped", rows, independent)


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


@pytest.mark.parametrize("kind", ["replay", "simulated"])
def test_runs_on_the_same_recorded_fixes_have_neither_interval_nor_band(monkeypatch, tmp_path, kind):
    rows = [row(run, errors=(1.0 + run % 3,) * 5) for run in range(40)]
    monkeypatch.setattr(summary, "read_points", lambda folder: [(0, Rows(rows))])
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


class Rows(list):
    """As much of a table as is read."""

    def to_pylist(self):
        return list(self)


def test_failed_runs_are_named_first_and_then_those_furthest_out(monkeypatch, tmp_path):
    failed = {"errors": None, "nees": None}
    first = [row(run, nees=float(run)) for run in range(20)] + [row(90, failure="no_fix", **failed)]
    second = [row(91, "l2linf", nees=1.0), row(92, failure="no_fix", **failed), row(93, nees=12.5)]
    # A run that has a figure of no size, though it did not fail: there is nothing to name it by.
    second.append(row(94, nees=None))
    points = [(0, Rows(first)), (1, Rows([{**r, "point": 1} for r in second]))]
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
