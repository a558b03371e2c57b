"""The network by itself: figures of its draws, verdicts by stated rules, and the command."""

import io
import json
import os
import threading
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from fleetalign.cosim import localize_studies
from fleetalign.cosim.drawing import svg
from fleetalign.cosim.localize import LocalizeStudy, run_study
from fleetalign.cosim.localize_figures import draw_delays
from fleetalign.cosim.localize_flight import Figure3, flights, table_2
from fleetalign.cosim.localize_paper import (
    RADII_M,
    RANGING_ERRORS,
    Figure2,
    equations,
    equations_table,
    figure_2,
    figure_2_of,
)
from fleetalign.cosim.localize_report import indicator_rows, localize_tables, summarize
from fleetalign.cosim.localize_verdicts import TABLE_2, figure_2_verdicts, figure_3_verdicts
from fleetalign.cosim.network_score import plain
from fleetalign.cosim.pages import number
from fleetalign.cosim.parallel import in_order
from fleetalign.cosim.run import generator
from fleetalign.cosim.still import Drawn, draw_still, pooled, restricted
from fleetalign.network.fleet import FleetSettings, draw_formation
from fleetalign.network.fleet_network import FleetNetwork
from fleetalign.network.radio import RadioSettings
from rich.console import Console

SMALL = FleetNetwork(fleet=FleetSettings(nodes=16, anchor_share=0.4), radio=RadioSettings(altitude_sd_m=10.0))


def small_study(flight, **changes) -> LocalizeStudy:
    few = {"draws": 3, "seed": 5, "figure_2_draws": 1, "figure_3_s": 25.0}
    return LocalizeStudy(SMALL, flight, 500.0, **few | changes)


@pytest.fixture(scope="module")
def study(flight):
    return small_study(flight)


@pytest.fixture(scope="module")
def results(study):
    return run_study(study)


def test_results_come_in_the_order_of_the_items():
    first = threading.Event()

    def work(item):
        if item == 0:
            first.wait(1.0)
        first.set()
        return item

    assert list(in_order(work, range(20))) == list(range(20))


def test_what_has_not_begun_after_an_exception_is_not_done():
    done = []

    def work(item):
        if item == 0:
            raise KeyError(item)
        threading.Event().wait(0.05)
        done.append(item)

    with pytest.raises(KeyError):
        list(in_order(work, range(200)))
    assert len(done) < 100


def test_pooled_figures_are_those_of_the_nodes_that_have_error_and_bound():
    rng = np.random.default_rng(1)
    nan = np.nan
    draws = [
        Drawn(
            error=np.array([6.0, 9.0, nan, 5.0]),
            bound=np.array([4.0, 6.0, 1.0, nan]),
            flipped=np.array([True, False, False, True]),
            range=100.0,
            own_variance=np.array([1.0, 4.0, 9.0]),
        )
    ] * 2
    found = pooled(draws)
    assert (found["coverage"], found["localizable"], found["flipped"]) == (0.5, 0.75, 0.5)
    assert found["rmse_over_crlb"] == pytest.approx(1.5)
    assert found["node_over_crlb"] == pytest.approx(1.5)
    assert found["rmse_over_crlb_sd"] == pytest.approx(0.0, abs=1e-9)
    assert found["position_error_m"] == 7.5
    assert found["position_error_over_range"] == 0.075
    assert list(found["own_ship_crlb_m"]) == [1, 2, 3]

    # 400 draws of 10 nodes of three components: the ratio's relative standard deviation is 1/sqrt(24,000).
    many = []
    for _ in range(400):
        bound = rng.uniform(1, 2, 10)
        size = np.sqrt(rng.chisquare(3, 10) / 3) * bound
        many.append(replace(draws[0], error=size, bound=bound, flipped=np.zeros(10, bool)))
    found = pooled(many)
    assert found["rmse_over_crlb"] == pytest.approx(1.0, abs=4 / np.sqrt(24_000))
    assert found["rmse_over_crlb_sd"] == pytest.approx(1 / np.sqrt(24_000), rel=0.2)


