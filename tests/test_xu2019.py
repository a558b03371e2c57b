"""The moving anchor's experiment: what it may be told, its draws, and its verdicts."""

import tomllib
from functools import partial

import numpy as np
import pytest
from fleetalign.cosim.papers import xu2019_claims, xu2019_runs
from fleetalign.cosim.papers.results import Form, Row, Table, Value, Verdict
from fleetalign.cosim.papers.xu2019 import METHODS, MovingAnchor, study
from fleetalign.cosim.run import generator
from fleetalign.cosim.scenario import SCENARIO_FOLDER
from pydantic import ValidationError

SMALL = MovingAnchor(kind="moving_anchor", nodes=4, monte_carlo_runs=32, radii_m=(25.0,), shadowing_db=(1.0,))


@pytest.fixture(scope="module")
def small():
    return study(SMALL, 32, 3)


def test_the_study_on_few_draws(small):
    table = small.tables[0]
    rows = {row.method: row.values for row in table.rows}
    assert len(rows) == len(METHODS)
    assert {row.form for row in table.rows} == set(Form)
    over = {method: values["over_bound"].value for method, values in rows.items() if "over_bound" in values}
    # 128 nodes: a ratio is known to 5 %, one sigma; paired ones far better.
    assert over["least squares, weights at the estimate"] < 1.15
    assert over["SR-CKF, start of its own"] < 1.15
    assert over["linear"] > 3
    assert over["mean of where the rings meet"] < 0.6
    assert over["SR-CKF"] == pytest.approx(over["CKF"], rel=1e-6)
    low, high = rows["CKF, start of its own"]["nees"].low, rows["CKF, start of its own"]["nees"].high
    assert low < 2.0 < high
    heights = {row.method: row.values for row in small.tables[1].rows}
    assert heights["height estimated"]["height_rmse_m"].value == pytest.approx(
        heights["bound, height estimated"]["height_rmse_m"].value, rel=0.25
    )
    assert [t.name for t in small.tables] == ["radius_25_m", "heights", "path_loss", "single_precision"]
    assert [f.name for f in small.figures] == ["figure_4", "figures_5_to_7", "figure_8"]


def test_verdicts_follow_from_the_numbers(small):
    verdicts = {claim.where: claim.verdict for claim in small.claims}
    assert verdicts == {
        "1.2, (2) to (4)": Verdict.NOT,
        "1.2, abstract": Verdict.NOT,
        "2.2, Fig. 7": Verdict.NOT,
        "2.2": Verdict.NOT,
        "3.1, Figs. 4 and 6": Verdict.REPRODUCED,
        "3.1, Figs. 4 and 7": Verdict.NOT,
        "3.3, Fig. 8": Verdict.PARTLY,
        "4": Verdict.PARTLY,
    }


@pytest.mark.parametrize(
    ("plain", "rooted", "consistent", "expected"),
    [
        ((0, 20), (0, 0), (2, 2), Verdict.PARTLY),
        ((20, 20), (0, 0), (2, 2), Verdict.REPRODUCED),
        ((0, 20), (0, 20), (2, 2), Verdict.NOT),
        # What breaks both forms in double precision says nothing of single.
        ((0, 20), (0, 0), (2, 1e9), Verdict.NOT),
        ((0, 1), (0, 0), (2, 2), Verdict.UNDECIDED),
    ],
)
def test_square_roots_are_judged_where_the_filter_itself_is_sound(plain, rooted, consistent, expected):
    def row(name, off, nees):
        values = {"off_single_percent": off, "nees_double": nees, "condition_log10": 5.0}
        return Row(name, Form.OURS, {key: Value(v, 0.9 * v, 1.1 * v) for key, v in values.items()})

    rows = [
        row(f"{name}, case {i}", of[i], consistent[i])
        for i in range(2)
        for name, of in (("CKF", plain), ("SR-CKF", rooted))
    ]
    assert xu2019_claims._definite(Table("", "", (), tuple(rows))).verdict is expected


def test_a_draw_depends_on_seed_and_number_alone():
    random = partial(generator, 3)
    together = xu2019_runs.field_sample(SMALL, 25.0, range(3), random)
    alone = xu2019_runs.field_sample(SMALL, 25.0, [2], random)
    np.testing.assert_array_equal(together.x[8:], alone.x)
    np.testing.assert_allclose(together.bound[8:], alone.bound, rtol=1e-12)
    many, one = (xu2019_runs.methods(SMALL, s) for s in (together, alone))
    for key, outcome in one.items():
        np.testing.assert_allclose(many[key].error[8:], outcome.error, atol=1e-6, err_msg=key)
    wide = xu2019_runs.field_sample(SMALL, 50.0, [2], random)
    # The same beacons are heard with the same errors at another radius.
    assert np.isin(alone.seen.ranges[alone.seen.heard], wide.seen.ranges[wide.seen.heard]).all()


def test_the_path_covers_the_field_a_beacon_a_period():
    settings = MovingAnchor(kind="moving_anchor")
    beacons = settings.beacons()
    step = np.linalg.norm(np.diff(beacons, axis=0), axis=1)
    # Corners are cut: no step is longer than a metre, nor shorter than its half diagonal.
    assert step.max() == pytest.approx(1.0)
    assert step.min() > 0.7
    assert sorted(set(beacons[np.isin(beacons[:, 0], [10.0]), 1])) == [7.0, 21.0, 35.0, 49.0, 63.0]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"radii_m": [20.0]}, r"radii_m = 20 m: a node in a corner hears one lane alone"),
        ({"lane_spacing_m": 100.0}, "1 lanes"),
        ({"terrain_m": 10.0}, r"terrain_m = 10 m: must be below altitude_m = 10 m"),
        ({"range_error_share": 1.0}, "less than 1"),
        ({"nodes": 0}, "greater than or equal to 1"),
    ],
)
def test_fields_that_no_node_can_be_located_in(change, told):
    with pytest.raises(ValidationError, match=told):
        MovingAnchor.model_validate({"kind": "moving_anchor", **change})


def test_the_bundled_scenario_is_the_default_experiment():
    content = tomllib.loads(SCENARIO_FOLDER.joinpath("xu2019.toml").read_text("utf-8"))
    assert MovingAnchor.model_validate(content["experiment"]) == MovingAnchor(kind="moving_anchor")
