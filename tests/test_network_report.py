"""The network's score, its block in the summary, and its page in the report."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band
from fleetalign.cosim.network_figures import draw_network
from fleetalign.cosim.network_report import network_tables, variant_rows
from fleetalign.cosim.network_scenery import fleet_ned
from fleetalign.cosim.network_score import NetworkScorer, delay_figures, network_summary
from fleetalign.cosim.pages import write_page
from fleetalign.cosim.score import COLUMNS, GROUPS
from fleetalign.network.localization.problem import NodeOutcome
from fleetalign.network.record import FixFate
from fleetalign.sins.units import DEG

RUNS, EPOCHS, NODES = 40, 100, 10
TIME = 500 + np.arange(EPOCHS) / 10
OWN = np.tile([30 * DEG, 120 * DEG, 1000.0], (EPOCHS, 1))


@pytest.fixture(scope="module")
def records(a_network_record):
    return [a_network_record(TIME, OWN, NODES, seed) for seed in range(RUNS)]


@pytest.fixture(scope="module")
def summary(records):
    return network_summary(records)


def test_counts_and_shares_are_those_of_the_records(summary):
    # Eight of ten nodes are no anchors, and one of these is never located.
    assert summary["coverage"] == pytest.approx(7 / 8)
    assert summary["fates"]["delivered"] == RUNS * (EPOCHS - 3)
    assert summary["fates"]["too_few_neighbours"] == 2 * RUNS
    assert summary["fates"]["lost"] == RUNS
    assert sum(summary["fates"].values()) == RUNS * EPOCHS
    assert summary["fixes_delivered"] == pytest.approx(1 - 3 / EPOCHS)
    assert summary["packets_delivered"] == pytest.approx(20 / 22)
    assert summary["packets_still_queued"] == pytest.approx(0.5 / 22)
    assert summary["transmissions_per_packet"] == pytest.approx(33 / 20)
    assert summary["slots_used"] == pytest.approx(30 / 200)


def test_errors_are_root_mean_squares_beside_what_is_stated(records, summary):
    error = np.concatenate([r.error_n[r.outcome == NodeOutcome.LOCATED] for r in records])
    assert summary["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    assert summary["position_sd_m"] == pytest.approx(np.sqrt(10**2 + 12**2 + 40**2))
    fix = summary["own_fix"]
    assert fix["sd_horizontal_m"] == pytest.approx(np.hypot(10, 12))
    assert fix["sd_velocity_mps"] == pytest.approx(np.sqrt(0.2**2 + 0.2**2 + 0.5**2))
    # 3920 fixes: a relative standard deviation of 1.1 % of each component's RMSE.
    for name in ("horizontal_m", "vertical_m", "velocity_mps"):
        assert fix[f"rmse_{name}"] == pytest.approx(fix[f"sd_{name}"], rel=0.05)


def test_what_the_estimator_did_not_state_is_not_told(a_network_record):
    record = a_network_record(TIME, OWN, NODES)
    alone = record.sd_n.copy()
    alone[:, 1:] = np.nan
    told = network_summary([replace(record, sd_n=alone)])
    assert told["position_sd_m"] is None
    assert told["own_fix"]["sd_vertical_m"] == pytest.approx(40)


def test_only_fixes_that_were_made_count(a_network_record):
    record = a_network_record(TIME, OWN, NODES)
    unmade = record.error_n.copy()
    unmade[:2, 0] = 1e6
    wrong = replace(record, error_n=unmade)
    assert network_summary([wrong])["own_fix"] == network_summary([record])["own_fix"]


def test_nees_takes_one_fix_of_each_run(records, summary):
    sd = np.sqrt(np.diagonal(records[0].cov[-1]))
    last = [np.concatenate([r.error_n[-1, 0], r.velocity_error_n[-1, 0]]) / sd for r in records]
    assert summary["nees"] == pytest.approx(np.mean(np.sum(np.square(last), axis=1)))
    assert summary["nees_band95"] == pytest.approx(mean_band(6, RUNS))
    assert summary["nees_band95"][0] < summary["nees"] < summary["nees_band95"][1]
    doubted = [replace(r, cov=r.cov / 2) for r in records]
    overconfident = network_summary(doubted)
    assert overconfident["nees"] == pytest.approx(2 * summary["nees"])
    assert network_tables(overconfident)["figures"]["nees_outside"]
    assert not network_tables(summary)["figures"]["nees_outside"]


def test_delays_have_percentiles_and_the_base_line():
    figures = delay_figures(np.linspace(0.0, 0.1, 1001))
    assert figures["mean"] == pytest.approx(50)
    assert (figures["p50"], figures["p95"], figures["p99"]) == pytest.approx((50, 95, 99))
    assert figures["within_50_ms"] == pytest.approx(501 / 1001)
    assert set(delay_figures(np.empty(0)).values()) == {None}


def test_a_silent_network_is_scored(a_network_record):
    record = a_network_record(TIME, OWN, NODES)
    silent = replace(
        record,
        fate=np.full(EPOCHS, FixFate.UNLOCALIZABLE, np.int64),
        delay=np.full(EPOCHS, np.nan),
        fleet_delay=np.empty(0),
        delivered=0,
    )
    scorer = NetworkScorer()
    scorer.add(silent)
    told = scorer.score().summary
    assert (told["nees"], told["nees_band95"], told["transmissions_per_packet"]) == (None, None, None)
    assert told["fates"]["unlocalizable"] == EPOCHS
    json.dumps(told, allow_nan=False)
    assert set(draw_network(silent, scorer.score())) == {"topology"}
    with pytest.raises(ValueError, match="no run"):
        NetworkScorer().score()


def test_figures_have_units_and_what_they_show(records):
    scorer = NetworkScorer()
    for record in records:
        scorer.add(record)
    figures = draw_network(records[0], scorer.score())
    assert figures == draw_network(records[0], scorer.score())
    for entry in ("east of the fleet's centre, km", "height, km", "cluster head", "anchor", "own ship"):
        assert f">{entry}</text>" in figures["topology"]
    assert ">node, not located</text>" in figures["topology"]
    assert ">50 ms</text>" in figures["network_delay"]
    p95 = np.percentile(scorer.score().own_delay, 95) * 1000
    assert f">95 %: {p95:.1f} ms</text>" in figures["network_delay"]
    assert ">error down, m</text>" in figures["fix"]
    assert "(39 % inside)" in figures["fix"]
    assert "(86 % inside)" in figures["fix"]
    assert sum(map(len, figures.values())) < 1e6


def test_the_fleet_is_drawn_about_its_centre(records):
    ned = fleet_ned(records[0].lla)
    # The centre of positions on a curved earth lies below the level through them, by a hair.
    np.testing.assert_allclose(ned[..., :2].mean(axis=1), 0.0, atol=1.0)
    np.testing.assert_allclose(-ned[..., 2], records[0].lla[..., 2])
    apart = np.linalg.norm(ned[0, 3] - ned[0, 4])
    assert 1e3 < apart < 40e3


def content_of(level: float, failed: int = 0) -> dict:
    at_bound = {name: [1.0, 0.9, 1.1] for name in GROUPS}
    stamped = dict.fromkeys(COLUMNS, 10.0) | {"failed_runs": 0, "over_bound": at_bound}
    ours = stamped | {"roll_arcsec": 10 * level, "pitch_arcsec": 10 * level, "failed_runs": failed}
    paired = at_bound | {"level": [level, level - 0.1, level + 0.1]}
    return {
        "filters": {"ekf_stamped": stamped, "l2linf": ours},
        "paired": {"l2linf/ekf_stamped": paired},
    }


def test_variants_make_one_table(tmp_path, summary):
    content = {
        **content_of(1.0),
        "network": summary,
        "variants": {
            "LEACH": content_of(1.25, failed=2) | {"network": summary},
            "no network": content_of(1.1),
        },
    }
    rows = variant_rows(content)
    assert [row["name"] for row in rows] == ["as stated", "LEACH", "no network"]
    assert rows[1]["ratios"]["level"][0] == pytest.approx(1.25)
    write_page(
        tmp_path / "page.html",
        "network.html.j2",
        {},
        network=None,
        variants=rows,
        columns=[(column, column, 1) for column in COLUMNS],
    )
    html = (tmp_path / "page.html").read_text("utf-8")
    assert re.findall("<h2>(.*)</h2>", html) == ["Variants"]  # of no network, for there is none
    leach = re.findall(r"<td[^>]*>(.*?)</td>", html[html.index("<td>LEACH") :].split("</tr>")[0])
    assert leach[0] == "LEACH"
    assert leach[1].startswith("1.00<")
    assert leach[4].startswith("1.25<")
    assert "1.15 to 1.35" in leach[4]
    assert leach[7] == "12.5"
    assert leach[-3] == "97.0 %"
    assert leach[-1] == "2"
    assert variant_rows(content_of(1.0)) == []


def test_the_page_tells_the_four_indicators(tmp_path, records, summary):
    scorer = NetworkScorer()
    for record in records:
        scorer.add(record)
    tables = network_tables(summary)
    figures = draw_network(records[0], scorer.score())
    write_page(tmp_path / "page.html", "network.html.j2", figures, network=tables, variants=[], columns=[])
    text = re.sub(r"<[^>]+>", " ", (tmp_path / "page.html").read_text("utf-8"))
    for indicator in ("coverage", "accuracy, own ship", "time synchronism", "link consumption"):
        assert indicator in text
    assert "87.5 %" in text
    assert f"{summary['delay_ms']['p99']:.1f}" in text
    assert [name for name, _, _ in tables["fates"]] == ["delivered", "too few neighbours", "lost"]
