"""Uryvsky, Yakornov, Tsukanov: elements of a plane network, located again and again by two ranges each."""

from functools import partial

import numpy as np

from ...align.consistency import mean_band, nees
from ...network.localization.bound import cramer_rao
from ...network.localization.least_squares import refine
from ...network.localization.plane import distances, in_plane
from ...network.localization.problem import RangeProblem
from ...network.observations import node_pairs
from ..parallel import in_order
from ..run import generator
from . import statistics
from .results import Array, Form, Metric, Progress, Results, Row, Table
from .uryvsky2018_claims import claims, percent
from .uryvsky2018_figures import figure_2
from .uryvsky2018_runs import Condition, Outcome, conditions, outcomes
from .uryvsky2018_settings import FOUR, RepeatedRanging

__all__ = ["RepeatedRanging", "study"]

_MODULE = "network/localization/repeated_ranging.py"
METHODS = {
    "fix_printed": ("one fix, (3)", Form.PUBLISHED, "(1) to (3), network/localization/rangefinder.py"),
    "fix": ("one fix, the last", Form.BASELINE, "(1), (2) and (3) as mended"),
    "mean": ("mean of fixes", Form.BASELINE, "unweighted"),
    "kalman_printed": ("Kalman", Form.PUBLISHED, f"(5) to (7), {_MODULE}"),
    "kalman": ("Kalman", Form.MENDED, f"(5) to (7), {_MODULE}"),
    "regularized_printed": ("regularised", Form.PUBLISHED, "(9) to (11) with (7)"),
    "regularized_gain": ("regularised, (7) alone", Form.MENDED, "gain as printed, alpha at most 1"),
    "regularized": ("regularised", Form.MENDED, "alpha at least 1"),
    "adaptive_printed": ("adaptive", Form.PUBLISHED, "(12) to (14) with (7)"),
    "adaptive_gain": ("adaptive, (7) alone", Form.MENDED, "gain as printed"),
    "adaptive": ("adaptive", Form.MENDED, "eigenvalue by eigenvalue"),
    "regularized_adaptive_printed": ("regularised-adaptive", Form.PUBLISHED, "(9) to (14) with (7)"),
    "regularized_adaptive_gain": ("regularised-adaptive, (7) alone", Form.MENDED, "gain as printed"),
    "regularized_adaptive": ("regularised-adaptive", Form.MENDED, "eigenvalues, from the limit on"),
    "batch": (
        "least squares of all ranges",
        Form.OURS,
        "weighted, scaled by residuals; network/localization/batch_ranging.py",
    ),
    "huber": ("the same with Huber's loss", Form.OURS, "network/localization/batch_ranging.py"),
    "bound": ("Cramér-Rao bound", Form.BOUND, "of the two ranges of each cycle"),
}


def study(settings: RepeatedRanging, draws: int, seed: int, progress: Progress | None = None) -> Results:
    """All conditions on the same draws, the network with all its links, the claims, and Fig. 2."""
    cases = conditions(settings, draws, seed)
    found: dict[str, dict[str, Outcome]] = {}
    work = partial(outcomes, settings)
    for done, (case, outcome) in enumerate(zip(cases, in_order(work, cases), strict=True), start=1):
        found[case.key] = outcome
        if progress:
            progress(done, len(cases) + 1)
    tables = tuple(_table(settings, case, found[case.key]) for case in cases)
    network = _network(settings, draws, seed, found["nominal"], cases[0])
    if progress:
        progress(len(cases) + 1, len(cases) + 1)
    return Results(
        tables=(*tables, network),
        claims=claims(settings, found),
        figures=(figure_2(settings, found),),
        notes=(
            "Two ranges fit two places, mirrored in the line through elements 1 and 2: all elements are"
            " taken to lie at y > 0, and a scenario with one too near that line is refused.",
            "p of (10) and (11) is not in the paper: it is discrepancy_limit times what noise alone makes of"
            " the squared discrepancy, the trace of K + Q; as printed, alpha is the largest in [0, 1] for"
            " which alpha times the discrepancy is within p.",
            "In rows of (7) alone the sign of (7) and its covariance are mended, and gains are as printed.",
            "Noise and positions of the elements are ours: the paper gives none.",
            "With outliers the bound is that of the mixture, whose Fisher information is had by quadrature.",
        ),
    )


def _metrics(settings: RepeatedRanging, band: tuple[float, float], samples: int) -> tuple[Metric, ...]:
    N = settings.cycles
    low, high = band
    return (
        Metric("rmse_1_m", "1 cycle, m", 3, "RMS distance from the truth after one cycle", brief=False),
        Metric("rmse_4_m", "4, m", 3, "the same after four"),
        Metric("rmse_n_m", f"{N}, m", 3, f"the same after {N}"),
        Metric("over_bound", f"{N}/bound", 2, f"the same over the bound after {N}, same draws"),
        Metric("change_fix_percent", "to fix, %", 1, "RMS after four cycles against that of one fix"),
        Metric(
            "change_kalman_percent",
            "4 to Kalman, %",
            1,
            "the same against the mended Kalman filter",
            brief=False,
        ),
        Metric(
            "nees",
            "NEES",
            2,
            f"after {N} cycles, two degrees of freedom; 95 % band of {samples}: {low:.2f} to {high:.2f}",
        ),
        Metric(
            "invalid_percent",
            "no covariance, %",
            0,
            "matrices that are none: unsymmetric, or not positive",
            brief=False,
        ),
    )


