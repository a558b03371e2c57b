"""The experiment of Uryvsky et al. end to end, on few draws, and what its settings refuse."""

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band
from fleetalign.cosim.papers.results import Form
from fleetalign.cosim.papers.uryvsky2018 import RepeatedRanging, study
from fleetalign.cosim.papers.uryvsky2018_runs import conditions, mixture_information, outcomes
from fleetalign.network.localization.batch_ranging import batch
from pydantic import ValidationError

KIND = {"kind": "repeated_ranging"}
DRAWS, CYCLES = 60, 8
SETTINGS = RepeatedRanging.model_validate(KIND | {"cycles": CYCLES})


@pytest.fixture(scope="module")
def found():
    return {case.key: outcomes(SETTINGS, case) for case in conditions(SETTINGS, DRAWS, 3)}


@pytest.fixture(scope="module")
def results():
    return study(SETTINGS, DRAWS, 3)


def rmse(outcome, cycle=-1):
    return np.sqrt(outcome.squares[:, cycle].mean())


@pytest.mark.parametrize("case", ["nominal", "unequal", "understated", "overstated"])
def test_least_squares_of_all_ranges_reach_the_bound(found, case):
    best, bound = found[case]["batch"], found[case]["bound"]
    # 720 components, of unequal variance: the RMS is known to some 0.035.
    assert 0.9 < rmse(best) / rmse(bound) < 1.05
    low, high = mean_band(2, 6 * DRAWS, 0.999)
    assert low < best.nees.mean() < high


def test_hubers_loss_holds_against_outliers_where_the_filters_do_not(found):
    wild = found["outliers"]
    assert rmse(wild["huber"]) < 0.6 * rmse(wild["kalman"])
    # Its covariance holds in large samples; of 14 spare ranges an element it is a tenth off.
    assert 1.6 < wild["huber"].nees.mean() < 2.5
    for name in ("regularized", "adaptive", "regularized_adaptive"):
        assert rmse(wild[name]) > rmse(wild["kalman"])


def test_a_mended_kalman_filter_halves_the_error_in_four_cycles_and_a_printed_one_raises_it(found):
    nominal = found["nominal"]
    one = np.sqrt(nominal["fix"].one.mean())
    assert 0.45 < rmse(nominal["kalman"], 3) / one < 0.55
    assert rmse(nominal["kalman_printed"], 3) > 1.2 * one
    low, high = mean_band(2, 6 * DRAWS, 0.999)
    assert low < nominal["kalman"].nees.mean() < high
    assert found["unequal"]["fix_printed"].invalid.mean() > 0.5
    assert not found["unequal"]["fix"].invalid.any()


def test_mis_stated_noise_moves_no_proportion(found):
    for case in ("understated", "overstated"):
        for name in ("kalman", "batch"):
            np.testing.assert_allclose(
                found[case][name].squares[:, -1], found["nominal"][name].squares[:, -1]
            )
        ratio = found[case]["kalman"].nees / found["nominal"]["kalman"].nees
        np.testing.assert_allclose(ratio, {"understated": 4.0, "overstated": 0.25}[case])


def test_the_information_of_a_mixture_is_between_those_of_its_parts():
    assert mixture_information(0.0, 5.0) == pytest.approx(1.0, rel=1e-6)
    assert mixture_information(0.5, 1.0) == pytest.approx(1.0, rel=1e-6)
    # By the score of a million deviates, known to a few times sqrt(2 / 10^6).
    rng = np.random.default_rng(0)
    r = rng.standard_normal(1_000_000) * np.where(rng.random(1_000_000) < 0.1, 8.0, 1.0)
    narrow, wide = 0.9 * np.exp(-(r**2) / 2), 0.1 / 8 * np.exp(-(r**2) / 128)
    score = r * (narrow + wide / 64) / (narrow + wide)
    assert mixture_information(0.1, 8.0) == pytest.approx(np.mean(score**2), rel=0.01)


