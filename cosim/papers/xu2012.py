"""Xu et al. 2012: INS/WSN with a stochastic H-infinity filter, and an LS-SVM over outages of the WSN.

Source: Y. Xu, X. Chen, Q. Li, "INS/WSN-Integrated Navigation Utilizing LS-SVM and H-infinity Filtering",
Mathematical Problems in Engineering 2012, 707326. What happens is in `xu2012_world`, what is learnt in
`xu2012_bridges`; here are the methods, and the tables of what they do.
"""

from dataclasses import dataclass

import numpy as np

from ...align.consistency import mean_band, nees
from ...align.lmi.design import DesignError
from ...align.lmi.stochastic_hinf import Form as When
from ..scenario import ScenarioError
from . import statistics
from .results import Array, Form, Metric, Progress, Results, Row, Table, Value
from .xu2012_bridges import learnt
from .xu2012_filters import (
    Gains,
    bound,
    errors,
    free_running,
    kalman,
    robust,
    tuned_share,
)
from .xu2012_settings import InsWsn
from .xu2012_world import SEEN, Draws, World

__all__ = ["InsWsn", "Method", "Trial", "study", "trial"]


@dataclass(frozen=True)
class Method:
    """One method over all draws."""

    name: str
    form: Form
    about: str
    errors: Array
    """(k, n, 4) of position and velocity, m and m/s; NaN where the method has no part."""
    P: Array | None = None
    """(n, 4, 4) covariance that it claims."""


@dataclass(frozen=True)
class Trial:
    """All methods on the same draws, by their keys."""

    world: World
    methods: dict[str, Method]
    bound: Array
    """(n, 4) variances."""
    chosen: Array
    """As `xu2012_bridges.Learnt` has it."""


AREAS = ("training area 1", "outage 1", "training area 2", "outage 2")
COMPONENTS = ("x_m", "y_m", "vx_mps", "vy_mps")


def study(settings: InsWsn, draws: int, seed: int, progress: Progress | None = None) -> Results:
    """The experiment. Raises `ScenarioError` for parameters that no H-infinity filter is found for."""
    from .xu2012_claims import claims_of
    from .xu2012_figures import figures_of
    from .xu2012_recording import write_recording

    done = trial(settings, draws, seed, progress)
    tables = tuple(stretch_table(done, i) for i in range(len(AREAS)))
    return Results(
        tables=(*tables, parameter_table(done)),
        claims=claims_of(done),
        figures=figures_of(done),
        notes=(*NOTES, consistency_note(done)),
        estimates=columns_of(done),
        write_recording=lambda path: write_recording(path, done),
    )


NOTES = (
    "The text of the paper has lost its formulas, its gains and the sizes of its areas: Theorem 2.3 is"
    " derived anew, and all noises but the accuracy of a fix and the period are ours.",
    "The INS is corrected at once by what a filter finds, so that the period's error multiplies what is left"
    " of the INS's error; the INS alone starts from a corrected one in each training area.",
    "The paper's model (2.3) has no state for a bias: the KF on it, and the H-infinity filter's weights, are"
    " told the white noise with which that KF errs least, or so many times its variance.",
    "Inputs of LS-SVM and network are the INS's own position and velocity: of its errors, which (3.10) speaks"
    " of, an INS in an outage knows nothing.",
    "Filters of the paper's model take position and velocity from the first fix after an outage; the one with"
    " biases goes on.",
)


def trial(settings: InsWsn, draws: int, seed: int, progress: Progress | None = None) -> Trial:
    """Run all methods. Raises `ScenarioError` as `study` does."""
    world = World(settings)
    drawn = Draws.of(world, draws, seed)
    try:
        filters = _filters(world)
    except DesignError as error:
        raise ScenarioError(f"experiment: no H-infinity filter for these figures: {error}") from error
    found = {key: errors(world, drawn, made) for key, _, _, _, made in filters}
    free = free_running(world, drawn, found[PUBLISHED])
    mended = free_running(world, drawn, found[MENDED]), found[MENDED]
    bridged = learnt(world, free, found[PUBLISHED], mended, progress)
    methods = {"ins": Method("INS alone", Form.BASELINE, "set anew in each training area", free[..., SEEN])}
    for key, name, form, about, made in filters:
        claimed = None if made.P is None else made.P[:, SEEN, SEEN]
        methods[key] = Method(name, form, about, found[key][..., SEEN], claimed)
    for key, name, form, about in (
        ("mlp", "back-propagation", Form.PUBLISHED, "network on the same pairs: align/bridging/mlp.py"),
        ("lssvm", "LS-SVM", Form.PUBLISHED, "(3.1) to (3.11): align/bridging/lssvm.py"),
        ("rates", "LS-SVM of rates", Form.MENDED, "of the error's rate over velocity, summed"),
    ):
        methods[key] = Method(name, form, about, bridged.errors[key])
    return Trial(world, methods, bound(world, drawn), bridged.chosen)


