"""The report: one file that needs nothing else, with the numbers of the summary."""

import re
import tomllib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fleetalign.aircraft.flight import Flight, Phase
from fleetalign.align.bound import Knowledge
from fleetalign.align.consistency import mean_band
from fleetalign.align.estimate import FixOutcome, NavStatus
from fleetalign.cosim.outputs import manifest, summarize
from fleetalign.cosim.palette import filter_color
from fleetalign.cosim.report import to_toml, write_report
from fleetalign.cosim.scenario import Scenario, load_scenario, replaced
from fleetalign.cosim.score import FilterScore
from fleetalign.network.fixes import write_fixes
from fleetalign.network.source import draw_fixes
from fleetalign.sins import attitude, earth
from fleetalign.sins.units import DEG

RUNS = 40
SD = np.array([20.0, 20.0, 1.3, 0.015, 0.014])


def a_flight() -> Flight:
    time = np.arange(6001) / 100
    v_n = np.tile([140.0, 140.0, -1.0], (len(time), 1))
    lla = earth.displaced(np.array([30 * DEG, 120 * DEG, 1000.0]), v_n * time[:, None])
    q_nb = attitude.from_euler(0.3 * np.sin(time), 0.05, 45 * DEG)
    phases = (Phase("takeoff", 0, 5), Phase("level", 5, 20), Phase("s_maneuver", 20, 60))
    zeros = np.zeros_like(v_n)
    return Flight(time, lla, v_n, q_nb, zeros, zeros, phases, "A-1")


def a_score(
    name: str, rng: np.random.Generator, scale: float, delay_s: float, runs: int = RUNS
) -> FilterScore:
    """A score of a filter whose error is ``scale`` times what it takes it for."""
    time = np.arange(1, 401) / 10
    shape = (runs, len(time))
    return FilterScore(
        name=name,
        time=time,
        errors=scale * SD * rng.standard_normal((*shape, 5)),
        position_errors=rng.standard_normal((*shape, 3)),
        position_nees=rng.chisquare(3, shape),
        nees=scale**2 * rng.chisquare(3, shape),
        nis=scale**2 * rng.chisquare(6 * 400, runs) / 400,
        fused=np.full(runs, 400),
        delay=np.full(shape, delay_s),
        status=np.full(shape, NavStatus.AIDED),
        fix_outcomes=dict.fromkeys(FixOutcome, 0) | {FixOutcome.FUSED: 400 * runs, FixOutcome.GATED: 7},
        failures={},
    )


def write(path, scenario: Scenario, scores: dict[str, FilterScore], floor=SD) -> tuple[str, dict]:
    """The text of a report, and the summary that it was made of."""
    flight = a_flight()
    bounds = {name: np.tile(floor, (400, 1)) for name in Knowledge}
    summary = summarize("a_name", scenario, 7, flight, scores, bounds)
    about = manifest("a_name", scenario, 7, RUNS, "fleetalign run a_name --seed 7 --out 'a & b'")
    write_report(path, scenario, flight, flight.window(20, 60), scores, bounds, summary, about)
    return path.read_text("utf-8"), summary


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> tuple[str, dict]:
    rng = np.random.default_rng(1)
    scores = {"ekf": a_score("ekf", rng, 2.0, 0.0), "l2linf": a_score("l2linf", rng, 1.0, 0.025)}
    scores["ekf"] = replace(scores["ekf"], failures={3: "diverged", 5: "not_finite"})
    _, scenario = load_scenario("gao2009")
    return write(tmp_path_factory.mktemp("report") / "report.html", scenario, scores)


def table_after(html: str, mark: str) -> list[list[str]]:
    """Rows of the first table after some text, their cells without markup."""
    table = html[html.index(mark) :].split("<table", 1)[1].split("</table>", 1)[0]
    rows = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.S) for row in table.split("<tr")[1:]]
    return [[" ".join(re.sub(r"<[^>]*>", " ", cell).split()) for cell in row] for row in rows]


