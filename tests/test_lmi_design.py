"""Filters by matrix inequalities: what must agree does, and what is no filter is told by name."""

import json

import cvxpy as cp
import numpy as np
import pytest
from fleetalign.align.lmi import cache, finite_horizon
from fleetalign.align.lmi import design as design_module
from fleetalign.align.lmi.analysis import ClosedLoop, analyze, peak_gain
from fleetalign.align.lmi.design import DesignError, Kind, Outcome, confirmed, design, solve
from fleetalign.align.lmi.lmmse import lmmse, predicted
from fleetalign.align.lmi.plant import Filter, Plant, mixture

A, B = [[0.9, 0.2], [0.0, 0.7]], [[0.3, 0.0, 0.0], [0.5, 0.1, 0.0]]
C, D, H = [[1.0, 0.0]], [[0.0, 0.0, 0.5]], [[1.0, 0.0], [0.0, 1.0]]


@pytest.fixture(scope="module")
def prompt():
    return Plant(A, B, C, D, H)


@pytest.fixture(scope="module")
def late():
    """Every third output comes a step late."""
    return Plant(A, B, C, D, H, rho=0.65)


@pytest.fixture(scope="module")
def made(prompt, late, flight_cache):
    """Designs of all kinds."""
    return {(plant.rho == 1, kind): design(plant, kind) for plant in (prompt, late) for kind in Kind}


def test_without_delay_the_gain_is_the_kalman_filters(prompt, made):
    kalman = lmmse(prompt)
    least = np.sqrt(np.linalg.eigvalsh(kalman.error)[-1])
    assert peak_gain(ClosedLoop.of(prompt, kalman.filter), adapted=True) == pytest.approx(least, rel=1e-9)
    for kind in (Kind.L2LINF, Kind.THEOREM2):
        found = made[True, kind]
        assert found.gamma == pytest.approx(least, rel=1e-6)
        loop = ClosedLoop.of(prompt, found.filter)
        gramian = np.sqrt(np.linalg.eigvalsh(loop.error_covariance)[-1])
        assert gramian == pytest.approx(least, rel=1e-6)
        assert found.analyses[0].peak_deterministic == found.analyses[0].peak_adapted
        assert found.analyses[0].peak_adapted == pytest.approx(gramian, rel=1e-12)


def test_gamma_is_above_the_exact_gains(made):
    found = made[False, Kind.L2LINF]
    exact = found.analyses[0]
    assert exact.peak_deterministic <= exact.peak_adapted
    assert exact.peak_adapted * (1 + 1e-4) < found.gamma < exact.peak_adapted * 1.02


def test_energy_gain_is_tight(prompt, late, made):
    """The bounded real lemma loses nothing: here against adapted disturbances as well."""
    for plant in (prompt, late):
        found = made[plant.rho == 1, Kind.HINF]
        assert found.analyses[0].energy_adapted == pytest.approx(found.gamma, rel=2e-3)
        least_squares = analyze(plant, made[plant.rho == 1, Kind.H2].filter, energy=True)
        assert found.gamma < 0.95 * least_squares.energy_adapted


def test_h2_inequality_is_the_gramian_and_the_least_squares_filter(prompt, late, made):
    for plant in (prompt, late):
        found = made[plant.rho == 1, Kind.H2]
        assert found.gamma == pytest.approx(lmmse(plant).rms, rel=2e-6)
        assert found.analyses[0].white_rms == pytest.approx(lmmse(plant).rms, rel=1e-6)


def test_peak_filter_pays_in_white_noise(made):
    """Under late outputs its inequality is another problem than least squares, and costs there."""
    white = {kind: made[False, kind].analyses[0].white_rms for kind in (Kind.L2LINF, Kind.H2)}
    assert white[Kind.L2LINF] > 1.03 * white[Kind.H2]


def test_one_vertex_of_full_order_loses_nothing(late, made):
    assert made[False, Kind.THEOREM2].filter.order == 3
    assert made[False, Kind.THEOREM2].gamma == pytest.approx(made[False, Kind.L2LINF].gamma, rel=1e-4)