MATCHED, WITH_BIAS, PUBLISHED, MENDED = "kf", "kf_biases", "hinf", "hinf_mended"
"""Keys of methods."""
BRIDGES = ("mlp", "lssvm", "rates")


def mistold(key: str, share: float) -> str:
    """Key of a filter that is told another process noise."""
    return f"{key}_told_{share:g}"


def _filters(world: World) -> list[tuple[str, str, Form, str, Gains]]:
    """Key, name, form, about and gains."""
    slack, right = world.settings.gamma_slack, tuned_share(world)
    published = robust(world, When.PREDICTED, right)
    mended = robust(world, When.FILTERED, right, slack)
    return [
        (MATCHED, "KF", Form.BASELINE, "on (2.3), best process noise", kalman(world, right)),
        *(
            (
                mistold(MATCHED, share),
                f"KF told {share:g} Q",
                Form.BASELINE,
                "the same, told so much of its process noise",
                kalman(world, share * right),
            )
            for share in world.settings.mistuned
        ),
        (
            PUBLISHED,
            "H-infinity",
            Form.PUBLISHED,
            f"(2.9), Theorem 2.3: gamma = {published.gamma:.3f}; align/lmi/stochastic_hinf.py",
            published,
        ),
        *(
            (
                mistold(PUBLISHED, share),
                f"H-infinity told {share:g} Q",
                Form.BASELINE,
                "the published one, told so much of its process noise",
                robust(world, When.PREDICTED, share * right),
            )
            for share in world.settings.mistuned
        ),
        (
            MENDED,
            "H-infinity, mended",
            Form.MENDED,
            f"uses a fix at once; little variance, gamma = {mended.gamma:.3f}, {slack:g} of the least",
            mended,
        ),
        (WITH_BIAS, "KF with biases", Form.OURS, "six states; coasts", kalman(world, with_bias=True)),
    ]


def stretch_table(done: Trial, i: int) -> Table:
    """Errors in a training area or an outage."""
    stretch = done.world.settings.stretches[i]
    draws = len(done.methods["ins"].errors)
    low, high = mean_band(4, draws)
    metrics = (
        Metric("x_mean_m", "x, m", 3, "mean absolute error of position in x", brief=False),
        Metric("y_mean_m", "y, m", 3, "mean absolute error of position in y", brief=False),
        Metric("vx_mean_mps", "vx, m/s", 4, "mean absolute error of velocity in x", brief=False),
        Metric("vy_mean_mps", "vy, m/s", 4, "mean absolute error of velocity in y", brief=False),
        Metric("position_rms_m", "p, m", 3, "position, RMS length of the error"),
        Metric("velocity_rms_mps", "v, m/s", 4, "velocity, RMS length of the error"),
        Metric("position_over_bound", "p/bound", 2, "position, RMS over that of the bound, same draws"),
        Metric("velocity_over_bound", "v/bound", 2, "velocity, RMS over that of the bound, same draws"),
        Metric(
            "nees",
            f"NEES {low:.2f}-{high:.2f}",
            2,
            "of 4, at the last epoch, mean over the draws; 95 % of consistent filters are between these",
        ),
    )
    rows = [
        _row(done, method, stretch)
        for method in done.methods.values()
        if np.isfinite(method.errors[:, stretch]).all()
    ]
    floor = done.bound[stretch]
    best = {
        "position_rms_m": Value(float(np.sqrt(floor[:, :2].sum(axis=1).mean()))),
        "velocity_rms_mps": Value(float(np.sqrt(floor[:, 2:].sum(axis=1).mean()))),
    }
    rows.append(Row("Cramer-Rao bound", Form.BOUND, best, "of one who knows every period's error"))
    name = AREAS[i].replace(" ", "_")
    title = f"{AREAS[i].capitalize()}" + ("", "", " (the paper's Table 2)", " (the paper's Table 3)")[i]
    return Table(name, title, metrics, tuple(rows))


