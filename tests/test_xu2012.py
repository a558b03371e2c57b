"""The experiment of Xu et al. 2012: its filters against exact covariances, its tables from end to end."""

from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band, nees
from fleetalign.align.lmi.stochastic_hinf import Form as When
from fleetalign.align.lmi.stochastic_hinf import design
from fleetalign.cosim.papers import xu2012, xu2012_bridges
from fleetalign.cosim.papers.results import Form, Verdict
from fleetalign.cosim.papers.xu2012_claims import claims_of
from fleetalign.cosim.papers.xu2012_figures import REACH_M, figures_of, reference_nodes
from fleetalign.cosim.papers.xu2012_filters import (
    bound,
    errors,
    free_running,
    kalman,
    plant,
    second_moments,
    tuned_share,
)
from fleetalign.cosim.papers.xu2012_settings import InsWsn
from fleetalign.cosim.papers.xu2012_world import SEEN, Draws, World
from pydantic import ValidationError

DRAWS = 400
SMALL = {"training_area_s": [40.0, 40.0], "outage_s": [15.0, 15.0]}


def settings(**changes):
    return InsWsn.model_validate({"kind": "ins_wsn", **changes})


@pytest.fixture(scope="module")
def world():
    return World(settings())


@pytest.fixture(scope="module")
def draws(world):
    return Draws.of(world, DRAWS, 1)


def test_track_goes_as_the_paper_says(world):
    position, velocity = world.course
    np.testing.assert_allclose(position[[0, -1]], [[650, 0], [130, 400]], atol=1e-6)
    speed = np.linalg.norm(velocity, axis=1)
    np.testing.assert_allclose(speed, speed[0])
    # Central differences of the track are its velocity; curvature and interpolation leave a hundredth.
    np.testing.assert_allclose((position[2:] - position[:-2]) / 2, velocity[1:-1], atol=0.03)
    assert [part.stop - part.start for part in world.settings.stretches] == [100, 50, 100, 50]


def test_a_draw_depends_on_its_number_alone(world):
    two, three = Draws.of(world, 2, 5), Draws.of(world, 3, 5)
    for name in ("start", "period", "process", "fix"):
        np.testing.assert_array_equal(getattr(three, name)[:2], getattr(two, name))


def test_errors_have_the_moments_of_exact_covariance_analysis():
    """Over 400 draws variances are known to sqrt(2 / 400) = 7 %: four of that. The period is most unsteady,
    and what it adds by far not lost in that."""
    world = World(settings(period_error_sd_s=1.0, velocity_walk_mps_sqrt_s=0.3, velocity_sd_mps=1.0))
    draws = Draws.of(world, DRAWS, 1)
    gains = kalman(world, 3.0)
    moments = np.diagonal(second_moments(world, gains, 100), axis1=1, axis2=2)[::10]
    found = (errors(world, draws, gains)[:, :100:10] ** 2).mean(axis=0)
    np.testing.assert_allclose(found, moments, rtol=0.3)


def test_kalman_filter_with_biases_is_batch_least_squares():
    """With an exact period, 30 fixes: information of all noises and fixes at once, in one matrix."""
    world = World(settings(period_error_sd_s=0.0, accel_bias_walk_mps2_sqrt_s=1e-3, **SMALL))
    n = 30
    claimed = kalman(world, with_bias=True).P[n - 1]
    # Unknowns: the state at each epoch. Prior, transitions and fixes are their information.
    information = np.zeros((6 * n, 6 * n))
    information[:6, :6] += np.diag(1 / world.initial_variance)
    weight = np.diag(1 / np.maximum(world.Q, 1e-14))
    H = np.eye(4, 6)
    for k in range(n):
        at = slice(6 * k, 6 * k + 6)
        information[at, at] += H.T @ np.linalg.inv(world.R) @ H
        if k:
            J = np.hstack([-world.A[k - 1], np.eye(6)])
            both = slice(6 * k - 6, 6 * k + 6)
            information[both, both] += J.T @ weight @ J
    smoothed = np.linalg.inv(information)[-6:, -6:]
    np.testing.assert_allclose(np.diag(claimed), np.diag(smoothed), rtol=1e-3)


def test_best_filter_is_consistent_and_at_the_bound(world, draws):
    """NEES of four at the end of each stretch, 400 draws, four stretches: the 99.9 % band. Ratio to the bound
    by exact second moments, which know no chance."""
    gains = kalman(world, with_bias=True)
    found = errors(world, draws, gains)[..., SEEN]
    low, high = mean_band(4, DRAWS, 0.999)
    for stretch in world.settings.stretches:
        last = stretch.stop - 1
        assert low < nees(found[:, last], gains.P[last][SEEN, SEEN]).mean() < high
    moments = np.diagonal(gains.P, axis1=1, axis2=2)[:, SEEN]
    ratio = np.sqrt(moments / bound(world, draws))
    assert (ratio > 0.999).all()
    assert (ratio < 1.05).all()


