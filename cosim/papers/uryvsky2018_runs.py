"""All methods of Uryvsky et al. on the same ranges, under each of the conditions."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from ...align.consistency import nees
from ...network.localization.batch_ranging import batch
from ...network.localization.plane import distances, information
from ...network.localization.rangefinder import covariance_as_printed, rangefinder
from ...network.localization.repeated_ranging import AS_PRINTED, PRINTED_GAIN, UPDATES, Update
from ..run import generator
from .results import Array
from .uryvsky2018_settings import FOUR, RepeatedRanging

DRAWN = ("nominal", "outliers")
"""Conditions of Fig. 2, for which all methods are run at all cycles."""
_ASYMMETRY = 0.01


@dataclass(frozen=True)
class Condition:
    """How ranges err; arrays (draws, N, e, 2) of e elements' ranges to the two references."""

    key: str
    title: str
    ranges: Array
    stated_sd: Array
    information: Array
    """What a range tells: (sd)^-2, for a mixture with outliers its Fisher information."""


@dataclass(frozen=True)
class Outcome:
    """A method in a condition."""

    squares: Array
    """(draws, N) squared errors, mean over elements; NaN at cycles that were not asked for."""
    nees: Array
    """(draws,) after N cycles, mean over elements; NaN where a matrix is none of a covariance."""
    invalid: Array
    """(draws,) share of elements whose matrix is by then none of a covariance: not positive definite, or
    unsymmetric by more than a hundredth of its trace."""
    gain: Array | None = None
    """(draws, N) mean over elements of the gain's mean diagonal."""
    x: Array | None = None
    """(N,) m, x coordinate of the element shown, in the first draw."""

    @property
    def one(self) -> Array:
        """(draws,) mean of the squares of the first four cycles: of one fix, where it is of fixes."""
        return self.squares[:, :FOUR].mean(axis=1)


def conditions(settings: RepeatedRanging, draws: int, seed: int) -> tuple[Condition, ...]:
    """All conditions with the same normal deviates."""
    x = np.array(settings.elements_m)
    shape = (settings.cycles, len(x) - 2, 2)
    streams = [[generator(seed, d, name) for d in range(draws)] for name in ("ranges", "noise", "outliers")]
    normal = np.array([rng.standard_normal(shape) for rng in streams[0]])
    spread = np.array([rng.uniform(-1, 1, shape) for rng in streams[1]])
    outlier = np.array([rng.random(shape) for rng in streams[2]]) < settings.outlier_share
    truth, _ = distances(x[2:], x[:2])
    sd, ratio = np.full(normal.shape, settings.range_sd_m), settings.misstated_ratio
    unequal = sd * settings.unequal_ratio**spread
    wild = np.where(outlier, settings.outlier_ratio, 1.0) * sd
    mixed = mixture_information(settings.outlier_share, settings.outlier_ratio) / sd**2

    def condition(key: str, title: str, true: Array, stated: Array, known: Array | None = None) -> Condition:
        # A rangefinder gives no negative range, however wild it is.
        ranges = np.maximum(truth + true * normal, 1e-3 * truth)
        return Condition(key, title, ranges, stated, true**-2.0 if known is None else known)

    share = f"{100 * settings.outlier_share:g} %"
    return (
        condition("nominal", "Nominal: equal noise, known", sd, sd),
        condition("unequal", "Unequal noise over links and cycles, known", unequal, unequal),
        condition("understated", f"Noise stated {ratio:g} times too low", sd, sd / ratio),
        condition("overstated", f"Noise stated {ratio:g} times too high", sd, sd * ratio),
        condition(
            "outliers", f"{share} outliers of {settings.outlier_ratio:g} times the noise", wild, sd, mixed
        ),
    )


def mixture_information(share: float, ratio: float) -> float:
    """Fisher information on its centre of a normal deviate that with a chance ``share`` is ``ratio`` times
    as wide: by quadrature of the squared slope of its density over the density."""
    r = np.linspace(-12 * ratio, 12 * ratio, 200_001)
    parts = [(1 - share, 1.0), (share, ratio)]
    density = sum(p * norm.pdf(r, scale=s) for p, s in parts)
    slope = sum(-p * r / s**2 * norm.pdf(r, scale=s) for p, s in parts)
    ratio_squared = np.divide(slope**2, density, out=np.zeros_like(r), where=density > 1e-300)
    return float(np.sum(ratio_squared) * (r[1] - r[0]))