def _row(done: Trial, method: Method, stretch: slice) -> Row:
    e = method.errors[:, stretch]
    absolute = mean_absolute(method, stretch)
    values = {
        f"{name[: name.index('_')]}_mean_{name[name.index('_') + 1 :]}": statistics.mean(absolute[:, c])
        for c, name in enumerate(COMPONENTS)
    }
    for name, unit, part in (("position", "m", slice(0, 2)), ("velocity", "mps", slice(2, 4))):
        squares = np.sum(e[..., part] ** 2, axis=2).mean(axis=1)
        floor = np.full(len(e), done.bound[stretch, part].sum(axis=1).mean())
        values[f"{name}_rms_{unit}"] = statistics.rms(squares)
        values[f"{name}_over_bound"] = statistics.rms_ratio(squares, floor)
    if method.P is not None:
        last = stretch.stop - 1
        values["nees"] = statistics.mean(nees(method.errors[:, last], method.P[last]))
    return Row(method.name, method.form, values, method.about)


def consistency_note(done: Trial) -> str:
    """NEES of the best filter at the ends of all stretches, beside the bands of one and of all of them."""
    method, stretches = done.methods[WITH_BIAS], done.world.settings.stretches
    if method.P is None:
        raise ValueError(f"{method.name} claims no covariance")
    ends = [part.stop - 1 for part in stretches]
    found = np.array([nees(method.errors[:, k], method.P[k]).mean() for k in ends])
    told = []
    # Bonferroni's: whatever the stretches have in common.
    for which, outside in (("of each", 0.05), ("of all four at once", 0.05 / len(ends))):
        low, high = mean_band(4, len(method.errors), 1 - outside)
        inside = np.count_nonzero((low <= found) & (found <= high))
        told.append(f"{inside} of 4 within the 95 % band {which}, {low:.2f} to {high:.2f}")
    figures = ", ".join(f"{value:.2f}" for value in found)
    return f"NEES of {method.name} at the ends of the stretches: {figures} of 4; {'; '.join(told)}."


def mean_absolute(method: Method, stretch: slice) -> Array:
    """(k, 4) mean over a stretch of each draw's absolute errors: the paper's "mean error"."""
    return np.abs(method.errors[:, stretch]).mean(axis=1)


def parameter_table(done: Trial) -> Table:
    """What the LS-SVM chose: the paper's Table 1, which has it of one draw."""
    metrics = (
        Metric("log10_gamma", "log10 gamma", 2, "regularisation parameter"),
        Metric("log2_width", "log2 width", 2, "of the kernel, in standard deviations of the inputs"),
        Metric("verification_rms", "verification", 2, "RMS error over the verification half, 1 is no skill"),
    )
    rows = []
    for i in range(2):
        gamma, width, rms = done.chosen[:, i].T
        values = (np.log10(gamma), np.log2(width), rms)
        named = zip(metrics, values, strict=True)
        rows.append(
            Row(
                f"LS-SVM, {AREAS[2 * i]}",
                Form.PUBLISHED,
                {metric.key: statistics.mean(value) for metric, value in named},
                "means over the draws",
            )
        )
    return Table("parameters", "Parameters by cross-validation (the paper's Table 1)", metrics, tuple(rows))


def columns_of(done: Trial) -> dict[str, Array]:
    """Columns of `estimates.parquet`: one row for each draw and epoch."""
    draws, n, _ = done.methods["ins"].errors.shape
    columns = {
        "draw": np.repeat(np.arange(draws, dtype=float), n),
        "time_s": np.tile(done.world.time, draws),
    }
    for key, method in done.methods.items():
        for c, component in enumerate(COMPONENTS):
            columns[f"{key}: error_{component}"] = method.errors[..., c].ravel()
    for c, component in enumerate(COMPONENTS):
        columns[f"bound: sd_{component}"] = np.tile(np.sqrt(done.bound[:, c]), draws)
    return columns
