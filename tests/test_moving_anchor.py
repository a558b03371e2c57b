"""Nodes against one moving anchor: ranges by signal strength, solutions of all beacons, filters over them."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from fleetalign.align.consistency import mean_band, nees
from fleetalign.cosim.papers.xu2019_precision import line, sds_apart
from fleetalign.network.localization.beacons import (
    Heard,
    least_squares,
    linear,
    linear_weighted,
    listening,
    log_likelihood,
    quasi_likelihood,
)
from fleetalign.network.localization.bounded import posterior_mean
from fleetalign.network.localization.cubature import Filter, Rules, Threshold, track_beacons
from fleetalign.network.localization.plane import distances, range_bound
from fleetalign.network.localization.problem import LocalizationError
from fleetalign.network.localization.ranging import PathLossErrors, RangeNoise, UniformErrors
from scipy.optimize import least_squares as scipy_least_squares

HEIGHT, REACH = 10.0, 50.0
UNIFORM = UniformErrors()


def drawn(nodes, errors=UNIFORM, seed=4):
    """Nodes in 60 x 40 m under five lanes of beacons 3 m apart, what they hear, and the bound of each."""
    rng = np.random.default_rng(seed)
    east, north = np.meshgrid(np.arange(0.0, 61, 3), np.linspace(0, 40, 5))
    beacons = np.column_stack([east.ravel(), north.ravel()])
    x = rng.uniform([0, 0], [60, 40], (nodes, 2))
    d, _ = distances(x, beacons, HEIGHT)
    seen = listening(beacons, errors.draw(d, rng), d <= REACH, HEIGHT)
    sd = seen.sd(errors.noise, distances(x, seen.anchors, seen.rise)[0])
    return x, seen, range_bound(x, seen.anchors, sd, seen.rise)


def last(kind, x0, P0, seen, noise=UNIFORM.noise, **rules):
    states = track_beacons(
        kind, x0, P0, seen.anchors, seen.ranges, noise, seen.heard, seen.rise, Rules(**rules)
    )
    return deque(states, maxlen=1)[0]


def rms(error):
    return np.sqrt(np.mean(np.sum(error**2, axis=-1)))


def over_bound(error, bound):
    return rms(error) / np.sqrt(np.trace(bound, axis1=-2, axis2=-1).mean())


def test_range_errors_are_as_told():
    rng, d = np.random.default_rng(1), np.full(200_000, 20.0)
    for errors in (UNIFORM, PathLossErrors(kind="path_loss", shadowing_db=3.0)):
        factor = errors.draw(d, rng) / d
        assert factor.mean() == pytest.approx(1, abs=0.003)
        assert factor.std() == pytest.approx(errors.noise.share, rel=0.01)
    assert UNIFORM.noise.share == pytest.approx(0.15 / np.sqrt(3))
    assert np.log(factor).std() == pytest.approx(errors.log_sd, rel=0.01)
    # 25 dB a decade: 2.5 dB are a factor of 10^0.1.
    assert PathLossErrors(kind="path_loss", shadowing_db=2.5).log_sd == pytest.approx(np.log(10) / 10)


def test_linear_solutions_of_exact_slant_ranges_are_exact():
    x, seen, _ = drawn(20)
    seen = replace(seen, ranges=np.where(seen.heard, distances(x, seen.anchors, HEIGHT)[0], 1.0))
    np.testing.assert_allclose(linear(seen), x, atol=1e-8)
    np.testing.assert_allclose(linear_weighted(seen, RangeNoise(sd_m=1.0)), x, atol=1e-8)


def test_gradients_of_slant_distances():
    x, anchors, step = np.array([3.0, 4.0]), np.array([[10.0, -2.0], [3.0, 4.0]]), 1e-6
    _, u = distances(x, anchors, HEIGHT)
    for k in range(2):
        ahead, behind = (distances(x + s * step * np.eye(2)[k], anchors, HEIGHT)[0] for s in (1, -1))
        np.testing.assert_allclose(u[:, k], (ahead - behind) / (2 * step), atol=1e-8)


def test_weights_at_the_estimate_reach_the_bound():
    x, seen, bound = drawn(1500)
    found = quasi_likelihood(seen, UNIFORM.noise, linear(seen))
    assert found.converged.all()
    # 1500 nodes: the ratio is known to 1.3 %, one sigma.
    assert 0.95 < over_bound(found.x - x, bound) < 1.05
    low, high = mean_band(2, len(x), 0.999)
    assert low < nees(found.x - x, found.cov).mean() < high
    by_length = least_squares(seen, UNIFORM.noise, linear(seen))
    assert over_bound(by_length.x - x, bound) > 1.15
    assert over_bound(linear_weighted(seen, UNIFORM.noise) - x, bound) > 1.2
    assert over_bound(linear(seen) - x, bound) > 3


def test_least_squares_of_logarithms_is_the_likelihoods():
    errors = PathLossErrors(kind="path_loss", shadowing_db=4.0)
    x, seen, _ = drawn(1000, errors)
    found = log_likelihood(seen, errors.log_sd, linear_weighted(seen, errors.noise))
    logs = np.log(seen.ranges) + 0.5 * errors.log_sd**2
    for i in range(5):
        own = seen.heard[i]

        def residuals(at, i=i, own=own):
            return (logs[i] - np.log(distances(at, seen.anchors[i], HEIGHT)[0]))[own]

        oracle = scipy_least_squares(residuals, x[i], xtol=1e-12, ftol=1e-12, gtol=1e-12).x
        np.testing.assert_allclose(found.x[i], oracle, atol=1e-3)
    # The bound with the logarithms' deviation is exact for these; 1000 nodes: 1.6 %, one sigma.
    sd = seen.sd(RangeNoise(share=errors.log_sd), distances(x, seen.anchors, HEIGHT)[0])
    assert 0.95 < over_bound(found.x - x, range_bound(x, seen.anchors, sd, HEIGHT)) < 1.05


def test_the_exact_treatment_holds_the_truth_and_beats_the_gaussian_bound():
    x, seen, bound = drawn(150)
    start = quasi_likelihood(seen, UNIFORM.noise, linear(seen))
    found = posterior_mean(seen, UNIFORM.share, start.x, np.full(len(x), 4.0))
    assert over_bound(found.x - x, bound) < 0.6
    low, high = mean_band(2, len(x), 0.999)
    assert low < nees(found.x - x, found.cov).mean() < high
    # Rejection from a box, by itself; a thousand points or more leave a tenth of a deviation at most.
    rng = np.random.default_rng(2)
    for i in range(3):
        sd = np.sqrt(np.diagonal(found.cov[i]))
        points = found.x[i] + 5 * sd * rng.uniform(-1, 1, (40_000, 2))
        d = np.hypot(np.linalg.norm(points[:, None] - seen.anchors[i, seen.heard[i]], axis=-1), HEIGHT)
        error = seen.ranges[i, seen.heard[i]] / d - 1
        inside = (np.abs(error) <= UNIFORM.share).all(axis=-1)
        assert inside.sum() > 1000
        weight = np.prod(20 / d[inside], axis=-1)
        mean = weight @ points[inside] / weight.sum()
        assert np.linalg.norm(mean - found.x[i]) < 0.15 * np.sqrt(np.trace(found.cov[i]))


def halves(seen):
    """A quarter of what is heard, for a start, and the rest."""
    start = seen.heard & (np.cumsum(seen.heard, axis=-1) % 4 == 0)
    return replace(seen, heard=start), replace(seen, heard=seen.heard & ~start)


@pytest.mark.parametrize("kind", Filter)
def test_filters_from_a_start_of_their_own_reach_the_bound(kind):
    x, seen, bound = drawn(1500)
    first, rest = halves(seen)
    start = quasi_likelihood(first, UNIFORM.noise, linear_weighted(first, UNIFORM.noise))
    found = last(kind, start.x, start.cov, rest)
    assert over_bound(found.x - x, bound) < 1.05
    low, high = mean_band(2, len(x), 0.999)
    assert low < nees(found.x - x, found.P).mean() < high
    assert (found.used == rest.heard.sum(axis=-1)).all()
    # Of precise ranges nothing but the linear terms is left, and all filters are the batch solution.
    noise = RangeNoise(sd_m=1e-3)
    exact = distances(x, seen.anchors, HEIGHT)[0]
    ranges = exact + 1e-3 * np.random.default_rng(6).standard_normal(exact.shape)
    precise = replace(seen, ranges=np.where(seen.heard, ranges, 1.0))
    first, rest = halves(precise)
    start, batch = (quasi_likelihood(s, noise, x) for s in (first, precise))
    found = last(kind, start.x, start.cov, rest, noise)
    np.testing.assert_allclose(found.x, batch.x, atol=1e-6)
    np.testing.assert_allclose(found.P, batch.cov, rtol=1e-3, atol=1e-12)


def wide(seen, sd=3.0, dtype=float):
    return linear(seen).astype(dtype), np.tile(sd**2 * np.eye(2, dtype=dtype), (len(seen.heard), 1, 1))


def test_the_square_root_changes_no_digit_that_counts():
    _, seen, _ = drawn(200)
    plain, root = (last(kind, *wide(seen), seen) for kind in (Filter.CUBATURE, Filter.SQUARE_ROOT))
    np.testing.assert_allclose(root.x, plain.x, atol=1e-8)
    np.testing.assert_allclose(root.P, plain.P, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(root.log_likelihood, plain.log_likelihood, atol=1e-6)


def test_in_single_precision_the_square_root_keeps_the_estimate_that_the_plain_filter_loses():
    # (10 m / 1 mm)^2 is beyond the 24 bits of single precision, 10 m / 1 mm is not; and nothing curves: what
    # is open in the beginning lies along the first ranges, and 5 cm across 60 m are 0.02 mm.
    case = line([np.random.default_rng(k) for k in range(30)], 8)
    found = {
        (kind, dtype): last(kind, case.start.astype(dtype), case.cov.astype(dtype), case.seen, case.noise)
        for kind in (Filter.CUBATURE, Filter.SQUARE_ROOT)
        for dtype in (np.float32, np.float64)
    }
    reference = found[Filter.CUBATURE, np.float64]
    low, high = mean_band(2, len(case.x), 0.999)
    assert low < nees(reference.x - case.x, reference.P).mean() < high
    # 240 nodes: the ratio is known to 3 %, one sigma.
    assert 0.9 < over_bound(reference.x - case.x, case.bound) < 1.1
    assert sds_apart(found[Filter.SQUARE_ROOT, np.float64], reference).max() < 1e-5
    root, plain = (found[kind, np.float32] for kind in (Filter.SQUARE_ROOT, Filter.CUBATURE))
    assert root.P.dtype == plain.P.dtype == np.float32
    # Positions of 200 m are known to 8 um in single precision, and to 0.3 mm by the ranges.
    assert sds_apart(root, reference).max() < 0.2
    assert low < nees(root.x - case.x, root.P).mean() < high
    assert over_bound(root.x - case.x, case.bound) < 1.1
    assert plain.lost.mean() > 0.2
    assert over_bound(plain.x - case.x, case.bound) > 100


def test_the_threshold_as_printed_stops_the_filter():
    x, seen, _ = drawn(300)
    x0, P0 = wide(seen)
    rules = {"threshold": Threshold.PRINTED, "alpha": 0.0}
    states = list(
        track_beacons(
            Filter.SQUARE_ROOT,
            x0,
            P0,
            seen.anchors,
            seen.ranges,
            UNIFORM.noise,
            seen.heard,
            HEIGHT,
            Rules(**rules),
        )
    )
    # One of each pair of points is gone: after k beacons no more than 2^-k of the variance is left.
    k = 6
    assert (np.trace(states[k - 1].P, axis1=1, axis2=2) <= 18.0 * 2.0**-k).all()
    assert np.abs(states[-1].x - states[20].x).max() < 1e-3
    free = last(Filter.SQUARE_ROOT, x0, P0, seen)
    assert rms(states[-1].x - x) > 2 * rms(free.x - x)


def test_a_threshold_on_sizes_stops_at_alpha_and_one_on_information_stays_consistent():
    x, seen, _ = drawn(1000)
    first, rest = halves(seen)
    start = quasi_likelihood(first, UNIFORM.noise, linear_weighted(first, UNIFORM.noise))
    free, size, information = (
        last(Filter.SQUARE_ROOT, start.x, start.cov, rest, threshold=threshold, alpha=alpha)
        for threshold, alpha in ((Threshold.NONE, 0), (Threshold.SIZE, 0.3), (Threshold.INFORMATION, 0.15))
    )
    assert rms(size.x - x) > 1.1 * rms(free.x - x)
    assert nees(size.x - x, size.P + 1e-12 * np.eye(2)).mean() > 10
    used = information.used.sum() / rest.heard.sum()
    assert 0.1 < used < 0.9
    assert rms(information.x - x) < 1.4 * rms(free.x - x)
    low, high = mean_band(2, len(x), 0.999)
    assert low < nees(information.x - x, information.P).mean() < high


def test_process_noise_of_the_ranges_variance_forgets_all_but_the_last():
    x, seen, _ = drawn(300)
    free = last(Filter.CUBATURE, *wide(seen), seen)
    printed = last(Filter.CUBATURE, *wide(seen), seen, process_noise_is_R=True)
    assert rms(printed.x - x) > 4 * rms(free.x - x)
    little = last(Filter.CUBATURE, *wide(seen), seen, process_sd_m=0.05)
    assert (np.trace(little.P, axis1=1, axis2=2) > np.trace(free.P, axis1=1, axis2=2)).all()


BEACONS = np.array([[0.0, 0.0], [5.0, 0.0], [10.0, 0.0], [10.0, 8.0]])


def test_what_a_node_must_hear():
    heard = np.array([[True, True, True, True], [True, True, True, False]])
    ranges = np.full((2, 4), 7.0)
    assert isinstance(listening(BEACONS, ranges[:1], heard[:1]), Heard)
    with pytest.raises(LocalizationError, match="node 1: all 3 anchors lie on a line"):
        listening(BEACONS, ranges, heard)
    heard[0, :2] = False
    with pytest.raises(LocalizationError, match="node 0: 2 anchors: at least 3"):
        listening(BEACONS, ranges, heard)


@pytest.mark.parametrize("value", [0.0, -2.0, np.nan])
def test_ranges_of_nothing_are_refused_where_they_are_heard(value):
    ranges = np.array([[7.0, 7.0, 7.0, value]])
    with pytest.raises(LocalizationError, match=r"node 0: range 3 = .* m: must be positive"):
        listening(BEACONS, ranges, np.ones((1, 4), bool))
    padded = np.vstack([BEACONS, [[0.0, 8.0]]])
    listening(padded, np.append(ranges, [[7.0]], axis=1), np.array([[True, True, True, False, True]]))
