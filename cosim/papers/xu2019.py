"""Xu, Wang, Chen: nodes on the ground, located by the beacons of a UAV that flies over them."""

from functools import partial

import numpy as np

from ...align.consistency import mean_band
from ..parallel import in_order
from ..run import generator
from . import statistics
from .results import Form, Metric, Progress, Results, Row, Table
from .xu2019_claims import claims
from .xu2019_figures import figures
from .xu2019_precision import arithmetic
from .xu2019_runs import Outcome, Random, field_sample, methods, pooled, shown
from .xu2019_settings import MovingAnchor
from .xu2019_studies import heights, path_loss

__all__ = ["MovingAnchor", "study"]

BLOCK = 100
"""Draws that are worked on at once."""
_CUBATURE = "network/localization/cubature.py"
_BEACONS = "network/localization/beacons.py"
METHODS = {
    "linear": ("linear", Form.PUBLISHED, f"(2) to (4), called maximum likelihood; {_BEACONS}"),
    "slant": ("least squares of (2)", Form.PUBLISHED, "slant ranges for horizontal ones, as (2) prints"),
    "ckf_wide": ("CKF", Form.PUBLISHED, f"from the linear solution of the same ranges; {_CUBATURE}"),
    "srckf_wide": ("SR-CKF", Form.PUBLISHED, "(5) to (8) without the threshold"),
    "srckf_printed": ("SR-CKF with threshold", Form.PUBLISHED, "D_j < alpha set to zero in (6)"),
    "srckf_noise": ("SR-CKF, Q = R", Form.PUBLISHED, "process noise of covariance R, as (5) prints"),
    "linear_weighted": ("linear, weighted", Form.MENDED, "each square by its variance, about their mean"),
    "ckf": ("CKF, start of its own", Form.MENDED, "no range used twice"),
    "srckf": ("SR-CKF, start of its own", Form.MENDED, "no range used twice"),
    "srckf_size": ("SR-CKF, threshold on |D_j|", Form.MENDED, "|D_j| < alpha set to zero"),
    "srckf_information": ("SR-CKF, threshold on information", Form.MENDED, "ranges that add little left out"),
    "least_squares": ("least squares", Form.BASELINE, "slant ranges, weights by their measured lengths"),
    "ekf": ("EKF, start of its own", Form.BASELINE, "no range used twice"),
    "quasi": ("least squares, weights at the estimate", Form.OURS, f"quasi-likelihood; {_BEACONS}"),
    "exact": ("mean of where the rings meet", Form.OURS, "uniform law; network/localization/bounded.py"),
    "bound": ("Cramér-Rao bound", Form.BOUND, "Gaussian errors of this variance, known at the true distance"),
}

NOTES = (
    "The bound is that of Gaussian errors of the uniform law's variance at the true distance: no estimate"
    " that knows mean and variance alone does better in large samples. What a variance that depends on the"
    " distance tells besides is left out; at 15 % it would be 0.7 % of the bound.",
    "Uniform errors have edges, and for them no Cramér-Rao bound exists: the mean of where the rings meet is"
    " the least there is, and goes below the other.",
    "The path over the field, radii, heights of nodes, alpha, and the filters' start are ours.",
    "The axes of Fig. 4 are not in the text: error by node is ours.",
)


def study(settings: MovingAnchor, draws: int, seed: int, progress: Progress | None = None) -> Results:
    """All methods at each radius, what heights, path loss and single precision make of them, the paper's
    claims, and its figures."""
    blocks = [range(i, min(i + BLOCK, draws)) for i in range(0, draws, BLOCK)]
    work = [(radius, block) for radius in settings.radii_m for block in blocks]
    random, total, done = partial(generator, seed), len(work) + 3, 0
    parts: dict[float, list[dict[str, Outcome]]] = {radius: [] for radius in settings.radii_m}

    def count() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    for (radius, _), part in zip(work, in_order(partial(_block, settings, random), work), strict=True):
        parts[radius].append(part)
        count()
    found = {radius: pooled(settings, part) for radius, part in parts.items()}
    aside: list[Table] = []
    for side in (heights, path_loss, arithmetic):
        aside.append(side(settings, draws, random))
        count()
    tables = [_table(settings, radius, draws, found[radius]) for radius in settings.radii_m]
    runs = {radius: shown(settings, radius, seed) for radius in settings.radii_m}
    return Results(
        tables=(*tables, *aside),
        claims=claims(settings, found, runs, tuple(aside)),
        figures=figures(settings, runs),
        notes=NOTES,
    )


def _block(settings: MovingAnchor, random: Random, item: tuple[float, range]) -> dict[str, Outcome]:
    radius, draws = item
    s = field_sample(settings, radius, draws, random)
    bound = np.sqrt(np.diagonal(s.bound, axis1=1, axis2=2))
    return methods(settings, s) | {"bound": Outcome(bound)}


def _table(settings: MovingAnchor, radius: float, draws: int, found: dict[str, Outcome]) -> Table:
    low, high = mean_band(2, draws * settings.nodes)
    metrics = (
        Metric("rmse_m", "RMSE, m", 3, "root of the mean squared horizontal error"),
        Metric("mpe_m", "MPE, m", 3, "mean horizontal error, (9)", brief=False),
        Metric("over_bound", "RMSE / bound", 3, "on the same draws"),
        Metric("nees", f"NEES ({low:.2f} to {high:.2f})", 2, "two degrees of freedom, and its 95 % band"),
        Metric("used_percent", "ranges used, %", 0, "of those heard, by a filter", brief=False),
    )
    bound, rows = found["bound"].squares.mean(axis=1), []
    for key, (name, form, about) in METHODS.items():
        outcome = found[key]
        squares = outcome.squares.mean(axis=1)
        values = {"rmse_m": statistics.rms(squares)}
        if form is not Form.BOUND:
            values["mpe_m"] = statistics.mean(np.sqrt(outcome.squares).mean(axis=1))
            values["over_bound"] = statistics.rms_ratio(squares, bound)
        if outcome.nees is not None and np.isfinite(outcome.nees).all():
            values["nees"] = statistics.mean(outcome.nees.mean(axis=1))
        if outcome.used is not None:
            values["used_percent"] = statistics.mean(100 * outcome.used.mean(axis=1))
        rows.append(Row(name, form, values, about))
    title = f"{settings.nodes} nodes in {settings.width_m:g} m x {settings.depth_m:g} m, radius {radius:g} m"
    return Table(f"radius_{radius:g}_m", title, metrics, tuple(rows))