def outcomes(settings: RepeatedRanging, condition: Condition) -> dict[str, Outcome]:
    """All methods on the ranges of a condition; "bound" has variances for squares."""
    x = np.array(settings.elements_m)
    references, truth = x[:2], x[2:]
    shown = settings.shown_element - 3
    fixes = rangefinder(references, condition.ranges, condition.stated_sd)
    printed = covariance_as_printed(fixes.x, references, condition.stated_sd)
    everywhere = np.broadcast_to(truth, fixes.x.shape)
    at_truth = information(everywhere, references, condition.information**-0.5)
    summed = np.cumsum(at_truth, axis=1)
    least = np.trace(np.linalg.inv(summed), axis1=-2, axis2=-1).mean(axis=-1)
    nothing = np.full(len(fixes.x), np.nan)

    def outcome(x: Array, cov: Array, gain: Array | None = None) -> Outcome:
        error = x - truth
        squares = np.sum(error**2, axis=-1).mean(axis=-1)
        last, invalid = _consistency(error[:, -1], cov[:, -1])
        trace = None if gain is None else np.trace(gain, axis1=-2, axis2=-1).mean(axis=-1) / 2
        return Outcome(squares, last, invalid, trace, x[0, :, shown, 0])

    def filtered(update: Update, cov: Array) -> Outcome:
        return outcome(*recursion(update, fixes.x, cov, settings.discrepancy_limit))

    count = np.arange(1, settings.cycles + 1)[:, None, None]
    mean = np.cumsum(fixes.x, axis=1) / count
    mean_cov = np.cumsum(fixes.cov, axis=1) / count[..., None] ** 2
    found = {
        "fix": outcome(fixes.x, fixes.cov),
        "fix_printed": outcome(fixes.x, printed),
        "mean": outcome(mean, mean_cov),
        "bound": Outcome(least, nothing, nothing),
    }
    for name, update in UPDATES.items():
        found[name] = filtered(update, fixes.cov)
        found[f"{name}_printed"] = filtered(AS_PRINTED[name], printed)
        if name != "kalman":
            found[f"{name}_gain"] = filtered(PRINTED_GAIN[name], fixes.cov)
    for name, huber in (("batch", np.inf), ("huber", settings.huber_threshold)):
        x_all, cov_all = np.full_like(fixes.x, np.nan), np.full_like(fixes.cov, np.nan)
        for n in range(1, settings.cycles + 1) if condition.key in DRAWN else (1, FOUR, settings.cycles):
            sd, start = condition.stated_sd[:, :n], mean[:, n - 1]
            x_all[:, n - 1], cov_all[:, n - 1], _ = batch(
                references, condition.ranges[:, :n], sd, start, huber
            )
        found[name] = outcome(x_all, cov_all)
    return found


def recursion(update: Update, x: Array, Q: Array, limit: float) -> tuple[Array, Array, Array]:
    """Estimates (draws, N, e, 2), covariances and gains from fixes of the same shape, (5) to (14).

    The first fix is where it starts from, with a gain of one.
    """
    state, cov = x[:, 0], Q[:, 0]
    rows = [(state, cov, np.broadcast_to(np.eye(2), cov.shape))]
    for n in range(1, x.shape[1]):
        state, cov, gain, _ = update(state, cov, x[:, n], Q[:, n], limit)
        rows.append((state, cov, gain))
    states, covs, gains = (np.stack(part, axis=1) for part in zip(*rows, strict=True))
    return states, covs, gains


def _consistency(error: Array, cov: Array) -> tuple[Array, Array]:
    """NEES (draws,) and share of matrices that are no covariances, of errors (draws, e, 2)."""
    size = np.trace(cov, axis1=-2, axis2=-1)
    symmetric = np.abs(cov[..., 0, 1] - cov[..., 1, 0]) < _ASYMMETRY * np.abs(size)
    valid = symmetric & (np.linalg.det(cov) > 0) & (size > 0)
    safe = np.where(valid[..., None, None], cov, np.eye(2))
    return np.where(valid, nees(error, safe), np.nan).mean(axis=-1), 1 - valid.mean(axis=-1)