def test_a_wrong_noise_leaves_the_band(world, draws):
    gains = kalman(world, 0.01 * tuned_share(world))
    last = world.settings.stretches[0].stop - 1
    found = errors(world, draws, gains)[:, last, SEEN]
    assert nees(found, gains.P[last]).mean() > 10 * mean_band(4, DRAWS)[1]


def test_matched_noise_is_the_best_there_is(world):
    def cost(share):
        moments = np.diagonal(second_moments(world, kalman(world, share), 100), axis1=1, axis2=2)
        return np.mean(moments[:, SEEN] / np.diag(world.R))

    share = tuned_share(world)
    assert cost(share) < min(cost(2 * share), cost(share / 2))
    # White velocity noise alone is what (2.3) has room for: then nothing is to be added.
    white = World(
        settings(accel_bias_mps2=0.0, accel_bias_walk_mps2_sqrt_s=0.0, velocity_walk_mps_sqrt_s=0.02)
    )
    assert tuned_share(white) == pytest.approx(1, rel=0.1)


def test_robust_filter_keeps_its_gamma_on_the_worst_of_its_noises(world):
    """Energy of the error over that of the noises, for noises along the plant's worst direction and for white
    ones: never above gamma, which is of all."""
    model = plant(world)
    made = design(model, When.FILTERED)
    gamma, K = made.gamma, made.K
    rng = np.random.default_rng(2)
    for frequency in (None, 0.0, 0.3, 1.0, 2.0, 3.1):
        e, spent, missed = np.zeros(4), 0.0, 0.0
        direction = rng.standard_normal(6)
        for k in range(300):
            v = rng.standard_normal(6) if frequency is None else direction * np.cos(frequency * k)
            e = (model.A + rng.standard_normal() * model.A_s) @ e + model.B @ v
            e = e - K @ (e + model.D @ v)
            spent, missed = spent + v @ v, missed + e @ e
        assert missed < gamma**2 * spent


def test_ins_alone_starts_from_the_corrected_one_and_runs_away(world, draws):
    corrected = errors(world, draws, kalman(world))
    free = free_running(world, draws, corrected)
    for area in world.settings.stretches[::2]:
        np.testing.assert_array_equal(free[:, area.start, SEEN], corrected[:, area.start, SEEN])
    end = world.settings.stretches[1].stop - 1
    # Mostly half bias times time squared: along a turning course somewhat less.
    expected = 0.5 * 0.01 * end**2
    assert 0.4 * expected < free[:, end, 0].std() < 1.1 * expected


def test_a_constant_rate_is_learnt_exactly():
    time = np.arange(150.0)
    shown = np.column_stack([2 * time, time, np.full(150, 2.0), np.full(150, 1.0)])
    rate = np.array([0.03, -0.02])
    velocity = rate * time[:, None]
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(velocity[:-1], axis=0)])
    taken_out = np.concatenate([position, velocity], axis=1)
    made = xu2012_bridges.by_rates(shown, taken_out, slice(0, 100), slice(100, 150), 1.0)
    np.testing.assert_allclose(made, taken_out[100:], rtol=1e-6)


@pytest.fixture(scope="module")
def done():
    return xu2012.trial(settings(**SMALL), 3, 7)


def test_study_end_to_end_and_the_same_again(done, tmp_path):
    made = xu2012.study(settings(**SMALL), 3, 7)
    assert [table.name for table in made.tables] == [
        "training_area_1",
        "outage_1",
        "training_area_2",
        "outage_2",
        "parameters",
    ]
    forms = {row.form for row in made.tables[1].rows}
    assert forms == set(Form)
    published = {row.method for row in made.tables[1].rows if row.form is Form.PUBLISHED}
    assert published == {"H-infinity", "back-propagation", "LS-SVM"}
    # The terminal has 80 columns, and the bound a figure in some.
    brief = [metric.key for metric in made.tables[1].metrics if metric.brief]
    assert brief == [
        "position_rms_m",
        "velocity_rms_mps",
        "position_over_bound",
        "velocity_over_bound",
        "nees",
    ]
    assert set(made.tables[1].rows[-1].values) <= set(brief)
    by_name = {row.method: row for row in made.tables[1].rows}
    method = done.methods["lssvm"]
    outage = slice(40, 55)
    values = by_name["LS-SVM"].values
    assert values["x_mean_m"].value == pytest.approx(np.abs(method.errors[:, outage, 0]).mean())
    squares = np.sum(method.errors[:, outage, :2] ** 2, axis=2)
    assert values["position_rms_m"].value == pytest.approx(np.sqrt(squares.mean()))
    assert "LS-SVM" not in {row.method for row in made.tables[0].rows}
    ins, filtered = done.methods["ins"].errors, done.methods["hinf"].errors
    np.testing.assert_array_equal(ins[:, 55], filtered[:, 55])
    assert np.abs(ins[:, 54]).mean() > 3 * np.abs(filtered[:, 54]).mean()
    lengths = {len(column) for column in made.estimates.values()}
    assert lengths == {3 * 110}
    np.testing.assert_array_equal(made.estimates["lssvm: error_y_m"], method.errors[..., 1].ravel())
    assert made.write_recording is not None
    made.write_recording(tmp_path / "recording.rrd")
    assert (tmp_path / "recording.rrd").stat().st_size > 10_000


