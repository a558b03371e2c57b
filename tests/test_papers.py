"""What the companion papers' experiments share: intervals, tables, claims, page, commands and refusals."""

import json

import numpy as np
import pytest
from fleetalign.cosim.papers import judging, statistics
from fleetalign.cosim.papers import scenario as papers
from fleetalign.cosim.papers.figures import _drawn, draw_figures
from fleetalign.cosim.papers.judging import Held
from fleetalign.cosim.papers.results import (
    Claim,
    Curve,
    Form,
    Metric,
    Panel,
    PaperFigure,
    Results,
    Row,
    Table,
    Value,
    Verdict,
)
from fleetalign.network.localization.problem import LocalizationError

YES, NO, OPEN = Held.YES, Held.NO, Held.OPEN
LOCALIZED = (
    'title = "A plane"\nsource = "A, B, \\"C\\""\ndraws = 40\n[experiment]\nkind = "repeated_ranging"\n'
)
RUN = LOCALIZED.replace("repeated_ranging", "ins_wsn")


def test_rms_and_mean_are_those_of_the_draws_and_hold_the_truth():
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(200):
        found = statistics.rms((2.0 * rng.standard_normal(60)) ** 2)
        covered += found.low <= 2.0 <= found.high
    # 95 % of 200 intervals, less some that 60 draws of a skewed square cost a bootstrap: 4 sd below 92 %.
    assert covered / 200 > 0.92 - 4 * np.sqrt(0.92 * 0.08 / 200)
    assert statistics.rms([4.0, np.nan, 4.0]).value == 2.0
    assert statistics.mean([1.0, 3.0]).value == 2.0
    assert statistics.mean_ratio([2.0, 4.0], [1.0, 1.0]).value == 3.0
    # A draw that lacks one of the two is in neither.
    assert statistics.mean_ratio([2.0, 4.0, 9.0, np.nan], [1.0, 1.0, np.nan, 7.0]).value == 3.0


def test_a_ratio_of_equal_errors_has_no_spread():
    squares = np.random.default_rng(3).chisquare(2, 100)
    paired = statistics.rms_ratio(4 * squares, squares)
    assert paired.value == pytest.approx(2.0)
    assert paired.low == pytest.approx(2.0)
    assert paired.high == pytest.approx(2.0)
    apart = statistics.rms_ratio(4 * squares, squares[::-1])
    assert apart.high - apart.low > 0.2


def test_few_draws_have_no_interval_and_none_no_value():
    assert np.isnan(statistics.rms(np.ones(29)).low)
    assert statistics.rms(np.ones(30)).low == 1.0
    assert np.isnan(statistics.rms([np.nan]).value)
    assert np.isnan(statistics.mean([]).value)


def test_verdicts_follow_whole_intervals():
    low, high, across, unknown = Value(0.5, 0.4, 0.6), Value(2, 1.8, 2.2), Value(0.9, 0.8, 1.2), Value(0.5)
    assert [judging.below(v, 1.0) for v in (low, high, across, unknown)] == [YES, NO, OPEN, OPEN]
    assert [judging.above(v, 1.0) for v in (low, high, across, unknown)] == [NO, YES, OPEN, OPEN]
    # Half an interval is none.
    assert judging.below(Value(0.5, np.nan, 0.6), 1.0) is OPEN
    assert judging.below(Value(2, 1.8, np.nan), 1.0) is OPEN
    assert judging.within(low, 0.3, 0.7) is YES
    assert judging.within(low, 0.55, 0.7) is OPEN
    assert judging.within(low, 0.7, 0.9) is NO
    assert judging.both(YES, OPEN) is OPEN
    assert judging.both(NO, OPEN) is NO
    assert judging.either(NO, OPEN) is OPEN
    assert judging.either(YES, NO, OPEN) is YES
    assert judging.verdict(YES) is Verdict.REPRODUCED
    assert judging.verdict(NO) is Verdict.NOT
    assert judging.verdict(OPEN) is Verdict.UNDECIDED
    assert judging.verdict(NO, [NO, YES]) is Verdict.PARTLY
    assert judging.verdict(NO, [NO, OPEN]) is Verdict.UNDECIDED
    assert judging.verdict(OPEN, [YES]) is Verdict.UNDECIDED


def fabricated(settings, draws, seed, progress) -> Results:
    if progress:
        progress(1, 1)
    values = {"rmse_m": Value(1.25, 1.1, 1.4), "nees": Value(np.nan)}
    metrics = (Metric("rmse_m", "RMSE, m", 2, "error"), Metric("nees", "NEES", 1, "of 2"))
    rows = (
        Row("least squares", Form.OURS, values, "eq. (2)"),
        Row("CRLB", Form.BOUND, {"rmse_m": Value(1.0)}),
    )
    claim = Claim("Fig. 2", "It is better.", "ratio below 1", Verdict.NOT, "It is 1.3.", "Noise is <white>.")
    x = np.arange(5.0)
    curve = Curve("least squares", x, x + 1, x + 0.5, x + 1.5)
    panel = Panel("measurements", "error, m", (curve, Curve("CRLB", x, x, look="dashed")), log_y=True)
    return Results(
        (Table("nominal", "Nominal", metrics, rows),),
        (claim,),
        (PaperFigure("figure_2", "Error.", ((panel, panel), (panel,))),),
        notes=("Noise is ours.",),
        estimates={"x": x},
        write_recording=lambda path: path.write_bytes(b"RRF2"),
    )