def test_no_estimates_leave_no_figures():
    nothing = np.full(3, np.nan)
    drawn = Drawn(nothing, nothing, np.zeros(3, bool), np.nan, nothing)
    found = plain(pooled([drawn]))
    assert (found["coverage"], found["rmse_over_crlb"], found["crlb_m"]) == (0.0, None, None)
    assert found["own_ship_crlb_m"] == [None] * 3


def test_draws_are_the_fleets_of_the_runs():
    still = draw_still(SMALL, partial(generator, 5, 2))
    formation = draw_formation(SMALL.fleet, generator(5, 2, "fleet"))
    np.testing.assert_array_equal(still.x, formation.home)
    problem = still.problem("leach")
    assert still.head[problem.links].any(axis=1).all()
    assert len(problem.links) < len(still.problem("dmdg").links)
    assert problem.height is not None
    assert problem.height_sd == 10.0


def test_a_problem_is_restricted_to_some_of_its_nodes():
    whole = draw_still(SMALL, partial(generator, 5, 2)).problem("dmdg")
    kept = np.array([0, 3, 7, 9])
    part = restricted(whole, kept)
    among = np.isin(whole.links, kept).all(axis=1)
    np.testing.assert_array_equal(kept[part.links], whole.links[among])
    np.testing.assert_array_equal(part.ranges, whole.ranges[among])
    np.testing.assert_array_equal(part.anchor, whole.anchor[kept])


def test_published_equations_stand_beside_the_chain():
    rows = {row["method"]: row for row in equations_table(list(equations(1, 6)))}
    # 6 draws of 40 nodes: the standard deviation of the ratio is some 6 %.
    assert rows["production chain"]["rmse_over_crlb"] == pytest.approx(1.0, abs=0.2)
    assert rows["printed (3)-(4), weights (5)-(9)"]["rmse_over_crlb"] > 20
    assert rows["DV-distance alone"]["rmse_over_crlb"] > 5
    chain, squared = rows["production chain, NLOS"], rows["chain with squared loss, NLOS"]
    assert chain["rmse_over_crlb"] < squared["rmse_over_crlb"]
    assert {name: row["draws"] for name, row in rows.items()} == {
        name: 3 if name.endswith("NLOS") else 6 for name in rows
    }


def test_figure_2_loses_coverage_and_accuracy():
    found = figure_2_of(list(figure_2(1, 2)))
    for kind in ("dmdg", "leach"):
        assert found.coverage[kind].shape == (len(RADII_M), len(RANGING_ERRORS))
    assert (found.coverage["leach"] <= found.coverage["dmdg"]).all()
    assert (found.coverage["dmdg"][2:] == 1).all()
    assert (found.coverage["dmdg"][0] < 0.2).all()
    assert (np.diff(found.coverage["dmdg"], axis=1) <= 0).all()
    assert found.error["dmdg"][3, 0] < 0.3 * found.error["dmdg"][3, -1]
    assert found.error["dmdg"][3, 0] < found.error["leach"][3, 0]


def a_figure_2() -> Figure2:
    shape = len(RADII_M), len(RANGING_ERRORS)
    leach = np.full(shape, 0.9)
    leach[:, -1] = 0.81
    return Figure2(
        coverage={"dmdg": np.ones(shape), "leach": leach},
        error={"dmdg": np.full(shape, 100.0), "leach": np.full(shape, 400.0)},
        relative={"dmdg": np.full(shape, 0.013), "leach": np.full(shape, 0.05)},
    )


def test_what_fits_the_paper_is_called_reproduced():
    assert all(verdict.reproduced for verdict in figure_2_verdicts(a_figure_2()))