INS, BP = "ins", "mlp"
REPRODUCED, PARTLY, NOT, UNDECIDED = Verdict.REPRODUCED, Verdict.PARTLY, Verdict.NOT, Verdict.UNDECIDED
REDUCED_P, REDUCED_V, BOTH_REDUCE, SMALLEST, ROBUST, BRIDGED_P, BRIDGED_V, BOTH_BRIDGE, KEEPS = range(9)
"""Claims in their order."""


def fabricated(sizes, draws=40, noise=0.0):
    """A trial whose methods' errors are of the given sizes: of a number, of components (4,), or of epochs and
    components (n, 4). The same in all draws but for ``noise``, in standard deviations, so that intervals
    are points without it."""
    world = World(settings(**SMALL))
    rng = np.random.default_rng(1)
    told = [f"{key}_told_{share:g}" for key in ("kf", "hinf") for share in world.settings.mistuned]
    methods = {}
    for key in (INS, "kf", *told, "hinf", "hinf_mended", "kf_biases", BP, "lssvm", "rates"):
        spread = 1 + noise * rng.standard_normal((draws, 1, 1))
        found = np.ones((draws, 110, 4)) * sizes.get(key, 1.0) * spread
        methods[key] = xu2012.Method(key, Form.BASELINE, "", found, np.tile(np.eye(4), (110, 1, 1)))
    return xu2012.Trial(world, methods, np.ones((110, 4)), np.ones((draws, 2, 3)))


def judged(sizes, **how):
    return [claim.verdict for claim in claims_of(fabricated(sizes, **how))]


@pytest.mark.parametrize(
    ("claim", "sizes", "expected"),
    [
        # 85 % and 80 % less ten points: a quarter, and three tenths, of the KF's are enough.
        (REDUCED_P, {"hinf": [0.24, 0.29, 1, 1]}, REPRODUCED),
        (REDUCED_P, {"hinf": [0.26, 0.29, 1, 1]}, PARTLY),
        (REDUCED_P, {"hinf": [0.1, 1.1, 1, 1]}, NOT),
        (REDUCED_V, {"hinf": [1, 1, 0.39, 0.34]}, REPRODUCED),
        (REDUCED_V, {"hinf": [0.1, 0.1, 0.9, 0.9]}, PARTLY),
        (REDUCED_V, {"hinf": [0.1, 0.1, 1.1, 1.1]}, NOT),
        (BOTH_REDUCE, {INS: 3.0}, REPRODUCED),
        (BOTH_REDUCE, {INS: 3.0, "hinf": [1, 1, 1, 4]}, PARTLY),
        (BOTH_REDUCE, {INS: 0.5}, NOT),
        (SMALLEST, {"hinf": 0.9}, REPRODUCED),
        (SMALLEST, {"hinf": [0.9, 0.9, 0.9, 1.1]}, NOT),
        (BRIDGED_P, {"lssvm": [0.29, 0.39, 1, 1]}, REPRODUCED),
        (BRIDGED_P, {"lssvm": 0.5}, PARTLY),
        (BRIDGED_V, {"lssvm": [1, 1, 0.69, 0.39]}, REPRODUCED),
        (BRIDGED_V, {"lssvm": [1, 1, 0.69, 0.41]}, PARTLY),
        (BRIDGED_V, {"lssvm": [1, 1, 0.69, 1.01]}, NOT),
        (BOTH_BRIDGE, {INS: 2.0}, REPRODUCED),
        (BOTH_BRIDGE, {INS: 2.0, BP: 3.0}, PARTLY),
        (KEEPS, {"lssvm": 0.5}, REPRODUCED),
        (KEEPS, {"lssvm": 0.5, "kf_biases": 0.1}, PARTLY),
        (KEEPS, {"lssvm": 2.0}, NOT),
    ],
)
def test_claims_are_judged_by_their_rules(claim, sizes, expected):
    assert judged(sizes)[claim] is expected