def test_the_batch_is_scaled_by_what_residuals_tell():
    rng = np.random.default_rng(5)
    references, element = np.array([[0.0, 0.0], [100.0, 0.0]]), np.array([40.0, 70.0])
    truth = np.linalg.norm(element - references, axis=1)
    ranges = truth + 3.0 * rng.standard_normal((400, 6, 1, 2))
    found = batch(references, ranges, np.ones(ranges.shape), np.tile(element, (400, 1, 1)))
    # Noise of 3 m told as 1 m; each of 400 variances has 10 degrees of freedom.
    expected = batch(references, ranges[:1, :1], np.ones((1, 1, 1, 2)), element[None, None]).cov[0, 0] * 9 / 6
    np.testing.assert_allclose(found.cov.mean(axis=(0, 1)), expected, rtol=0.12, atol=0.05)


def test_the_study_tells_all_there_is(results):
    assert [t.name for t in results.tables] == [
        "nominal", "unequal", "understated", "overstated", "outliers", "network",
    ]  # fmt: skip
    for table in results.tables[:-1]:
        assert {row.form for row in table.rows} == set(Form)
        for row in table.rows:
            if row.form is not Form.BOUND:
                assert set(row.values) >= {"rmse_1_m", "rmse_4_m", "rmse_n_m", "over_bound"}
    # Name, form and these have room in 80 columns.
    assert [m.key for m in results.tables[0].metrics if m.brief] == [
        "rmse_4_m", "rmse_n_m", "over_bound", "change_fix_percent", "nees",
    ]  # fmt: skip
    network = {row.method: row.values for row in results.tables[-1].rows}
    joint = network["least squares, all links"]
    # Some 360 correlated errors: 5 % of the RMS is about two standard deviations.
    assert 0.9 < joint["over_bound"].value < 1.1
    assert joint["rmse_n_m"].value < 0.7 * network["least squares, two ranges each"]["rmse_n_m"].value
    assert len(results.claims) == 9
    assert all(claim.rule and claim.measured and claim.why for claim in results.claims)
    assert len(results.figures[0].panels) == 3


def test_a_draw_depends_on_seed_and_number_alone(found):
    few, many = (conditions(SETTINGS, n, 3) for n in (2, 5))
    for a, b in zip(few, many, strict=True):
        np.testing.assert_array_equal(a.ranges, b.ranges[:2])
    assert (conditions(SETTINGS, 2, 4)[0].ranges != few[0].ranges).all()
    again = outcomes(SETTINGS, conditions(SETTINGS, DRAWS, 3)[0])
    for name, outcome in found["nominal"].items():
        np.testing.assert_array_equal(again[name].squares, outcome.squares)


ORIGIN, BASE = (0.0, 0.0), (100.0, 0.0)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"elements_m": [ORIGIN, BASE]}, "2 elements; at least 3"),
        ({"elements_m": [ORIGIN, (90.0, 5.0), (50, 50)]}, "element 1 must be at"),
        ({"elements_m": [(1.0, 0.0), BASE, (50, 50)]}, "element 1 must be at"),
        ({"elements_m": [ORIGIN, BASE, (50, 50), (50, 50)]}, "elements 3 and 4 are in the same place"),
        ({"elements_m": [ORIGIN, BASE, (50, 0)]}, "y must be above 0"),
        ({"elements_m": [ORIGIN, BASE, (50, -60)]}, "y must be above 0"),
        ({"elements_m": [ORIGIN, BASE, (50, 4)]}, "too near the line through 1 and 2"),
        ({"range_sd_m": 30.0}, "or ranges come out zero or negative"),
        ({"shown_element": 9}, "elements 3 to 8"),
        ({"cycles": 3}, "greater than or equal to 4"),
    ],
)
def test_mistakes_are_told(changes, told):
    with pytest.raises(ValidationError, match=told):
        RepeatedRanging.model_validate(KIND | changes)
