"""Figures over independent draws, with bootstrap intervals; methods are compared on the same draws."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..resampling import LEAST_RUNS, resampled_means, tails
from .results import Array, Value

Figure = Callable[[Array], Array]
"""Of means (..., c) over draws, (...)."""


def mean(values: ArrayLike) -> Value:
    """Mean over draws (k,); those that are NaN are left out."""
    return _value([values], lambda m: m[..., 0])


def rms(squares: ArrayLike) -> Value:
    """Root of the mean over draws of squared errors (k,), each perhaps a mean over the nodes of its draw."""
    return _value([squares], lambda m: np.sqrt(m[..., 0]))


def rms_ratio(squares: ArrayLike, reference: ArrayLike) -> Value:
    """Root of the mean of ``squares`` (k,) over that of ``reference`` (k,), of the same draws.

    Both are resampled by the same draws, so that what these have in common cancels. The reference may be
    another method's squared errors, or the bound's variances.
    """
    return _value([squares, reference], lambda m: np.sqrt(m[..., 0] / m[..., 1]))


def mean_ratio(values: ArrayLike, reference: ArrayLike) -> Value:
    """Mean of ``values`` (k,) over that of ``reference`` (k,), of the same draws."""
    return _value([values, reference], lambda m: m[..., 0] / m[..., 1])


def _value(columns: list[ArrayLike], figure: Figure) -> Value:
    values = np.column_stack([np.asarray(column, float) for column in columns])
    known = values[np.isfinite(values).all(axis=1)]
    if not len(known):
        return Value(np.nan)
    value = float(figure(known.mean(axis=0)))
    if len(known) < LEAST_RUNS:
        return Value(value)
    low, high = np.quantile(figure(resampled_means(known)), tails(0.95))
    return Value(value, float(low), float(high))