def test_headline_table_shows_the_summary(report):
    html, summary = report
    head, ekf, l2linf, bound, unknown, _ = table_after(html, 'class="lead"')
    assert head[1:4] == ["Roll, arcsec", "Pitch, arcsec", "Heading, arcmin"]
    for cells, name in ((ekf, "ekf"), (l2linf, "l2linf")):
        row = summary["filters"][name]
        low, high = row["ci95"]["roll_arcsec"]
        assert cells[:2] == [name, f"{row['roll_arcsec']:.1f} {low:.1f} to {high:.1f}"]
        assert cells[5].startswith(f"{row['v_north_mps']:.3f} ")
    assert bound[:6] == ["bound, stamps known", "20.0", "20.0", "1.30", "0.015", "0.014"]
    assert unknown[0] == "bound, delay unknown"
    ratio, low, _, high = ekf[6].split()
    np.testing.assert_allclose(float(ratio), 2.0, atol=0.4)
    assert float(low) < float(ratio) < float(high)
    low, high = mean_band(3, RUNS)
    assert ekf[9] == f"{summary['filters']['ekf']['nees']:.2f} &#x2715; {low:.2f} to {high:.2f}"
    assert "&#x2715;" not in l2linf[9] + l2linf[10]
    assert [ekf[11], l2linf[11]] == ["2", "0"]
    assert filter_color("ekf") in html


def test_headline_says_who_reaches_the_bound_and_what_failed(report):
    html, _ = report
    lead = re.search(r'class="lead">(.*?)</p>', html, re.S)[1]
    assert re.search(r"l2linf \(\d\d\.\d arcsec\) reaches the bound in level \(20\.0 arcsec\)", lead)
    assert re.search(r"ekf is level to \d\d\.\d arcsec, (1\.\d|2\.\d) times the bound", lead)
    assert lead.endswith("2 failed runs.")
    assert "ekf failed in 2 of 40 runs: run 3 diverged, run 5 not_finite" in html


def test_paper_stands_beside_ours(report):
    html, summary = report
    rows = {row[0]: row[1:] for row in table_after(html, "Beside Gao et al., Table 3")}
    assert rows["paper, ekf"] == ["30.15", "33.76", "5.12", "0.023", "0.035"]
    assert rows["here, l2linf"][0] == f"{summary['filters']['l2linf']['roll_arcsec']:.1f}"
    assert rows["paper, l2linf / ekf"] == ["0.70", "0.63", "0.69", "0.52", "0.63"]
    ours = summary["filters"]
    assert rows["here, l2linf / ekf"][2] == (
        f"{ours['l2linf']['heading_arcmin'] / ours['ekf']['heading_arcmin']:.2f}"
    )
    assert "Not reproduced: the gain in heading" in html


def test_outcomes_of_fixes_are_counted(report):
    rows = table_after(report[0], "Delay and fixes</h2>")
    assert rows[0] == ["Fixes of all runs", "fused", "gated"]
    assert rows[1] == ["ekf", "16000 99.96 %", "7 0.04 %"]


def test_the_file_needs_nothing_else_and_is_small(report):
    html, _ = report

    class Resources(HTMLParser):
        found: list[str] = []  # noqa: RUF012
        figures = 0

        def handle_starttag(self, tag, attrs):
            self.figures += tag == "svg"
            names = ("src", "href", "xlink:href", "data")
            self.found += [value for name, value in attrs if name in names and not value.startswith("#")]
            assert tag not in ("script", "link", "iframe")

    parser = Resources()
    parser.feed(html)
    assert parser.found == []
    assert parser.figures == 5
    assert "@import" not in html
    assert len(html) < 3e6


def test_figures_have_units_and_a_legend(report):
    html, _ = report
    for label in (
        "roll error, arcsec",
        "heading error, arcmin",
        "velocity error east, m/s",
        "position error, m",
    ):
        assert f">{label}</text>" in html
    for entry in (
        "ekf",
        "l2linf",
        "bound, stamps known",
        "95 % band if consistent",
        "mean delay of the fixes",
    ):
        assert f">{entry}</text>" in html