def test_robust_is_who_errs_less_when_told_the_same():
    """In all components and places: reproduced. Told 0.01 and 0.0001 of the noise."""
    one, other = "hinf_told_0.01", "hinf_told_0.0001"
    assert judged({one: 0.5, other: 0.9})[ROBUST] is REPRODUCED
    # Position alone; position, where only one share was smaller; and none.
    assert judged({one: [0.5, 0.5, 1.5, 1.5], other: [0.2, 0.2, 1.5, 1.5]})[ROBUST] is PARTLY
    assert judged({one: [0.5, 0.5, 1.5, 1.5], other: 1.5})[ROBUST] is NOT
    # What either filter makes of the right noise is no matter.
    assert judged({"kf": 0.1, one: 1.5, other: 1.5})[ROBUST] is NOT
    # The areas alone: 110 epochs, of which 40 to 55 and 95 to 110 are outages.
    place = np.full((110, 4), 0.5)
    place[40:55], place[95:] = 1.5, 1.5
    assert judged({one: place, other: place})[ROBUST] is PARTLY


def test_what_noise_can_decide_is_undecided():
    """Methods that differ by a hundredth, draws by three tenths: intervals are a tenth wide."""
    sizes = dict.fromkeys(("hinf", "hinf_told_0.01", "hinf_told_0.0001", "lssvm"), 0.99)
    found = judged(sizes, noise=0.3)
    assert found[SMALLEST] is UNDECIDED
    assert found[ROBUST] is UNDECIDED
    assert found[REDUCED_P] is UNDECIDED
    assert judged({INS: 1.0}, noise=0.3)[BOTH_REDUCE] is UNDECIDED


def test_few_draws_and_none_that_is_mistuned_decide_nothing(done):
    claims = claims_of(done)
    assert [claim.verdict for claim in claims] == [UNDECIDED] * 9
    good = fabricated({"hinf_told_0.01": 0.5})
    world = World(settings(**SMALL, mistuned=[]))
    claim = claims_of(replace(good, world=world))[ROBUST]
    assert (claim.verdict, claim.measured) == (UNDECIDED, "No too small noise was run.")


def test_consistency_is_told_with_the_band_of_one_stretch_and_of_all():
    """Four errors of the size s have a NEES of 4 s^2: here 4, 4, 6.76 and 5.02. The bands of 40 draws end at
    4.92 for one stretch, and at 5.20 for all four."""
    sizes = np.ones((110, 4))
    sizes[109] = 1.12
    sizes[94] = 1.3
    told = xu2012.consistency_note(fabricated({"kf_biases": sizes}))
    low, high = mean_band(4, 40)
    assert "4.00, 4.00, 6.76, 5.02 of 4" in told
    assert f"2 of 4 within the 95 % band of each, {low:.2f} to {high:.2f}" in told
    assert "3 of 4 within the 95 % band of all four at once" in told


def test_figures_show_the_stretches_they_name(done):
    figures = {figure.name: figure for figure in figures_of(done)}
    assert set(figures) >= {"figure_3", "figures_4_5", "figures_6_7", "figures_8_9", "figures_10_11"}
    curve = figures["figures_8_9"].panels[0][1].curves[2]
    assert curve.label == "LS-SVM"
    np.testing.assert_array_equal(curve.x, np.arange(40, 55))
    np.testing.assert_array_equal(curve.y, done.methods["lssvm"].errors[0, 40:55, 1])
    assert figures["over_draws"].panels[0][0].shaded == ((40.0, 54.0), (95.0, 109.0))
    area = done.world.settings.stretches[0]
    nodes, track = reference_nodes(done, area), done.world.course[0][area]
    assert np.linalg.norm(nodes[:, None] - track, axis=2).min(axis=1).max() <= REACH_M


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"training_area_s": [0.0, 100.0]},
            r"training_area_s = 0 s in area 1: is empty; allowed is 20 periods",
        ),
        ({"training_area_s": []}, "an empty training area; allowed are two times, .* each of 20 periods"),
        ({"outage_s": [50.0]}, "1 of them; allowed are two times, of outages 1 and 2, each of one period"),
        ({"training_area_s": [100.0, 12.0]}, r"training_area_s = 12 s in area 2: holds 12 points"),
        ({"outage_s": [0.2, 50.0]}, r"outage_s = 0.2 s in outage 1: allowed is a period of 1 s or more"),
        ({"period_s": 0.01}, r"period_s = 0.01 s: allowed is 20000 periods"),
        ({"waypoints_m": [[0, 0], [0, 0]]}, r"waypoints_m: \(0, 0\) m twice in a row"),
        ({"position_sd_m": 0.0}, "position_sd_m"),
    ],
)
def test_mistakes_are_told(changes, told):
    with pytest.raises(ValidationError, match=told) as mistake:
        settings(**changes)
    assert mistake.value.error_count() == 1