@pytest.mark.parametrize("statement", range(4))
def test_what_does_not_is_not(statement):
    figure = a_figure_2()
    if statement == 0:
        figure.coverage["dmdg"][0, 3] = 0.9
    elif statement == 1:
        figure.relative["dmdg"][:, 0] = 0.02
    elif statement == 2:
        figure.coverage["leach"][:, -1] = 0.9
    else:
        figure.error["leach"][:] = 900.0
    verdicts = figure_2_verdicts(figure)
    assert [verdict.reproduced for verdict in verdicts[:4]] == [i != statement for i in range(4)]
    # Coverage fails at 5 km alone.
    assert verdicts[4].reproduced == (statement == 0)


def test_one_radius_has_to_give_all():
    figure = a_figure_2()
    figure.relative["dmdg"][[0, 2, 3], 0] = 0.05
    figure.error["leach"][1] = 900.0
    *_, ratio, all_ = figure_2_verdicts(figure)
    assert ratio.reproduced
    assert not all_.reproduced
    assert ratio.line.startswith("Reproduced at 5 km and 20 km and 50 km alone: an error under DMDG")
    assert "4.0 at 5 km (+0.0 %), 9.0 at 10 km (+125 %)" in ratio.why
    assert all_.line.startswith("Not reproduced at any radius: ")
    assert "DMDG's error fits at 10 km alone." in all_.why


def test_a_verdict_tells_how_far_off_the_paper_it_is():
    figure = a_figure_2()
    figure.relative["dmdg"][:, 0] = [0.0143, 0.0117, 0.13, np.nan]
    figure.coverage["dmdg"][3, 5] = 0.86
    figure.coverage["leach"][:, -1] = [0.8532, 0.7031, 0.95, 0.0]
    full, error, leach, _, all_ = figure_2_verdicts(figure)
    assert "100.0 % at 20 km (+0.0 points), 86.0 % at 50 km (-14.0 points)" in full.why
    assert full.where == "at 5 km"
    assert (error.reproduced, error.where) == (True, "at 5 km and 10 km alone")
    assert error.why.startswith("It is 1.4 % at 5 km (+10.0 %), 1.2 % at 10 km (-10.0 %), 13.0 % at 20 km")
    assert error.why.endswith(" 20 km (+900 %), undefined at 50 km.")
    assert leach.where == "at 5 km alone"
    assert "85.3 % at 5 km (+5.0 points), 70.3 % at 10 km (-10.0 points)" in leach.why
    assert all_.where == "at 5 km alone"
    assert "The ratio of errors fits at every radius." in all_.why


def a_figure_3(*sd: float, high: float = 10.7) -> Figure3:
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((5000, 3))
    error = {"ranges alone": noise * sd, "ranges and altitude": noise * [*sd[:2], high]}
    rmse = {name: np.abs(e) for name, e in error.items()}
    return Figure3(np.arange(5000.0), error, rmse, 16e3, np.array(sd), np.array([*sd[:2], high]), 50e3)


def test_table_2_is_judged_by_axis():
    x, y, z, sizes = figure_3_verdicts(a_figure_3(9.8, 13.3, 47.0))
    assert (x.reproduced, y.reproduced, z.reproduced) == (True, True, False)
    assert x.where == "by ranges alone, on one fleet with links to 50 km"
    off = np.sqrt(np.mean(a_figure_3(9.8, 13.3, 47.0).error["ranges alone"][:, 2] ** 2)) / 10.675 - 1
    assert f"m (+{100 * off:.0f} %; bound of one instant 47.0 m)" in z.why
    assert "it takes another measurement" in z.why
    assert z.why.count("With the altitude it fits") == 1
    # The paper's RMSE over its absolute error is about twice that of a normal error.
    assert not sizes.reproduced
    assert "2.42, 1.98, 2.54 there and 1.2" in sizes.why
    assert " 1.25 (-36." in sizes.why
    _, _, z, _ = figure_3_verdicts(a_figure_3(9.8, 13.3, 10.0))
    assert z.reproduced
    assert "another measurement" not in z.why


