"""Confidence intervals over runs, by resampling them."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from ..align.estimate import Array
from .score import GROUPS

LEAST_RUNS = 30
"""From which a confidence interval is given."""
_KEPT = 4_000_000
"""Counts of resamples that are kept, 32 MB."""


def bootstrap_rms_interval(errors: Array, probability: float = 0.95) -> Array:
    """Confidence interval, shape (2, c), of the RMS over runs of errors (runs, c); NaN for few runs.

    Percentiles over resampled runs (Efron, Tibshirani, "An Introduction to the Bootstrap", chapter 13): the
    errors need be neither zero-mean nor Gaussian. Runs with a NaN are left out; fewer than `LEAST_RUNS` say
    too little of their own spread. The same errors give the same interval.
    """
    squares = errors[np.isfinite(errors).all(axis=1)] ** 2
    if len(squares) < LEAST_RUNS:
        return np.full((2, errors.shape[1]), np.nan)
    return np.sqrt(np.quantile(resampled_means(squares), tails(probability), axis=0))


def rms_over(errors: Array, floor: Array, probability: float = 0.95) -> dict[str, Array]:
    """RMS over runs against a bound, by `GROUPS`: ratio and its confidence interval, shape (3,).

    ``errors`` (runs, 5), ``floor`` (5,), both in the units of `COLUMNS`. NaN where there is no bound, and for
    intervals of few runs.
    """
    squares = _group_squares(errors[np.isfinite(errors).all(axis=1)])
    floors = _group_squares(floor[None])[0]
    return _ratios(squares, np.tile(floors, (len(squares), 1)), probability)


def paired_ratios(errors: Array, reference: Array, probability: float = 0.95) -> dict[str, Array]:
    """RMS of one filter over that of another on the same runs, by `GROUPS`: ratio and interval, shape (3,).

    Both are resampled by the same runs, so that what runs have in common cancels. ``errors`` and
    ``reference`` (runs, 5); runs in which one of the two has a NaN are left out.
    """
    both = np.isfinite(errors).all(axis=1) & np.isfinite(reference).all(axis=1)
    return _ratios(_group_squares(errors[both]), _group_squares(reference[both]), probability)


def _group_squares(errors: Array) -> Array:
    """(runs, 3)."""
    return np.stack([np.mean(errors[:, columns] ** 2, axis=1) for columns in GROUPS.values()], axis=1)


def _ratios(above: Array, below: Array, probability: float) -> dict[str, Array]:
    ratio, interval = np.full(len(GROUPS), np.nan), np.full((2, len(GROUPS)), np.nan)
    if len(above):
        ratio = np.sqrt(above.mean(axis=0) / below.mean(axis=0))
    if len(above) >= LEAST_RUNS:
        means = resampled_means(np.hstack([above, below]))
        ratios = np.sqrt(means[:, : len(GROUPS)] / means[:, len(GROUPS) :])
        interval = np.quantile(ratios, tails(probability), axis=0)
    return {name: np.array([ratio[i], *interval[:, i]]) for i, name in enumerate(GROUPS)}


def resampled_means(values: Array, resamples: int = 2000) -> Array:
    """Means over resampled runs, (resamples, c), of values (runs, c); the same values give the same means."""
    n = len(values)
    counts = _kept_counts(n, resamples) if n * resamples <= _KEPT else _counts(n, resamples)
    return np.concatenate([times_drawn @ values / n for times_drawn in counts])


@lru_cache(maxsize=2)
def _kept_counts(n: int, resamples: int) -> tuple[Array, ...]:
    """The same, for figures of the same few runs that are asked for again and again."""
    return tuple(_counts(n, resamples))


def _counts(n: int, resamples: int) -> Iterator[Array]:
    """How often each of n runs is in each of the resamples, (rows, n), some rows at a time."""
    rng = np.random.default_rng(0)
    block = max(1, 1_000_000 // n)
    for start in range(0, resamples, block):
        rows = min(block, resamples - start)
        drawn = rng.integers(n, size=(rows, n)) + n * np.arange(rows)[:, None]
        yield np.bincount(drawn.ravel(), minlength=rows * n).reshape(rows, n).astype(float)


def tails(probability: float) -> list[float]:
    """Quantiles between which a two-sided interval lies."""
    tail = (1 - probability) / 2
    return [tail, 1 - tail]