@pytest.fixture
def fabricating(monkeypatch):
    monkeypatch.setattr(papers, "_STUDIES", dict.fromkeys(papers._STUDIES, fabricated))


@pytest.fixture
def toml(tmp_path):
    path = tmp_path / "paper.toml"
    path.write_text(LOCALIZED)
    return path


def test_localize_leaves_a_page_and_its_data(command, toml, tmp_path, fabricating):
    folder = tmp_path / "out"
    status, out, _ = command("localize", toml, "--out", folder, "--draws", 33, "--seed", 5)
    assert status == 0
    summary = json.loads((folder / "localize.json").read_text())
    assert (summary["scenario"], summary["seed"], summary["draws"]) == ("paper", 5, 33)
    best, bound = summary["tables"]["nominal"]["methods"]
    assert best["rmse_m"] == [1.25, 1.1, 1.4]
    assert best["nees"] == [None, None, None]
    assert bound["form"] == "bound"
    assert summary["claims"][0]["verdict"] == "not reproduced"
    page = (folder / "localize.html").read_text()
    for told in ("1.10 to 1.40", "not reproduced", "Rule: ratio below 1", "Noise is &lt;white&gt;.", "<svg"):
        assert told in page
    assert "A, B, &#34;C&#34;" in page
    for told in ("1.25", "Not reproduced (Fig. 2): It is better. It is 1.3.", "Noise is ours."):
        assert told in " ".join(out.split())


def test_run_leaves_the_files_of_the_contract(command, tmp_path, fabricating):
    toml, folder = tmp_path / "paper.toml", tmp_path / "out"
    toml.write_text(RUN)
    status, out, _ = command("run", toml, "--out", folder, "--runs", 3, "--json")
    assert status == 0
    assert json.loads(out)["draws"] == 3
    files = {"summary.json", "estimates.parquet", "recording.rrd", "report.html", "manifest.json"}
    assert {path.name for path in folder.iterdir()} == files
    assert json.loads((folder / "manifest.json").read_text())["content"]["draws"] == 3


def test_check_and_list_know_the_papers(command, toml):
    assert command("check", toml)[:2] == (0, "paper: A plane: good\n")
    assert "gao2009" in command("list")[1]


@pytest.mark.parametrize(
    ("arguments", "change", "told"),
    [
        (["run"], (), "run it by: fleetalign localize"),
        (["localize", "--nodes", 50], (), "--nodes: not for"),
        (["localize", "--draws", 0], (), "--draws = 0: allowed is [1, 1e+06]"),
        (["run", "--runs", 0], ("repeated_ranging", "ins_wsn"), "--runs = 0: allowed is [1, 1e+06]"),
        (["localize", "--seed", -1], (), "--seed = -1: allowed is [0, "),
        (["localize"], ("draws = 40", "draws = -2"), "draws = -2: allowed is [1, 1e+06]"),
        (["localize"], ("repeated_ranging", "magic"), "experiment.kind = 'magic': allowed are"),
        (["localize"], ("kind =", "colour = 3\nkind ="), "experiment.colour: unknown field"),
        (["bound"], (), "experiment: a paper's own, which flies nothing"),
    ],
)
def test_mistakes_are_told_in_one_line(command, toml, tmp_path, fabricating, arguments, change, told):
    if change:
        toml.write_text(LOCALIZED.replace(*change))
    verb, *options = arguments
    status, out, err = command(verb, toml, *options)
    assert (status, out) == (2, "")
    assert told in err
    assert "option:" not in err
    assert len(err.splitlines()) == 1


def test_a_network_that_cannot_be_located_is_a_mistake_of_the_scenario(command, toml, tmp_path, monkeypatch):
    def broken(*_):
        raise LocalizationError("all 3 anchors lie on a line")

    monkeypatch.setattr(papers, "_STUDIES", dict.fromkeys(papers._STUDIES, broken))
    status, _, err = command("localize", toml, "--out", tmp_path / "out")
    assert status == 2
    assert "paper.toml: all 3 anchors lie on a line" in err
    assert list((tmp_path / "out").iterdir()) == []


def test_labels_keep_their_colour_in_all_panels():
    x = np.arange(3.0)
    first = Panel("x", "y", (Curve("a", x, x), Curve("b", x, x + 1)))
    second = Panel("x", "y", (Curve("b", x, x),), shaded=((0.5, 1.0),), equal=True)
    (drawn,) = draw_figures((PaperFigure("f", "", ((first, second),)),)).values()
    # Lines are drawn in the order of panels: a, b, and b again, then those of the legend.
    colors = [part.split(";")[0] for part in drawn.split("stroke: ")[1:] if part.startswith("#")]
    assert drawn.count("stroke: #3d8fd1; stroke-width: 1.4") == 3, colors
    assert drawn.count("stroke: #d55e00; stroke-width: 1.4") == 2


def test_counts_have_whole_ticks():
    for x, whole in ((np.arange(1.0, 21.0), True), (np.linspace(0, 20, 15), False)):
        drawn = _drawn(PaperFigure("f", "", ((Panel("x", "y", (Curve("a", x, x),)),),)))
        ticks = drawn.axes[0].get_xticks()
        assert (ticks % 1 == 0).all() == whole