def test_table_2_holds_size_mean_and_rmse():
    figure = a_figure_3(10.0, 10.0, 10.0)
    figure.error["ranges alone"][:] += [5.0, 0.0, 0.0]
    row = table_2(figure)["ranges alone"]
    assert row["size_of_mean_m"][0] == pytest.approx(5.0, abs=0.5)
    assert row["rmse_m"][0] == pytest.approx(np.sqrt(125), rel=0.05)
    assert row["mean_size_m"][1] == pytest.approx(10 / np.sqrt(np.pi / 2), rel=0.05)
    assert row["relative"][1] == pytest.approx(row["mean_size_m"][1] / 16e3)
    assert [len(values) for values in TABLE_2.values()] == [3, 3, 3]


def test_flights_measure_what_they_say():
    networks = flights(SMALL)
    assert networks["ranges alone"].radio.altitude_sd_m is None
    assert networks["ranges and range rates"].radio.range_rate_sd_mps == SMALL.radio.range_rate_sd_mps
    assert networks["ranges and altitude"].radio.range_rate_sd_mps == 30.0
    assert {network.radio.range_sd_m for network in networks.values()} == {50.0}


def test_a_study_holds_both_protocols(study, results):
    summary = summarize("gao2009", study, results)
    json.dumps(summary, allow_nan=False)
    for kind in ("dmdg", "leach"):
        told = summary["protocols"][kind]
        assert told["ranges"]["draws"] == study.draws
        assert sum(told["network"]["fates"].values()) == study.draws
    dmdg, leach = (summary["protocols"][kind] for kind in ("dmdg", "leach"))
    assert leach["ranges"]["crlb_m"] > dmdg["ranges"]["crlb_m"]
    assert leach["network"]["transmissions_per_packet"] > dmdg["network"]["transmissions_per_packet"]
    three = summary["figure_3"]
    assert three["duration_s"] == pytest.approx(25)
    up, bound = three["table_2"]["ranges alone"]["rmse_m"][2], three["bound_m"]["ranges alone"][2]
    # 26 epochs: a standard deviation of 14 %; other epochs than those of the bound.
    assert up == pytest.approx(bound, rel=0.6)
    assert three["bound_m"]["ranges and altitude"][2] < 11
    names = [name for name, _, _ in indicator_rows(summary)]
    assert {"coverage", "RMSE / CRLB", "time synchronism, sent", "link consumption"} <= set(names)
    assert len(summary["verdicts"]) == 9
    assert all(verdict["line"].endswith(".") for verdict in summary["verdicts"])


def test_time_synchronism_is_that_of_arrived_and_of_sent_packets(study, results):
    summary = summarize("gao2009", study, results)
    leach = summary["protocols"]["leach"]["network"]
    leach["fleet_delay_ms"]["within_50_ms"], leach["packets_delivered"] = 0.5, 0.25

    def cell(row):
        return next(
            cells[1] for name, cells, _ in indicator_rows(summary) if name == f"time synchronism, {row}"
        )

    assert (cell("arrived"), cell("sent")) == ("50.0 %", "12.5 %")
    leach["fleet_delay_ms"]["within_50_ms"] = None
    assert (cell("arrived"), cell("sent")) == (number(None, 1),) * 2


def test_tables_fit_a_terminal_of_80_columns(study, results):
    summary = summarize("gao2009", study, results)
    network = summary["protocols"]["dmdg"]["network"]
    network["nees"], network["nees_band95"] = 123.456, [5.25, 16.75]
    summary["equations"]["methods"][-1] |= {"rmse_over_crlb": 4321.123, "rmse_over_crlb_sd": 1234.567}
    terminal = Console(width=80, file=io.StringIO())
    for table in localize_tables("In-flight alignment on delayed fleet fixes", summary):
        terminal.print(table)
    told = terminal.file.getvalue()
    assert "…" not in told
    for figure in ("outside: 123.46", "5.25 to 16.75", "4321.123 ± 1234.567"):
        assert figure in told


