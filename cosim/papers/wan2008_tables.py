"""Tables of Wan et al.'s experiment: errors by beacon share and ranging error, elements, five nodes."""

import numpy as np

from ...align.consistency import mean_band
from ...network.localization.central_ekf import fig_2_derivatives
from ...network.localization.fading_ekf import FadingEkf, initial, step
from ..run import generator
from . import statistics
from .results import Array, Form, Metric, Row, Table, Value
from .wan2008_runs import (
    ASTRAY,
    BOUND,
    COVERED,
    ERROR,
    HELD_RADII,
    NEES,
    SQUARES,
    Cell,
    elements_cell,
    sweep_cell,
)
from .wan2008_settings import Refinement

METHODS = {
    "dv": (
        "DV-distance",
        Form.PUBLISHED,
        "path sums, maximum likelihood; network/localization/dv_distance.py",
    ),
    "dv_all": ("DV-distance, all beacons", Form.PUBLISHED, "path sums, the linear equations"),
    "dv_corrected": ("DV-distance, corrected", Form.BASELINE, "paths scaled by those between beacons"),
    "distributed_printed": (
        "distributed EKF",
        Form.PUBLISHED,
        "(8) to (20), printed stop rule; network/localization/fading_ekf.py",
    ),
    "distributed": (
        "distributed EKF",
        Form.MENDED,
        "lambda <= 2, R + tr(P_j) / 2, Q and R as at the start; distributed_ekf.py",
    ),
    "distributed_sage": ("distributed EKF, Sage", Form.MENDED, "the same with Q and R by residuals"),
    "distributed_long": (
        "distributed EKF, to the end",
        Form.MENDED,
        "until its stop rule, or ten times the steps",
    ),
    "central": ("central EKF", Form.MENDED, "lambda <= 2, no Q, sparse information; central_ekf.py"),
    "central_long": ("central EKF, to the end", Form.MENDED, "until its stop rule, or ten times the steps"),
    "ours": ("cold start, least squares", Form.OURS, "all nodes; network/localization/plane_chain.py"),
    "ours_certain": ("the same, nodes that are certain", Form.OURS, "with the chain's verdict"),
}
_ELEMENT_ROWS = {
    "distributed_printed": ("distributed, all as printed", Form.PUBLISHED),
    "printed_step": ("as printed, but the stop rule", Form.PUBLISHED),
    "sage_husa": ("mended, but Sage-Husa as printed", Form.PUBLISHED),
    "cap_none": ("mended, but no limit of lambda", Form.PUBLISHED),
    "cap_1e4": ("mended, but lambda <= 1e4", Form.PUBLISHED),
    "known": ("mended, but neighbours taken for beacons", Form.PUBLISHED),
    "known_cap_1e4": ("the same, and lambda <= 1e4", Form.PUBLISHED),
    "known_cap_none": ("the same, and no limit of lambda", Form.PUBLISHED),
    "norms": ("mended, but the printed stop rule", Form.PUBLISHED),
    "distributed": ("distributed, mended", Form.MENDED),
    "distributed_sage": ("mended, Sage's Q and R kept positive", Form.MENDED),
    "cap_1": ("mended, without fading", Form.MENDED),
    "distributed_long": ("mended, to the end", Form.MENDED),
    "central_printed": ("central, all as printed", Form.PUBLISHED),
    "central_sage": ("central, mended, Sage's R kept positive", Form.MENDED),
    "central": ("central, mended", Form.MENDED),
    "central_long": ("central, mended, to the end", Form.MENDED),
}

Found = dict[str, Array]
"""(draws, 6) of each method."""


def _percent(values: Array) -> Value:
    return statistics.mean(100 * values)


def connectivity_table(settings: Refinement, degree: float, found: dict[Cell, Found]) -> Table:
    """Of one connectivity, exact ranges."""
    shares, low = settings.beacon_shares, settings.low_share
    metrics = [
        Metric(
            f"error_{share:g}_percent",
            f"{100 * share:g} %",
            1,
            f"mean error, % of the radius, {100 * share:g} % beacons",
        )
        for share in shares
    ]
    metrics += [
        Metric("lost_percent", f"lost, {100 * low:g} %", 1, "nodes off by more than ten radii", False),
        Metric("coverage_percent", f"told, {100 * low:g} %", 1, "nodes that have an estimate", False),
    ]
    rows: list[Row] = []
    for key, (name, form, about) in METHODS.items():
        values: dict[str, Value] = {}
        for share in shares:
            at = found[Cell(degree, share)].get(key)
            if at is not None:
                values[f"error_{share:g}_percent"] = _percent(at[:, ERROR])
                if share == low:
                    values["lost_percent"] = _percent(at[:, ASTRAY])
                    values["coverage_percent"] = _percent(at[:, COVERED])
        if values:
            rows.append(Row(name, form, values, about))
    title = f"Mean error by beacon share, connectivity {degree:g}, exact ranges, % of the radius"
    return Table(f"connectivity_{degree:g}", title, tuple(metrics), tuple(rows))