@pytest.mark.parametrize(("n", "m", "rho"), [(4, 1, 0.9), (3, 2, 0.3)])
def test_any_plant(n, m, rho):
    """What holds for the plant above holds for plants drawn at random."""
    rng = np.random.default_rng([n, m])
    A, B, D = rng.normal(size=(n, n)), rng.normal(size=(n, n + m)), 0.5 * rng.normal(size=(m, n + m))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    plant = Plant(A, B, rng.normal(size=(m, n)), D, rng.normal(size=(2, n)), rho)
    found = design(plant, use_cache=False)
    exact = found.analyses[0]
    assert exact.peak_deterministic <= exact.peak_adapted * (1 + 1e-6) <= found.gamma * (1 + 2e-5)
    assert found.gamma < 1.2 * exact.peak_adapted
    assert design(plant, Kind.THEOREM2, use_cache=False).gamma == pytest.approx(found.gamma, rel=1e-4)
    assert design(plant, Kind.H2, use_cache=False).gamma == pytest.approx(lmmse(plant).rms, rel=1e-4)


@pytest.mark.parametrize("rho", [1.0, 0.6])
def test_gain_that_corrects_the_state_needs_no_stable_plant(rho):
    """Position and velocity without any leak: the Kalman filter's gain if nothing is late, and worse if."""
    plant = Plant([[1.0, 0.2], [0.0, 1.0]], B, C, D, H, rho)
    P, _ = predicted(plant.A, plant.B, plant.C, plant.D, plant.D @ plant.D.T)
    least = np.sqrt(np.linalg.eigvalsh(P)[-1])
    found = design(plant, Kind.FEEDBACK, use_cache=False)
    assert found.analyses[0].simulation_agrees
    assert found.gamma >= found.analyses[0].peak_adapted * (1 - 1e-5)
    if rho == 1:
        assert found.gamma == pytest.approx(least, rel=1e-6)
    else:
        assert found.gamma > 1.02 * least
    f = found.filter
    less = Filter(f.Af, 0.7 * f.Bf, f.Cf, f.Df)
    with pytest.raises(DesignError, match="NOT_CONFIRMED"):
        confirmed([plant], Kind.FEEDBACK, less, found.gamma)


def test_a_filter_of_the_plants_order_costs_little(late, made):
    found = design(late, Kind.THEOREM2, order=2)
    assert found.filter.order == 2
    assert 1 + 1e-4 < found.gamma / made[False, Kind.L2LINF].gamma < 1.03


def test_one_filter_for_a_polytope(late, made):
    """It keeps its gain at every mixture of the vertices, and costs more than a filter for each."""
    other = Plant([[0.9, -0.2], [0.0, 0.5]], B, C, D, H, rho=0.65)
    found = design([late, other], Kind.THEOREM2)
    assert len(found.analyses) == 3
    for weight in (0.0, 0.2, 0.5, 0.9, 1.0):
        plant = mixture([late, other], [weight, 1 - weight])
        assert peak_gain(ClosedLoop.of(plant, found.filter), adapted=True) <= found.gamma
    assert found.gamma > made[False, Kind.L2LINF].gamma * (1 + 1e-3)


def test_units_do_not_matter(late, made):
    """Kilometres and microradians: gamma scales with z, and the solver still finds it."""
    T, y = np.diag([1e-3, 1e6]), 1e4
    scaled = Plant(
        T @ late.A @ np.linalg.inv(T), T @ late.B, y * late.C @ np.linalg.inv(T), y * late.D,
        1e5 * late.H @ np.linalg.inv(T), late.rho,
    )  # fmt: skip
    assert design(scaled).gamma == pytest.approx(1e5 * made[False, Kind.L2LINF].gamma, rel=1e-5)


