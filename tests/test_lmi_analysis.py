"""Analysis of a filter's closed loop, against sums over all delays that can happen."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from fleetalign.align.lmi.analysis import (
    ClosedLoop,
    analyze,
    energy_gain,
    holds,
    peak_gain,
)
from fleetalign.align.lmi.lmmse import lmmse
from fleetalign.align.lmi.plant import Augmented, Filter, Plant, checked_polytope, mixture
from scipy.linalg import solve_discrete_lyapunov

A, B = [[0.5, 0.2], [0.0, 0.3]], [[0.3, 0.0], [0.5, 0.0]]
C, D, H = [[1.0, 0.5]], [[0.0, 0.4]], [[1.0, 0.0], [0.0, 1.0]]


@pytest.fixture(scope="module")
def plant():
    """Late four times in ten."""
    return Plant(A, B, C, D, H, rho=0.6)


@pytest.fixture(scope="module")
def filter_(plant):
    """A filter that is good, but best in no sense."""
    best = lmmse(plant).filter
    return Filter(0.6 * best.Af, 0.8 * best.Bf, best.Cf, 0.7 * best.Df)


def outcomes(plant, filter_, steps):
    """Probability and map (p, steps * l) from w to the last error, for each sequence of delays.

    Steps through the plant and the filter as they are written in eqs. (10) and (11).
    """
    n, width, m, _ = plant.shape
    for late in product((False, True), repeat=steps):
        x, x_f, y_before = (np.zeros((rows, steps * width)) for rows in (n, filter_.order, m))
        for k in range(steps):
            w = np.zeros((width, steps * width))
            w[:, k * width : (k + 1) * width] = np.eye(width)
            y = plant.C @ x + plant.D @ w
            received = y_before if late[k] else y
            e = plant.H @ x - filter_.Cf @ x_f - filter_.Df @ received
            x_f = filter_.Af @ x_f + filter_.Bf @ received
            x, y_before = plant.A @ x + plant.B @ w, y
        yield np.prod(np.where(late, 1 - plant.rho, plant.rho)), late, e


@pytest.fixture(scope="module")
def watched():
    """A poor filter: a disturbance that watches the delays does 3 % more than one that does not."""
    plant = Plant(
        [[-0.1, 0.4], [0.1, -0.3]], [[-0.2, -1.2], [-1.0, -1.9]], [[-0.7, 1.3]], [[-0.6, 0.8]], [[0.0, -0.7]],
        rho=0.5,
    )  # fmt: skip
    f = ([[0.4, 0.2], [-0.5, 0.3]], [[-1.1], [-0.2]], [[0.7, -0.3]], [[0.6]])
    return plant, Filter(*map(np.array, f))


def test_peak_gain_against_deterministic_disturbances(watched):
    whole = sum(p * G.T @ G for p, _, G in outcomes(*watched, 10))
    direct = np.sqrt(np.linalg.eigvalsh(whole)[-1])
    # What came more than ten steps ago adds less than 1e-4.
    assert peak_gain(ClosedLoop.of(*watched), adapted=False) == pytest.approx(direct, rel=1e-4)


def test_peak_gain_against_adapted_disturbances(watched):
    """A disturbance for each node of the tree of delays, weighted by the node's probability."""
    steps, width = 8, 2
    nodes = {late: i for i, late in enumerate(s for k in range(steps) for s in product((0, 1), repeat=k))}
    weight = np.zeros(len(nodes) * width)
    whole = np.zeros((len(weight), len(weight)))
    for p, late, G in outcomes(*watched, steps):
        path = [nodes[tuple(map(int, late[:k]))] for k in range(steps)]
        index = np.concatenate([np.arange(width) + width * i for i in path])
        whole[np.ix_(index, index)] += p * G.T @ G
        weight[index] += p
    scaled = whole / np.sqrt(np.outer(weight, weight))
    direct = np.sqrt(np.linalg.eigvalsh(scaled)[-1])
    loop = ClosedLoop.of(*watched)
    # Eight steps miss less than 2e-4.
    assert direct < peak_gain(loop, adapted=True) < direct * (1 + 3e-4)
    assert peak_gain(loop, adapted=True) > 1.03 * peak_gain(loop, adapted=False)


def test_energy_gains_by_recursion_and_by_frequencies(watched):
    loop = ClosedLoop.of(*watched)
    exact = energy_gain(loop, adapted=False)
    assert holds(loop, exact * 1.002, adapted=False, energy=True)
    assert not holds(loop, exact * 0.999, adapted=False, energy=True)
    worse = energy_gain(loop, adapted=True)
    assert exact * (1 + 1e-4) < worse < exact * 1.1


def test_without_delay_all_peak_gains_are_the_gramians(plant, filter_):
    prompt = Plant(A, B, C, D, H)
    short = Filter(filter_.Af[:2, :2], filter_.Bf[:2], filter_.Cf[:, :2], filter_.Df)
    loop = ClosedLoop.of(prompt, short)
    whole = np.vstack([G for _, late, G in outcomes(prompt, short, 12) if not any(late)])
    direct = np.linalg.norm(whole, 2)
    for adapted in (False, True):
        assert peak_gain(loop, adapted) == pytest.approx(direct, rel=1e-5)
        assert holds(loop, direct * (1 + 1e-5), adapted, energy=False)
        assert not holds(loop, direct * (1 - 1e-5), adapted, energy=False)


