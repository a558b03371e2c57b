"""What heights and path loss make of the moving anchor's methods."""

from dataclasses import replace

import numpy as np

from ...network.localization.beacons import linear, linear_weighted, log_likelihood, quasi_likelihood
from ...network.localization.plane import distances, range_bound
from ...network.localization.ranging import RangeNoise
from . import statistics
from .results import Array, Form, Metric, Row, Table
from .xu2019_runs import Random, field_sample
from .xu2019_settings import MovingAnchor


def heights(settings: MovingAnchor, draws: int, random: Random) -> Table:
    """Heights that are known, taken from the shortest range as section 1.2 has it, or estimated."""
    radius = settings.radii_m[0]
    s = field_sample(settings, radius, range(draws), random)
    shortest = np.where(s.seen.heard, s.seen.ranges, np.inf).min(axis=1)
    overhead = replace(s.seen, rise=np.broadcast_to(shortest[:, None], s.seen.ranges.shape))
    up = np.full((*s.seen.ranges.shape, 1), settings.altitude_m)
    space = replace(s.seen, anchors=np.concatenate([s.seen.anchors, up], axis=-1), rise=0.0)
    start = linear(s.seen)
    truth = np.column_stack([s.x, s.height])
    sd = s.seen.sd(s.noise, distances(truth, space.anchors)[0])
    bound = range_bound(truth, space.anchors, sd)
    known, printed = (quasi_likelihood(seen, s.noise, start).x for seen in (s.seen, overhead))
    solved = quasi_likelihood(space, s.noise, np.column_stack([start, np.zeros(len(start))])).x
    # Beacons of one height leave a mirror image above them, and no node is there.
    solved[:, 2] = settings.altitude_m - np.abs(settings.altitude_m - solved[:, 2])
    flat = _mean(settings, np.trace(s.bound, axis1=1, axis2=2))

    def row(name: str, form: Form, about: str, x: Array, height: Array | None) -> Row:
        squares = _mean(settings, np.sum((x - s.x) ** 2, axis=1))
        values = {"rmse_m": statistics.rms(squares), "over_known": statistics.rms_ratio(squares, flat)}
        if height is not None:
            values["height_rmse_m"] = statistics.rms(_mean(settings, (height - s.height) ** 2))
        return Row(name, form, values, about)

    variance = np.diagonal(bound, axis1=1, axis2=2)
    in_space = {
        "rmse_m": statistics.rms(_mean(settings, variance[:, :2].sum(axis=1))),
        "over_known": statistics.rms_ratio(_mean(settings, variance[:, :2].sum(axis=1)), flat),
        "height_rmse_m": statistics.rms(_mean(settings, variance[:, 2])),
    }
    rows = (
        row(
            "height from the shortest range",
            Form.PUBLISHED,
            "section 1.2, z0 = z1 - l3",
            printed,
            settings.altitude_m - shortest,
        ),
        row("height known", Form.OURS, "least squares in the plane", known, None),
        row(
            "height estimated",
            Form.OURS,
            "least squares in space, below the UAV",
            solved[:, :2],
            solved[:, 2],
        ),
        Row("bound, height known", Form.BOUND, {"rmse_m": statistics.rms(flat)}),
        Row("bound, height estimated", Form.BOUND, in_space),
    )
    metrics = (
        Metric("rmse_m", "RMSE, m", 3, "root of the mean squared horizontal error"),
        Metric("over_known", "over bound", 3, "the same over the bound of known heights"),
        Metric("height_rmse_m", "height, m", 3, "root of the mean squared error of the height"),
    )
    title = f"Heights, radius {radius:g} m, least squares with weights at the estimate"
    return Table("heights", title, metrics, rows)


def path_loss(settings: MovingAnchor, draws: int, random: Random) -> Table:
    """Ranges by (1), at each shadowing."""
    radius, rows = settings.radii_m[0], []
    for shadowing in settings.shadowing_db:
        errors = settings.path_loss(shadowing)
        s = field_sample(settings, radius, range(draws), random, errors)
        start = linear(s.seen)
        quasi = quasi_likelihood(s.seen, s.noise, linear_weighted(s.seen, s.noise)).x
        sd = s.seen.sd(RangeNoise(share=errors.log_sd), distances(s.x, s.seen.anchors, s.seen.rise)[0])
        bound = range_bound(s.x, s.seen.anchors, sd, s.seen.rise)
        variance = _mean(settings, np.trace(bound, axis1=1, axis2=2))
        found = {
            ("linear", Form.PUBLISHED): start,
            ("least squares, weights at the estimate", Form.MENDED): quasi,
            ("least squares of logarithms", Form.OURS): log_likelihood(s.seen, errors.log_sd, quasi).x,
        }
        about = f"{shadowing:g} dB, {100 * errors.noise.share:.1f} % of the distance"
        for (name, form), x in found.items():
            squares = _mean(settings, np.sum((x - s.x) ** 2, axis=1))
            values = {
                "rmse_m": statistics.rms(squares),
                "over_bound": statistics.rms_ratio(squares, variance),
            }
            rows.append(Row(f"{shadowing:g} dB: {name}", form, values, about))
        rows.append(Row(f"{shadowing:g} dB: bound", Form.BOUND, {"rmse_m": statistics.rms(variance)}, about))
    metrics = (
        Metric("rmse_m", "RMSE, m", 3, "root of the mean squared horizontal error"),
        Metric(
            "over_bound", "RMSE / bound", 3, "over the Cramér-Rao bound of log-normal errors, which is exact"
        ),
    )
    title = f"Ranges by path loss (1), exponent {settings.path_loss_exponent:g}, radius {radius:g} m"
    return Table("path_loss", title, metrics, tuple(rows))


def _mean(settings: MovingAnchor, values: Array) -> Array:
    """(draws,) mean over the nodes of each draw, of (draws * nodes,)."""
    return values.reshape(-1, settings.nodes).mean(axis=1)