def test_tampered_filter_is_not_confirmed(late, made):
    found = made[False, Kind.L2LINF]
    f = found.filter
    assert confirmed([late], Kind.L2LINF, f, found.gamma).outcome is Outcome.CONFIRMED
    for gamma, filter_ in (
        (found.gamma, Filter(f.Af, 1.2 * f.Bf, f.Cf, f.Df)),
        (0.99 * found.gamma, f),
        (found.gamma, Filter(2 * f.Af, f.Bf, f.Cf, f.Df)),
        (found.gamma, Filter(np.nan * f.Af, f.Bf, f.Cf, f.Df)),
    ):
        with pytest.raises(DesignError, match="NOT_CONFIRMED") as refused:
            confirmed([late], Kind.L2LINF, filter_, gamma)
        assert refused.value.outcome is Outcome.NOT_CONFIRMED
    for kind in (Kind.HINF, Kind.H2):
        made_so = made[False, kind]
        with pytest.raises(DesignError, match="NOT_CONFIRMED"):
            confirmed([late], kind, made_so.filter, 0.995 * made_so.gamma)


def test_a_solver_that_lies_is_found_out(late, monkeypatch):
    """What it calls optimal counts only as far as the analysis agrees."""

    def lying(problem):
        status = solve(problem)
        problem.objective.args[0].value = 0.9 * problem.value
        return status

    monkeypatch.setattr(design_module, "solve", lying)
    with pytest.raises(DesignError) as refused:
        design(late, use_cache=False)
    assert refused.value.outcome is Outcome.NOT_CONFIRMED


@pytest.mark.parametrize(
    ("changes", "outcome", "told"),
    [
        ({"A": [[1.0, 0.2], [0.0, 0.7]]}, Outcome.UNSTABLE, "spectral radius of A = 1, must be below 1"),
        ({"A": [[0.9, 0.0], [0.0, 1.0]]}, Outcome.UNDETECTABLE, "eigenvalue 1"),
        ({"A": [[0.9, 0.0], [0.0, -1.2]]}, Outcome.UNDETECTABLE, "eigenvalue -1.2"),
    ],
)
def test_plants_that_do_not_settle(changes, outcome, told):
    with pytest.raises(DesignError, match=told) as refused:
        design(Plant(**{"A": A, "B": B, "C": C, "D": D, "H": H, **changes}), use_cache=False)
    assert refused.value.outcome is outcome
    assert "\n" not in str(refused.value)


def test_polytope_with_an_unstable_inside_is_infeasible():
    """Both vertices settle, their mean does not: no filter keeps a gain."""
    corner = np.array([[0.5, 2.0], [0.0, 0.5]])
    vertices = [Plant(a, B, C, D, H) for a in (corner, corner.T)]
    assert mixture(vertices).spectral_radius > 1
    with pytest.raises(DesignError) as refused:
        design(vertices, Kind.THEOREM2, use_cache=False)
    assert refused.value.outcome is Outcome.INFEASIBLE


def test_ends_of_the_solver_are_named():
    x = cp.Variable()
    with pytest.raises(DesignError) as refused:
        solve(cp.Problem(cp.Minimize(x), [x <= 1]))
    assert refused.value.outcome is Outcome.UNBOUNDED
    with pytest.raises(DesignError) as refused:
        solve(cp.Problem(cp.Minimize(x), [x >= 1, x <= 0]))
    assert refused.value.outcome is Outcome.INFEASIBLE
    assert solve(cp.Problem(cp.Minimize(x), [x >= 1])) == "optimal"


@pytest.mark.parametrize("raised", [cp.SolverError("failed\nverbose"), None])
def test_solver_that_gives_up_is_inaccurate(monkeypatch, raised):
    """By an exception, or by a status of its own such as a limit of iterations."""

    def give_up(problem, **_):
        if raised:
            raise raised
        problem._status = "user_limit"

    monkeypatch.setattr(cp.Problem, "solve", give_up)
    with pytest.raises(DesignError, match="INACCURATE") as refused:
        solve(cp.Problem(cp.Minimize(cp.Variable())))
    assert refused.value.outcome is Outcome.INACCURATE
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "order", "told"),
    [
        (Kind.THEOREM2, 0, r"order = 0: allowed is \[1, 3\]"),
        (Kind.THEOREM2, 4, r"order = 4: allowed is \[1, 3\]"),
        (Kind.L2LINF, 2, "kind = l2linf: one vertex and full order"),
    ],
)
def test_orders_that_cannot_be(late, kind, order, told):
    with pytest.raises(ValueError, match=told):
        design(late, kind, order)


