"""CKF and SR-CKF in single and in double precision, from starts that the filters can carry.

A wide start under sharp ranges breaks both forms in any precision, because spheres curve over it. Starts here
are flat: either least squares of some of the ranges, or a line, along which a node is hardly known, across
which it is, and along which the first ranges come.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...align.consistency import nees
from ...network.localization.beacons import Heard, linear_weighted, quasi_likelihood
from ...network.localization.cubature import Filter, State
from ...network.localization.plane import distances, range_bound
from ...network.localization.ranging import RangeNoise, UniformErrors
from . import statistics
from .results import Array, Form, Metric, Row, Table, Value
from .xu2019_runs import Random, field_sample, last_state, shared_out
from .xu2019_settings import MovingAnchor

PRECISE = (1e-3, 1e-4, 1e-5)
"""Shares of the distance that errors are within, besides the stated one."""
ALONG_M, ACROSS_M, LINE_RANGE_SD_M = 10.0, 0.05, 1e-3
"""Standard deviations of the start along a line and across it, and of a range: squared, 8 decades from the
widest to the sharpest, of which single precision holds 7; the curvature of a range over 5 cm is 0.02 mm."""
ON_LINE, AROUND = 8, 12
"""Beacons in the direction of the line, and after them on all sides."""
APART = 0.5
"""Standard deviations from the CKF in double precision, from which on a node is off."""
_SOME_DRAWS = 40


@dataclass(frozen=True)
class Case:
    """A start, and the ranges that follow it."""

    told: str
    x: Array
    """(k, 2) m, true places."""
    start: Array
    """(k, 2) m"""
    cov: Array
    """(k, 2, 2) m^2, of the start."""
    seen: Heard
    noise: RangeNoise
    bound: Array
    """(k, 2, 2) m^2"""


def arithmetic(settings: MovingAnchor, draws: int, random: Random) -> Table:
    """Both forms in both precisions: on the field as ranges become more precise, and on the line."""
    rows: list[Row] = []
    for case in _cases(settings, range(min(draws, _SOME_DRAWS)), random):
        reference = _last(Filter.CUBATURE, case, np.float64)
        for kind, form in ((Filter.CUBATURE, Form.BASELINE), (Filter.SQUARE_ROOT, Form.PUBLISHED)):
            values = _compared(settings, case, kind, reference)
            name = "CKF" if kind is Filter.CUBATURE else "SR-CKF"
            rows.append(Row(f"{name}, {case.told}", form, values))
    about = "over the bound; nodes that are lost count with their last state"
    metrics = (
        Metric("off_single_percent", "off, %", 1, f"lost, or {APART:g} sd or more from the CKF in double"),
        Metric("over_bound_single", "RMSE / bound", 3, f"in single precision, {about}"),
        Metric("nees_single", "NEES", 2, "in single precision, two degrees of freedom, nodes not lost"),
        Metric("nees_double", "double", 2, "NEES in double precision"),
        Metric(
            "condition_log10", "log10 cond.", 1, "widest variance of the start over the sharpest at the end"
        ),
        Metric("lost_single_percent", "lost, %", 1, "covariance not positive definite", brief=False),
        Metric("lost_double_percent", "lost, double, %", 1, "the same in double precision", brief=False),
        Metric("over_bound_double", "RMSE / bound, double", 3, f"in double precision, {about}", brief=False),
    )
    title = "Single precision (and NEES in double), from starts that are flat"
    return Table("single_precision", title, metrics, tuple(rows))


def _cases(settings: MovingAnchor, draws: range, random: Random) -> Iterator[Case]:
    for share in (settings.range_error_share, *PRECISE):
        s = field_sample(settings, settings.radii_m[0], draws, random, UniformErrors(share=share))
        first, rest = shared_out(s.seen)
        start = quasi_likelihood(first, s.noise, linear_weighted(first, s.noise))
        yield Case(f"errors within {100 * share:g} %", s.x, start.x, start.cov, rest, s.noise, s.bound)
    yield line([random(draw, "line") for draw in draws], settings.nodes)


def line(rngs: list[np.random.Generator], nodes: int) -> Case:
    """Nodes with a start along a line of any direction, beacons at 60 to 100 m and at their own height."""
    beacons = ON_LINE + AROUND
    normal = np.concatenate([rng.standard_normal((nodes, 2 + beacons)) for rng in rngs])
    unit = np.concatenate([rng.random((nodes, 3 + 2 * beacons)) for rng in rngs])
    x, turn = 100.0 * unit[:, :2], 2 * np.pi * unit[:, 2]
    axes = np.stack([_way(turn), _way(turn + np.pi / 2)], axis=-1)
    sd = np.array([ALONG_M, ACROSS_M])
    start = x + (axes @ (sd * normal[:, :2])[..., None])[..., 0]
    bearing = 2 * np.pi * unit[:, 3 : 3 + beacons] * (np.arange(beacons) >= ON_LINE)
    anchors = start[:, None] + (60 + 40 * unit[:, 3 + beacons :, None]) * _way(turn[:, None] + bearing)
    d, _ = distances(x, anchors)
    seen = Heard(anchors, d + LINE_RANGE_SD_M * normal[:, 2:], np.ones(d.shape, bool))
    told = axes @ np.diag(sd**-2) @ axes.transpose(0, 2, 1)
    ranged = np.linalg.inv(range_bound(x, anchors, np.full(d.shape, LINE_RANGE_SD_M)))
    cov = axes @ np.diag(sd**2) @ axes.transpose(0, 2, 1)
    bound = np.linalg.inv(told + ranged).astype(np.float64)
    return Case("along a line", x, start, cov, seen, RangeNoise(sd_m=LINE_RANGE_SD_M), bound)


def _way(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _last(kind: Filter, case: Case, dtype: type) -> State:
    return last_state(kind, case.start.astype(dtype), case.cov.astype(dtype), case.seen, case.noise)


def sds_apart(state: State, reference: State) -> Array:
    """(k,) of a state from another, in standard deviations of the other; infinite where it is lost."""
    return np.where(state.lost, np.inf, np.sqrt(nees(state.x.astype(float) - reference.x, reference.P)))


def _compared(settings: MovingAnchor, case: Case, kind: Filter, reference: State) -> dict[str, Value]:
    def of_draws(values: Array) -> Array:
        return values.reshape(-1, settings.nodes).mean(axis=1)

    values: dict[str, Value] = {}
    variance = of_draws(np.trace(case.bound, axis1=1, axis2=2))
    for name, dtype in (("single", np.float32), ("double", np.float64)):
        state = _last(kind, case, dtype)
        error, P = state.x.astype(float) - case.x, state.P.astype(float)
        consistency = np.where(state.lost, np.nan, nees(error, P)).reshape(-1, settings.nodes)
        kept = np.isfinite(consistency)
        total = np.where(kept, consistency, 0.0).sum(axis=1)
        count = kept.sum(axis=1)
        squares = of_draws(np.sum(error**2, axis=1))
        values[f"lost_{name}_percent"] = statistics.mean(100 * of_draws(state.lost.astype(float)))
        values[f"over_bound_{name}"] = statistics.rms_ratio(squares, variance)
        values[f"nees_{name}"] = statistics.mean(np.where(count > 0, total / np.maximum(count, 1), np.nan))
        if dtype is np.float32:
            off = sds_apart(state, reference) >= APART
            values["off_single_percent"] = statistics.mean(100 * of_draws(off.astype(float)))
    widest = np.linalg.eigvalsh(case.cov)[:, -1] / np.linalg.eigvalsh(reference.P)[:, 0]
    values["condition_log10"] = statistics.mean(of_draws(np.log10(widest)))
    return values
