"""Errors against the truth, over all runs of a scenario, in the reader's units."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..aircraft.flight import Flight
from ..align.consistency import mean_band, nees
from ..align.estimate import Array, Estimate, FixOutcome, RunOutcome
from ..sins import attitude, earth
from ..sins.error_model import POSITION
from ..sins.units import ARCMIN, ARCSEC
from .run import Run

COLUMNS = ("roll_arcsec", "pitch_arcsec", "heading_arcmin", "v_east_mps", "v_north_mps")
"""The five figures of Gao et al., Table 3, with their units."""
_PER_UNIT = np.array([1 / ARCSEC, 1 / ARCSEC, 1 / ARCMIN, 1.0, 1.0])

GROUPS = {"level": slice(0, 2), "heading": slice(2, 3), "velocity": slice(3, 5)}
"""Columns that are judged together: the RMS of a group is that of all its components."""

LEVEL_LIMIT_ARCSEC = 60.0
HEADING_LIMIT_ARCMIN = 5.0
LEAST_RUNS = 30
"""From which a confidence interval is given."""
_KEPT = 4_000_000
"""Counts of resamples that are kept, 32 MB."""
FAILED_NEES = 300.0
"""Of the misalignment at the end: ten standard deviations on each of three axes."""


def errors_against(truth: Flight, estimate: Estimate) -> Array:
    """The five errors, estimate minus truth, shape (m, 5), in the units of `COLUMNS`."""
    rows = np.searchsorted(truth.time, estimate.time - 0.5 * truth.dt)
    attitude_error = attitude.attitude_error(estimate.q_nb, truth.q_nb[rows])
    v_error = estimate.v_n - truth.v_n[rows]
    return np.hstack([attitude_error, v_error[:, [1]], v_error[:, [0]]]) * _PER_UNIT


def standard_deviations(truth: Flight, estimate: Estimate, vibration_mps: float) -> Array:
    """The filter's own standard deviations of the five, shape (m, 5), in the units of `COLUMNS`.

    ``vibration_mps`` is the jitter of the measured velocity about the mean motion that truth means: it is in
    the velocity that a navigator puts out, and no filter takes it away.
    """
    rows = np.searchsorted(truth.time, estimate.time - 0.5 * truth.dt)
    T = attitude.attitude_error_matrix(truth.q_nb[rows])
    attitude_sd = np.sqrt(np.einsum("mij,mjk,mik->mi", T, estimate.misalignment_cov, T))
    v_sd = np.hypot(estimate.sd[:, [4, 3]], vibration_mps)
    return np.hstack([attitude_sd, v_sd]) * _PER_UNIT


@dataclass(frozen=True)
class FilterScore:
    """One filter over all runs.

    Attributes
    ----------
    time : (m,) s from the start of the alignment.
    errors : (runs, m, 5), units of `COLUMNS`; NaN before the first fix and in runs that did not last.
    position_errors : (runs, m, 3) NED, m.
    position_nees : (runs, m) squares of these over the filter's variances, summed: three in the mean, if it
        knows its errors.
    nees : (runs, m) of the misalignment, three degrees of freedom.
    nis : (runs,) mean over the fused fixes of a run, six degrees of freedom.
    fused : (runs,) number of fused fixes.
    delay : (runs, m) estimated mean delay, s.
    status : (runs, m) `NavStatus`.
    fix_outcomes : how many fixes ended in which way, over all runs.
    failures : runs that failed, by id, with the reason: ``no_fix``, ``not_finite``, ``no_coarse`` (see
        `RunOutcome`); ``locked_out``, more than half of the fixes refused by the gate; ``diverged``, at the
        end no closer to the true level or heading than at the start, or with a NEES beyond `FAILED_NEES`.
    """

    name: str
    time: Array
    errors: Array
    position_errors: Array
    position_nees: Array
    nees: Array
    nis: Array
    fused: NDArray[np.int64]
    delay: Array
    status: NDArray[np.int8]
    fix_outcomes: dict[FixOutcome, int]
    failures: dict[int, str]

    @property
    def runs(self) -> int:
        """Number of runs, failed ones included."""
        return len(self.errors)

    @property
    def rms(self) -> Array:
        """RMS over runs, shape (m, 5); runs that did not last have no error to count, see `failures`."""
        return _rms(self.errors, axis=0)

    @property
    def window_rms(self) -> Array:
        """RMS over runs and over the last half of the alignment, shape (5,)."""
        return _rms(self.errors[:, self.time > 0.5 * self.time[-1]], axis=(0, 1))

    @property
    def mean_nis(self) -> float:
        """Mean over all fused fixes of all runs."""
        counted = self.fused > 0
        return float(np.average(self.nis[counted], weights=self.fused[counted])) if counted.any() else np.nan

    @property
    def mean_nees(self) -> Array:
        """Mean over runs, shape (m,)."""
        with np.errstate(invalid="ignore"):
            count = np.sum(np.isfinite(self.nees), axis=0)
            return np.where(count > 0, np.nansum(self.nees, axis=0) / np.maximum(count, 1), np.nan)

    @property
    def nees_outside(self) -> float:
        """Share of the time in which the mean NEES lies outside the 95 % band of a consistent filter."""
        count = np.sum(np.isfinite(self.nees), axis=0)
        known = count > 0
        if not known.any():
            return np.nan
        bands = np.array([mean_band(3, int(runs)) for runs in count[known]])
        mean = self.mean_nees[known]
        return float(np.mean((mean < bands[:, 0]) | (mean > bands[:, 1])))

    def time_below(self, columns: slice, limit: float) -> float | None:
        """Time, s from the start, after which the greatest RMS of these columns stays below a limit."""
        over = np.flatnonzero(~(self.rms[:, columns].max(axis=1) < limit))
        if len(over) == 0:
            return round(float(self.time[0]), 6)
        return round(float(self.time[over[-1] + 1]), 6) if over[-1] + 1 < len(self.time) else None


@dataclass
class Scorer:
    """Gathers runs one by one and forgets their histories, so that memory holds the errors alone."""

    truth: Flight
    filters: tuple[str, ...]
    _rows: dict[str, list[tuple[Any, ...]]] = field(default_factory=dict)
    _outcomes: dict[str, dict[FixOutcome, int]] = field(default_factory=dict)
    _failures: dict[str, dict[int, str]] = field(default_factory=dict)
    _time: Array = field(default_factory=lambda: np.empty(0))

    def add(self, run: Run) -> None:
        """Score one run; runs must come in order of their ids, from 0."""
        for name in self.filters:
            estimate = run.estimates[name]
            rows = np.searchsorted(self.truth.time, estimate.time - 0.5 * self.truth.dt)
            self._time = estimate.time
            phi = attitude.misalignment(estimate.q_nb, self.truth.q_nb[rows])
            covariance = np.where(np.isfinite(phi)[..., None], estimate.misalignment_cov, np.eye(3))
            misalignment_nees = nees(phi, covariance)
            position_error = earth.displacement_n(estimate.lla, self.truth.lla[rows])
            fused = estimate.fused
            nis = float(np.mean(estimate.nis[fused])) if fused.any() else np.nan
            self._rows.setdefault(name, []).append(
                (
                    errors_against(self.truth, estimate),
                    position_error,
                    np.sum((position_error / estimate.sd[:, POSITION]) ** 2, axis=1),
                    misalignment_nees,
                    np.array(nis),
                    np.array(np.count_nonzero(fused)),
                    estimate.delay,
                    estimate.status.astype(np.int8),
                )
            )
            outcomes = self._outcomes.setdefault(name, dict.fromkeys(FixOutcome, 0))
            for outcome in FixOutcome:
                outcomes[outcome] += estimate.count(outcome)
            if reason := self._failure(estimate, run, phi, float(misalignment_nees[-1])):
                self._failures.setdefault(name, {})[run.run_id] = reason

    def _failure(self, estimate: Estimate, run: Run, phi: Array, final_nees: float) -> str | None:
        """Why the run failed, or None."""
        if estimate.outcome is not RunOutcome.ALIGNED:
            return estimate.outcome.name.lower()
        if estimate.count(FixOutcome.GATED) > 0.5 * len(run.fixes):
            return "locked_out"
        at_start = attitude.misalignment(run.q_nb_coarse, self.truth.q_nb[0])
        level, heading = np.linalg.norm(phi[-1, :2]), abs(phi[-1, 2])
        closer = level < np.linalg.norm(at_start[:2]) and heading < abs(at_start[2])
        # A method without a covariance has no NEES to be judged by.
        return "diverged" if not closer or final_nees >= FAILED_NEES else None

    def scores(self) -> dict[str, FilterScore]:
        """Scores by filter name."""
        return {name: self._score(name) for name in self.filters}

    def _score(self, name: str) -> FilterScore:
        errors, position_errors, position_nees, misalignment_nees, nis, fused, delay, status = map(
            np.stack, zip(*self._rows[name], strict=True)
        )
        return FilterScore(
            name=name,
            time=self._time - self.truth.time[0],
            errors=errors,
            position_errors=position_errors,
            position_nees=position_nees,
            nees=misalignment_nees,
            nis=nis,
            fused=fused,
            delay=delay,
            status=status,
            fix_outcomes=self._outcomes[name],
            failures=self._failures.get(name, {}),
        )


def _rms(x: Array, axis: int | tuple[int, ...]) -> Array:
    """RMS of what is finite; NaN where nothing is."""
    finite = np.isfinite(x)
    count = finite.sum(axis=axis)
    total = np.sum(np.where(finite, x, 0.0) ** 2, axis=axis)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


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