def test_designs_are_kept_by_content(late, made, monkeypatch, tmp_path):
    found = made[False, Kind.L2LINF]
    monkeypatch.setattr(design_module, "solve", lambda problem: pytest.fail("solved again"))
    again = design(late)
    assert again.gamma == found.gamma
    assert again.analyses == found.analyses
    assert again.outcome is Outcome.CONFIRMED
    for name, matrix in vars(found.filter).items():
        np.testing.assert_array_equal(getattr(again.filter, name), matrix)
    key = cache.design_key([late], "l2linf", 3)
    moved = Plant(late.A * (1 + 1e-15), B, C, D, H, late.rho)
    others = [
        cache.design_key([moved], "l2linf", 3),
        cache.design_key([late], "hinf", 3),
        cache.design_key([late], "theorem2", 2),
        cache.design_key([late, late], "l2linf", 3),
        cache.design_key([Plant(A, B, C, D, H, 0.7)], "l2linf", 3),
    ]
    assert len({key, *others}) == 6


@pytest.mark.parametrize("damage", ["cut", "changed"])
def test_damaged_entry_is_made_again(late, made, damage):
    path = cache.cache_folder() / f"{cache.design_key([late], 'h2', 3)}.json"
    sound = path.read_text()
    if damage == "cut":
        path.write_text(sound[:-5])
    else:
        entry = json.loads(sound)
        entry["content"]["gamma"] *= 0.9
        path.write_text(json.dumps(entry))
    with pytest.warns(cache.DesignCacheWarning, match="made again"):
        again = design(late, Kind.H2)
    assert again.gamma == pytest.approx(made[False, Kind.H2].gamma, rel=1e-9)
    assert cache.read(path.stem) is not None


def test_folder_that_cannot_be_written_is_a_warning(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FLEETALIGN_CACHE", str(tmp_path / "file"))
    with pytest.warns(cache.DesignCacheWarning, match="not cached"):
        cache.write("key", {})


def rolling(steps, dt=0.1):
    """Position, velocity and tilt in SI units, under a force that swings: numbers of very unlike size."""
    plants = []
    for k in range(steps):
        force = 9.81 + 3 * np.sin(0.3 * k)
        A = np.array([[1, dt, 0], [0, 1, force * dt], [0, 0, 1]])
        B, D = np.zeros((3, 4)), np.zeros((2, 4))
        B[1, 0], B[2, 1], D[0, 2], D[1, 3] = 1.6e-5, 1e-6, 10.0, 0.1
        plants.append(Plant(A, B, np.eye(2, 3), D, [[0.0, 0.0, 1.0]]))
    return plants, np.diag([1e2, 1.0, 0.0174]) ** 2


@pytest.mark.parametrize("steps", [4, 8, 16])
def test_inequality_over_a_horizon_is_the_riccati_recursion(steps):
    plants, P0 = rolling(steps)
    found = finite_horizon.design_over(plants, P0)
    least, _ = finite_horizon.kalman_gains(plants, P0)
    np.testing.assert_allclose(found.gains, least, rtol=1e-5)
    np.testing.assert_allclose(finite_horizon.reached_gains(plants, found.filters, P0), least, rtol=1e-6)


def test_inequality_over_a_horizon_in_si_units_fails_by_name():
    plants, P0 = rolling(16)
    with pytest.raises(DesignError) as refused:
        finite_horizon.design_over(plants, P0, whitened=False)
    assert refused.value.outcome is Outcome.INACCURATE


def test_horizon_is_for_prompt_outputs(late):
    with pytest.raises(ValueError, match="rho"):
        finite_horizon.design_over([late, late], np.eye(2))