def test_covariance_and_stability_are_those_of_the_whole_operator(plant, filter_):
    loop = ClosedLoop.of(plant, filter_)
    operator = np.kron(loop.A0, loop.A0) + loop.s**2 * np.kron(loop.A1, loop.A1)
    assert loop.spectral_radius == pytest.approx(np.abs(np.linalg.eigvals(operator)).max(), rel=1e-9)
    source = loop.B0 @ loop.B0.T + loop.s**2 * loop.B1 @ loop.B1.T
    direct = np.linalg.solve(np.eye(len(operator)) - operator, source.ravel()).reshape(source.shape)
    np.testing.assert_allclose(loop.gramian, direct, atol=1e-12)
    error = loop.c0.T @ loop.c0 + loop.s**2 * loop.c1.T @ loop.c1
    direct = np.linalg.solve(np.eye(len(operator)) - operator.T, error.ravel()).reshape(error.shape)
    np.testing.assert_allclose(loop.observability, direct, atol=1e-12)
    np.testing.assert_allclose(loop.carried(loop.gramian), loop.gramian, atol=1e-12)


def test_covariance_under_delay_is_not_the_peak_gain(plant, filter_):
    loop = ClosedLoop.of(plant, filter_)
    white = np.sqrt(np.linalg.eigvalsh(loop.error_covariance)[-1])
    assert white > 1.03 * peak_gain(loop, adapted=True)


def test_simulation_agrees_and_tells_another_plant(plant, filter_):
    found = analyze(plant, filter_)
    assert found.simulation_agrees
    assert found.simulated_sd < 0.03 * found.expected_rms
    other = analyze(Plant(A, B, C, D, H, rho=0.3), filter_)
    assert other.simulation_agrees
    assert not replace(other, expected_rms=found.expected_rms).simulation_agrees


def test_unstable_loop_has_no_gain(plant, filter_):
    loop = ClosedLoop.of(plant, Filter(9 * filter_.Af, filter_.Bf, filter_.Cf, filter_.Df))
    assert loop.spectral_radius > 1
    assert not holds(loop, 1e9, adapted=True, energy=False)
    assert peak_gain(loop, adapted=True) == energy_gain(loop, adapted=False) == np.inf


def test_best_linear_filter_without_delay_is_kalmans(plant):
    prompt = Plant(A, B, C, D, H)
    found = lmmse(prompt)
    loop = ClosedLoop.of(prompt, found.filter)
    assert found.rms == pytest.approx(np.sqrt(np.trace(loop.error_covariance)), rel=1e-9)
    S = prompt.C @ found.P @ prompt.C.T + prompt.D @ prompt.D.T
    np.testing.assert_allclose(found.S, S)


def test_best_linear_filter_is_best(plant):
    """Every step aside costs; with late outputs as well."""
    found = lmmse(plant)
    rng = np.random.default_rng(5)
    f = found.filter

    def rms(filter_):
        return np.sqrt(np.trace(ClosedLoop.of(plant, filter_).error_covariance))

    assert found.rms == pytest.approx(rms(f), rel=1e-9)
    for _ in range(20):
        aside = [part + 0.02 * rng.normal(size=part.shape) for part in (f.Af, f.Bf, f.Cf, f.Df)]
        assert rms(Filter(*aside)) > found.rms
    np.testing.assert_allclose(
        found.M,
        solve_discrete_lyapunov(Augmented.of(plant).A, Augmented.of(plant).B @ Augmented.of(plant).B.T),
    )


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"A": [[0.5, 0.2]]}, "A is 1 by 2: must be 1 by 1"),
        ({"B": [[1.0], [0.0]]}, "B is 2 by 1: must be 2 by 2"),
        ({"C": [[1.0]]}, "C is 1 by 1: must be 1 by 2"),
        ({"H": [[1.0]]}, "H is 1 by 1: must be 1 by 2"),
        ({"D": [[1.0, np.nan]]}, "D: holds a number that is not finite"),
        ({"D": [[1.0, 2.0], [3.0]]}, "D: not a matrix of numbers"),
        ({"H": [1.0, 2.0]}, "H: must have rows and columns"),
        ({"H": "x"}, "H: not a matrix of numbers"),
        ({"rho": 0.0}, r"rho = 0.0: allowed is \(0, 1\]"),
        ({"rho": 1.5}, "rho = 1.5"),
        ({"rho": np.nan}, "rho = nan"),
        ({"rho": "0.5"}, "rho = '0.5'"),
        ({"rho": True}, "rho = True"),
    ],
)
def test_mistakes_in_a_plant(changes, told):
    with pytest.raises(ValueError, match=f"^{told}") as mistake:
        Plant(**{"A": A, "B": B, "C": C, "D": D, "H": H, "rho": 0.6, **changes})
    assert "\n" not in str(mistake.value)


def test_vertices_of_one_polytope_are_alike(plant):
    other = Plant(A, B, [[1.0, 0.0], [0.0, 1.0]], [[0.0, 0.1], [0.1, 0.0]], H, rho=0.6)
    with pytest.raises(ValueError, match="vertex 2 has"):
        checked_polytope([plant, other])
    with pytest.raises(ValueError, match=r"vertex 3 has .* rho 1"):
        checked_polytope([plant, plant, Plant(A, B, C, D, H)])
    with pytest.raises(ValueError, match="at least one"):
        checked_polytope([])
    middle = mixture([plant, Plant(np.zeros((2, 2)), B, C, D, H, rho=0.6)], [0.25, 0.75])
    np.testing.assert_allclose(middle.A, 0.25 * plant.A)