def elements_table(settings: Refinement, found: dict[Cell, Found]) -> Table:
    """The filter with one element at a time as printed or as mended."""
    cell = elements_cell(settings)
    here = found[cell]
    metrics = (
        Metric("error_percent", "error, %", 1, "mean error, % of the radius"),
        Metric("gain_points", "gain, points", 1, "less than that of DV-distance, on the same draws"),
        Metric("lost_percent", "lost, %", 1, "nodes off by more than ten radii"),
    )
    rows = [
        Row(
            name,
            form,
            {
                "error_percent": _percent(here[key][:, ERROR]),
                "gain_points": _percent(here["dv"][:, ERROR] - here[key][:, ERROR]),
                "lost_percent": _percent(here[key][:, ASTRAY]),
            },
        )
        for key, (name, form) in _ELEMENT_ROWS.items()
    ]
    title = f"What each element does: connectivity {cell.connectivity:g}, {100 * cell.share:g} % beacons"
    return Table("elements", title, metrics, tuple(rows))


def _bound_values(at: Array) -> dict[str, Value]:
    values = {"over_bound": statistics.rms_ratio(at[:, SQUARES], at[:, BOUND])}
    if np.isfinite(at[:, NEES]).any():
        values["nees"] = statistics.mean(at[:, NEES])
    return values


def _bound_metrics(draws: int) -> tuple[Metric, ...]:
    low, high = mean_band(2, draws)
    return (
        Metric(
            "over_bound", "/ bound", 2, f"RMS over bound, nodes whose bound is below {HELD_RADII:g} radii"
        ),
        Metric("nees", f"NEES ({low:.2f} to {high:.2f})", 2, "of those nodes, two degrees of freedom"),
    )


def sweep_table(settings: Refinement, found: dict[Cell, Found], draws: int) -> Table:
    """Fig. 5, with ratios to the bound."""
    errors, judged = settings.range_error_shares, settings.judged_error_share
    metrics = tuple(
        Metric(
            f"error_{e:g}_percent",
            f"{100 * e:g} %",
            1,
            f"mean error, % of the radius, ranges to {100 * e:g} % of it",
        )
        for e in errors
    )
    metrics += (
        Metric("coverage_percent", "told, %", 1, "nodes that have an estimate", False),
        *_bound_metrics(draws),
    )
    rows: list[Row] = []
    for key, (name, form, about) in METHODS.items():
        values: dict[str, Value] = {}
        for e in errors:
            at = found[sweep_cell(settings, e)].get(key)
            if at is not None:
                values[f"error_{e:g}_percent"] = _percent(at[:, ERROR])
                if e == judged:
                    values |= _bound_values(at) | {"coverage_percent": _percent(at[:, COVERED])}
        if values:
            rows.append(Row(name, form, values, about))
    cell = sweep_cell(settings, judged)
    title = (
        f"Mean error by ranging error, connectivity {cell.connectivity:g}, {100 * cell.share:g} % beacons,"
        f" radius {settings.sweep_radius_m:g} m, % of the radius"
    )
    return Table("ranging_error", title, metrics, tuple(rows))


def bound_table(settings: Refinement, found: Found, draws: int) -> Table:
    """The rigid network."""
    metrics = (
        Metric("error_percent", "error, %", 2, "mean error, % of the radius"),
        Metric("coverage_percent", "told, %", 1, "nodes that have an estimate", False),
        *_bound_metrics(draws),
    )
    rows = [
        Row(
            name,
            form,
            {
                "error_percent": _percent(found[key][:, ERROR]),
                "coverage_percent": _percent(found[key][:, COVERED]),
            }
            | _bound_values(found[key]),
            about,
        )
        for key, (name, form, about) in METHODS.items()
        if key in found
    ]
    title = (
        f"Rigid: connectivity {settings.rigid_connectivity:g}, {100 * settings.rigid_share:g} % beacons,"
        f" ranging error {100 * settings.judged_error_share:g} % of the radius"
    )
    return Table("rigid", title, metrics, tuple(rows))


def five_nodes(settings: Refinement, draws: int, seed: int) -> Table:
    """The paper's Fig. 2 with H as printed and as mended: nodes 3 and 4 from starts that are off."""
    nodes = np.array([[1.0, 9.0], [1.0, 1.0], [4.0, 5.0], [8.0, 8.0], [9.0, 1.0]])
    z, _ = fig_2_derivatives(nodes)
    ekf = FadingEkf(
        noise="fixed", max_fading=settings.max_fading, initial_sd_m=1.0, range_sd_m=0.01, process_sd_m=0.01
    )
    heard = np.ones(5, np.bool_)
    rows: list[Row] = []

    def refined(form: str, draw: int) -> float:
        x = nodes.copy()
        x[2:4] += generator(seed, draw, "five nodes").normal(0, 1.0, (2, 2))
        f = initial(x[2:4].ravel(), 5, ekf)
        for _ in range(settings.max_steps):
            d, H = fig_2_derivatives(x, "printed" if form == "printed" else "mended")
            f = step(f, z - d, H, ekf, heard)
            x[2:4] = f.x.reshape(2, 2)
        return float(np.linalg.norm(x - nodes, axis=1)[2:4].mean())

    for form, kind in (("printed", Form.PUBLISHED), ("mended", Form.MENDED)):
        errors = np.array([refined(form, draw) for draw in range(draws)])
        values = {
            "median_m": Value(float(np.median(errors))),
            "found_percent": _percent((errors < 0.1).astype(float)),
        }
        rows.append(Row(f"rows 4 and 5 of H {form}", kind, values, "network/localization/central_ekf.py"))
    metrics = (
        Metric("median_m", "median error, m", 3, "mean error of nodes 3 and 4, median over draws"),
        Metric("found_percent", "found, %", 0, "draws in which it is below 0.1 m"),
    )
    return Table(
        "figure_2", "The five nodes of Fig. 2, exact ranges, starts off by 1 m each way", metrics, tuple(rows)
    )
