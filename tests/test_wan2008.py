"""The experiment of Wan et al. from settings to claims, in small networks."""

import numpy as np
import pytest
from fleetalign.cosim.mistakes import told_mistakes
from fleetalign.cosim.papers.results import Form, Verdict
from fleetalign.cosim.papers.scenario import PaperScenario
from fleetalign.cosim.papers.wan2008 import study
from fleetalign.cosim.papers.wan2008_costs import dense_multiplications
from fleetalign.cosim.papers.wan2008_runs import Cell, draw_network
from fleetalign.cosim.papers.wan2008_settings import Refinement
from fleetalign.network.localization.problem import LocalizationError
from pydantic import ValidationError

SMALL = Refinement(
    kind="refinement",
    nodes=60,
    side_m=57.0,
    connectivities=(8.0, 9.0, 10.0, 11.0),
    beacon_shares=(0.1, 0.3, 0.5),
    range_error_shares=(0.05, 0.2),
    cost_nodes=(40, 80, 160),
    dense_most=160,
    max_steps=15,
)


@pytest.fixture(scope="module")
def results():
    return study(SMALL, 3, 2)


def test_tables_hold_every_form_and_the_filter_refines(results):
    tables = {table.name: table for table in results.tables}
    rows = {row.method: row for row in tables["connectivity_9"].rows}
    start, refined = (
        rows[m].values["error_0.1_percent"].value for m in ("DV-distance", "central EKF, to the end")
    )
    assert refined < start
    forms = {row.form for table in results.tables for row in table.rows}
    assert forms == {Form.PUBLISHED, Form.MENDED, Form.BASELINE, Form.OURS}
    ours = {row.method: row for row in tables["rigid"].rows}["the same, nodes that are certain"]
    assert 0.5 < ours.values["over_bound"].value < 2.0
    assert {"figure_3", "figure_5"} == {figure.name for figure in results.figures}
    assert len(results.figures[0].panels) == 2


def test_claims_have_verdicts_from_the_numbers(results):
    claims = {claim.where: claim for claim in results.claims}
    assert len(results.claims) == 12
    # Entries of H grow as the paper has it, multiplications of whole matrices by the cube.
    assert claims["2.2.3, conclusion (a)"].verdict is Verdict.PARTLY
    # A central solution needs its ranges once at the sink, not at every step.
    assert claims["2.2.4"].verdict is Verdict.PARTLY
    assert "connectivity" in claims["2.2.3"].measured
    # Three draws have no interval.
    assert claims["2.2.3"].verdict is Verdict.UNDECIDED


def test_costs_grow_as_counted(results):
    cost = {row.method: row.values for row in {t.name: t for t in results.tables}["cost"].rows}
    for method, exponent in (
        ("entries of H, central", 2.0),
        ("entries of H, distributed", 1.0),
        ("multiplications a step, central dense", 3.0),
        ("multiplications a sweep, distributed", 1.0),
    ):
        # Two sizes, whose radii differ by chance: some per cent of a factor two.
        assert cost[method]["exponent"].value == pytest.approx(exponent, abs=0.3)
    assert dense_multiplications(1, 1) + 1 == 1 * 1 * 1 * 2 + 1 + 1 + 1 + 1 + 1 + 1 + 1 + 1 + 1


def test_the_same_seed_gives_the_same_numbers_and_another_does_not():
    cell = Cell(8.0, 0.1, 0.05)
    first, again = (draw_network(SMALL, cell, 4, 3) for _ in range(2))
    np.testing.assert_array_equal(first.problem.ranges, again.problem.ranges)
    assert not np.array_equal(first.x, draw_network(SMALL, cell, 5, 3).x)
    more = draw_network(SMALL, Cell(8.0, 0.5), 4, 3)
    np.testing.assert_array_equal(first.x, more.x)
    assert 2 * len(first.problem.links) / 60 == 8.0
    scaled = draw_network(SMALL, Cell(8.0, 0.1, 0.05, 10.7), 4, 3)
    np.testing.assert_allclose(scaled.problem.ranges / 10.7, first.problem.ranges / first.radius)


def test_a_disconnected_network_is_refused_where_that_is_asked_for():
    sparse = SMALL.model_copy(update={"disconnected": "refuse"})
    with pytest.raises(LocalizationError, match=r"disconnected: the part of \d+ nodes .* has [012] beacons"):
        draw_network(sparse, Cell(3.0, 0.1), 0, 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"beacon_shares": [0.01, 0.1, 0.5]},
            "beacon_shares = 0.01 makes 2 of 200 nodes beacons: at least 3",
        ),
        ({"low_share": 0.15}, "low_share = 0.15 must be one of beacon_shares"),
        ({"nodes": 5}, "experiment.nodes = 5: allowed is [20, 1000]"),
        ({"judged_error_share": 0.07}, "judged_error_share = 0.07 must be one of range_error_shares"),
        ({"connectivities": [9.0, 6.0]}, "connectivities = [9, 6]: must increase"),
        ({"connectivities": [6.0]}, "connectivities = [6]: 2 to 8 values are allowed"),
        ({"range_error_shares": [-0.02, 0.05]}, "range_error_shares.0 = -0.02: allowed is [0.001, 0.5]"),
        ({"beacon_shares": [0.05, 0.1, 0.5]}, "beacon_shares = [0.05, 0.1, 0.5]: one must lie between"),
    ],
)
def test_settings_that_make_no_experiment_are_refused_in_one_line(changes, words):
    content = {"title": "x", "source": "y", "experiment": {"kind": "refinement", **changes}}
    with pytest.raises(ValidationError) as error:
        PaperScenario.model_validate(content)
    told = str(told_mistakes("it", error.value, PaperScenario, "scenario"))
    assert words in told
    assert len(told.splitlines()) == 1