def _table(settings: RepeatedRanging, case: Condition, found: dict[str, Outcome]) -> Table:
    bound, reference, kalman = found["bound"].squares, found["fix"].one, found["kalman"].squares
    rows: list[Row] = []
    for key, (name, form, about) in METHODS.items():
        squares = found[key].squares
        values = {
            "rmse_1_m": statistics.rms(squares[:, 0]),
            "rmse_4_m": statistics.rms(squares[:, FOUR - 1]),
            "rmse_n_m": statistics.rms(squares[:, -1]),
        }
        if form is not Form.BOUND:
            at_four = squares[:, FOUR - 1]
            values |= {
                "over_bound": statistics.rms_ratio(squares[:, -1], bound[:, -1]),
                "change_fix_percent": percent(statistics.rms_ratio(at_four, reference)),
                "change_kalman_percent": percent(statistics.rms_ratio(at_four, kalman[:, FOUR - 1])),
                "invalid_percent": statistics.mean(100 * found[key].invalid),
            }
            # A matrix that is no covariance has no consistency to speak of.
            if not found[key].invalid.any():
                values["nees"] = statistics.mean(found[key].nees)
        rows.append(Row(name, form, values, about))
    samples = len(bound) * (len(settings.elements_m) - 2)
    band = mean_band(2, samples)
    return Table(case.key, _titled(case.title, band), _metrics(settings, band, samples), tuple(rows))


def _titled(title: str, band: tuple[float, float]) -> str:
    return f"{title}; band of NEES {band[0]:.2f} to {band[1]:.2f}"


def _network(
    settings: RepeatedRanging, draws: int, seed: int, found: dict[str, Outcome], nominal: Condition
) -> Table:
    """What the elements' ranges among themselves add, equal noise, all of them located together."""
    x = np.array(settings.elements_m)
    flat = np.column_stack([x, np.zeros(len(x))])
    anchor = np.arange(len(x)) < 2
    pairs = node_pairs(len(x))
    pairs = pairs[~anchor[pairs].all(axis=1)]
    known = anchor[pairs[:, 1]]
    truth, _ = distances(x, x)
    at, N = (1, FOUR, settings.cycles), settings.cycles

    def problem(ranges: Array, n: int) -> RangeProblem:
        sd = np.full(len(pairs), settings.range_sd_m / np.sqrt(n))
        return in_plane(pairs, ranges, sd, anchor, x)

    def located(draw: int) -> tuple[Array, float]:
        rng = generator(seed, draw, "links")
        shape = (N, len(pairs))
        ranges = truth[pairs[:, 0], pairs[:, 1]] + settings.range_sd_m * rng.standard_normal(shape)
        # Those to the references are the same that the other methods have.
        ranges[:, known] = nominal.ranges[draw][:, pairs[known, 0] - 2, pairs[known, 1]]
        # Of ranges that are equally good the mean tells as much as all of them.
        solved = [refine(problem(ranges[:n].mean(axis=0), n), flat) for n in at]
        squares = np.array([np.sum((s.x - flat)[2:] ** 2, axis=-1).mean() for s in solved])
        shown = settings.shown_element - 1
        error = (solved[-1].x - flat)[shown, :2]
        return squares, float(nees(error, solved[-1].cov[shown, :2, :2]))

    exact = problem(truth[pairs[:, 0], pairs[:, 1]], 1)
    variance = np.trace(cramer_rao(exact, flat).cov[2:, :2, :2], axis1=1, axis2=2).mean()
    results = list(in_order(located, range(draws)))
    squares, consistency = np.array([r[0] for r in results]), np.array([r[1] for r in results])
    bound = np.tile(variance / np.array(at), (draws, 1))
    two = {key: found[key].squares[:, [n - 1 for n in at]] for key in ("kalman", "batch", "bound")}
    rows = [
        ("Kalman, two ranges each", Form.MENDED, two["kalman"], None),
        ("least squares, two ranges each", Form.OURS, two["batch"], None),
        ("least squares, all links", Form.OURS, squares, consistency),
        ("bound, two ranges each", Form.BOUND, two["bound"], None),
        ("bound, all links", Form.BOUND, bound, None),
    ]
    band = mean_band(2, draws)
    metrics = _metrics(settings, band, draws)
    wanted = ("rmse_1_m", "rmse_4_m", "rmse_n_m")
    table_rows: list[Row] = []
    for name, form, values, told in rows:
        cells = {key: statistics.rms(values[:, i]) for i, key in enumerate(wanted)}
        if form is not Form.BOUND:
            cells["over_bound"] = statistics.rms_ratio(values[:, -1], bound[:, -1])
        if told is not None:
            cells["nees"] = statistics.mean(told)
        table_rows.append(Row(name, form, cells))
    title = _titled(f"All {len(pairs)} links of the network, equal noise, known", band)
    columns = tuple(m for m in metrics if m.key in (*wanted, "over_bound", "nees"))
    return Table("network", title, columns, tuple(table_rows))