def test_tells_how_to_do_it_again(report):
    html, _ = report
    _, scenario = load_scenario("gao2009")
    assert "fleetalign run a_name --seed 7 --out &#39;a &amp; b&#39;" in html
    assert scenario.digest in html
    assert "seed 7" in html


def test_scenario_text_is_the_scenario():
    _, scenario = load_scenario("gao2009")
    awkward = scenario.model_copy(update={"title": 'A "title" with \\ and Schrödinger\nin two lines'})
    assert Scenario.model_validate(tomllib.loads(to_toml(awkward.model_dump(mode="json")))) == awkward


def test_where_all_runs_fail_there_is_no_band(tmp_path, stated):
    lost = a_score("ekf", np.random.default_rng(3), np.nan, 0.0)
    lost = replace(lost, fused=np.zeros(RUNS, np.int64), failures=dict.fromkeys(range(RUNS), "no_fix"))
    html, summary = write(tmp_path / "report.html", stated, {"ekf": lost})
    row = summary["filters"]["ekf"]
    assert (row["nees"], row["nees_band95"], row["nis_band95"]) == (None, None, None)
    assert "95 % band if consistent" not in html


def test_replayed_fixes_have_neither_intervals_nor_bands(tmp_path, stated, window):
    fixes = draw_fixes(window, 500, 501, stated.fixes, np.random.default_rng(1))
    write_fixes(fixes, tmp_path / "fixes.csv")
    scenario = replaced(stated, {"fixes": {"kind": "replay", "file": str(tmp_path / "fixes.csv")}})
    html, summary = write(
        tmp_path / "report.html", scenario, {"ekf": a_score("ekf", np.random.default_rng(3), 1.0, 0.0)}
    )
    row = summary["filters"]["ekf"]
    assert (row["ci95"], row["nees_band95"], row["nis_band95"]) == (None, None, None)
    cells = table_after(html, 'class="lead"')[1]
    assert cells[1] == f"{row['roll_arcsec']:.1f}"
    assert cells[9:11] == [f"{row['nees']:.2f}", f"{row['nis']:.2f}"]
    assert "reaches the bound" not in html
    assert "band if consistent" not in html
    assert "Small print: the fixes are replayed" in html


def test_without_a_bound_nothing_is_compared_with_it(tmp_path):
    scores = {"ekf": a_score("ekf", np.random.default_rng(3), 1.0, 0.0)}
    html, _ = write(tmp_path / "report.html", Scenario(title="x"), scores, np.full(5, np.nan))
    lead = re.search(r'class="lead">(.*?)</p>', html, re.S)[1]
    assert re.search(r"ekf is level to \d\d\.\d arcsec\. Heading 1\.\d\d arcmin, bound \N{EN DASH}\.", lead)
    assert "nan" not in table_after(html, 'class="lead"')[1]


def test_one_run_that_failed_and_no_paper(tmp_path):
    rng = np.random.default_rng(2)
    score = a_score("l2linf", rng, 1.0, 0.0, runs=1)
    lost = replace(
        score,
        errors=np.full_like(score.errors, np.nan),
        position_errors=np.full_like(score.position_errors, np.nan),
        nees=np.full_like(score.nees, np.nan),
        nis=np.full(1, np.nan),
        fused=np.zeros(1, np.int64),
        delay=np.full_like(score.delay, np.nan),
        failures={0: "no_fix"},
    )
    html, _ = write(tmp_path / "report.html", Scenario(title="<b>Nothing</b>"), {"l2linf": lost})
    assert "no filter came to an end" in html
    assert "<b>Nothing" not in html
    assert "Beside" not in html
    assert table_after(html, 'class="lead"')[1][1].startswith("\N{EN DASH}")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