def test_the_delay_figure_tells_what_becomes_of_packets_that_never_arrive(results):
    def told(**changes):
        return svg(draw_delays({"leach": replace(results.scores["leach"], **changes)}))

    some = told(sent=1000, delivered=500, queued=180, fleet_delay=np.full(500, 0.2))
    assert "LEACH: 50.0 % delivered" in some
    assert "LEACH's others never arrive: 18.0 % in queues when time ends, 32.0 % lost" in some
    none = told(sent=1000, delivered=0, queued=1000, fleet_delay=np.empty(0))
    assert "never arrive: 100.0 % in queues" in none
    assert "never arrive" not in told(sent=0, delivered=0, queued=0, fleet_delay=np.empty(0))


def test_the_same_study_gives_the_same_results_on_one_core(study, flight, results, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    steps = []
    again = run_study(small_study(flight), lambda done, total: steps.append((done, total)))
    assert summarize("a", study, again) == summarize("a", study, results)
    done, total = steps[-1]
    assert done == pytest.approx(total)
    assert all(a < b for (a, _), (b, _) in pairwise(steps))


def test_the_command_writes_a_page_and_its_data(command, tmp_path, monkeypatch):
    few = partial(LocalizeStudy, figure_2_draws=1, figure_3_s=5.0)
    monkeypatch.setattr(localize_studies, "LocalizeStudy", few)
    status, out, _ = command("localize", "--draws", 2, "--nodes", 16, "--seed", 3, "--out", tmp_path / "new")
    assert status == 0
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"localize.json", "localize.html"}
    summary = json.loads((tmp_path / "new/localize.json").read_text())
    assert (summary["scenario"], summary["seed"], summary["draws"]) == ("gao2009", 3, 2)
    assert summary["nodes"] == 16
    assert "RMSE / CRLB" in out
    assert "eproduced at 5 km: DMDG covers all nodes" in " ".join(out.split())
    html = (tmp_path / "new/localize.html").read_text("utf-8")
    assert html.count("<svg") >= 5
    assert "<script" not in html
    assert "printed: LEACH" in html
    assert f"localize --draws 2 --nodes 16 --seed 3 --out {tmp_path}" in html
    for verdict in summary["verdicts"]:
        assert verdict["rule"]


def test_many_nodes_are_the_study_of_scale(command, tmp_path):
    status, out, err = command("localize", "--nodes", 400, "--json", "--out", tmp_path)
    assert (status, err) == (0, "")
    summary = json.loads(out)
    assert summary["nodes"] == 400
    assert summary == json.loads((tmp_path / "localize.json").read_text())
    assert not (tmp_path / "localize.html").exists()
    # Errors in standard deviations of a range: about the bound's at 16 links a node.
    assert 0.5 < summary["median_error_sd"] < 2
    status, out, _ = command("localize", "--nodes", 400, "--out", tmp_path)
    assert "cold start" in out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--draws", "0"], "--draws 0: allowed is [1, 100000]"),
        (["--nodes", "1"], "--nodes = '1': must be 2 or more"),
        (["--nodes", "2"], "--nodes 2: allowed is [10, 2000000] with gao2009: fixes.fleet: anchor_share"),
        (
            ["--nodes", "9"],
            "--nodes 9: allowed is [10, 2000000] with gao2009: under leach: fixes: heads = 10",
        ),
        (["--nodes", "99999999"], "--nodes = '99999999': must be 2000000 or less"),
        (["--nodes", "many"], "--nodes = 'many': must be a whole number"),
        (["stated_fixes"], "fixes.kind = 'simulated': there is no network to localize"),
        (["--out", "/proc/nowhere"], "--out /proc/nowhere: cannot be written"),
    ],
)
def test_bad_input_is_told_in_one_line(command, arguments, told, tmp_path):
    where = [] if "--out" in arguments else ["--out", tmp_path]
    status, out, err = command("localize", *arguments, *where)
    assert (status, out) == (2, "")
    assert told in " ".join(err.split())
    assert err.startswith("fleetalign: ")
    assert len(err.splitlines()) == 1
