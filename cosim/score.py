"""Errors against the truth, over all runs of a scenario, in the reader's units."""

from dataclasses import dataclass, field
from functools import cached_property
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
FAILED_NEES = 300.0
"""Of the misalignment at the end: ten standard deviations on each of three axes."""
NEVER_JUDGED = np.array(
    [FixOutcome.DUPLICATE, FixOutcome.UNAUTHENTIC, FixOutcome.NOT_FINITE, FixOutcome.INVALID], np.intp
)
"""Outcomes of packets that no filter looks into: however many there are, they tell nothing of its gate."""


def errors_against(truth: Flight, estimate: Estimate) -> Array:
    """The five errors, estimate minus truth, shape (m, 5), in the units of `COLUMNS`."""
    return _five(_Truth.at(truth, estimate.time), estimate.q_nb, estimate.v_n)


@dataclass(frozen=True)
class _Truth:
    """A flight at the times of an estimate."""

    lla: Array
    v_n: Array
    q_nb: Array
    euler: Array

    @classmethod
    def at(cls, truth: Flight, time: Array) -> "_Truth":
        rows = np.searchsorted(truth.time, time - 0.5 * truth.dt)
        q_nb = truth.q_nb[rows]
        return cls(truth.lla[rows], truth.v_n[rows], q_nb, attitude.to_euler(q_nb))


def _five(truth: _Truth, q_nb: Array, v_n: Array) -> Array:
    """The five errors, (..., m, 5), of attitudes (..., m, 4) and velocities (..., m, 3)."""
    attitude_error = attitude.wrapped(attitude.to_euler(q_nb) - truth.euler)
    v_error = v_n - truth.v_n
    return np.concatenate([attitude_error, v_error[..., [1, 0]]], axis=-1) * _PER_UNIT


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
    restarts : how often a filter started again after its start, over all runs.
    failures : runs that failed, by id, with the reason: ``no_fix``, ``not_finite``, ``no_coarse`` (see
        `RunOutcome`); ``locked_out``, the gate refused more than half of the fixes but `NEVER_JUDGED`;
        ``diverged``, at the end no closer to the true level or heading than at the start, or with a NEES
        beyond `FAILED_NEES`.
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
    restarts: int = 0

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
    _outcomes: dict[str, NDArray[np.int64] | int] = field(default_factory=dict)
    _failures: dict[str, dict[int, str]] = field(default_factory=dict)
    _restarts: dict[str, int] = field(default_factory=dict)
    _time: Array = field(default_factory=lambda: np.empty(0))

    @cached_property
    def _truth(self) -> _Truth:
        return _Truth.at(self.truth, self._time)

    def add(self, *runs: Run, rows: slice | NDArray[np.intp] = slice(None)) -> None:
        """Score these ``rows`` of the histories of runs, which must come in order of their ids, from 0."""
        estimates = [run.estimates[name] for run in runs for name in self.filters]
        self._time = estimates[0].time[rows]
        # All at once: a call of numpy on so few rows costs as much as on many times as many.
        q_nb, v_n, lla, misalignment_cov = (
            np.stack([getattr(estimate, column)[rows] for estimate in estimates])
            for column in ("q_nb", "v_n", "lla", "misalignment_cov")
        )
        position_sd = np.stack([estimate.sd[rows, POSITION] for estimate in estimates])
        phi = attitude.misalignment(q_nb, self._truth.q_nb)
        covariance = np.where(np.isfinite(phi)[..., None], misalignment_cov, np.eye(3))
        misalignment_nees = nees(phi, covariance)
        position_error = earth.displacement_n(lla, self._truth.lla)
        position_nees = np.sum((position_error / position_sd) ** 2, axis=-1)
        errors = _five(self._truth, q_nb, v_n)
        phi_0 = attitude.misalignment(np.stack([run.q_nb_coarse for run in runs]), self.truth.q_nb[0])
        phi_0 = np.repeat(phi_0, len(self.filters), axis=0)
        level, level_0 = (np.hypot(x[:, 0], x[:, 1]) for x in (phi[:, -1], phi_0))
        closer = (level < level_0) & (np.abs(phi[:, -1, 2]) < np.abs(phi_0[:, 2]))
        # A method without a covariance has no NEES to be judged by.
        diverged = ~closer | (misalignment_nees[:, -1] >= FAILED_NEES)
        for i, estimate in enumerate(estimates):
            which, nth = divmod(i, len(self.filters))
            run, name = runs[which], self.filters[nth]
            counts = np.bincount(estimate.fix_outcome, minlength=len(FixOutcome))
            fused = int(counts[FixOutcome.FUSED])
            nis = float(estimate.nis[estimate.fused].sum()) / fused if fused else np.nan
            self._rows.setdefault(name, []).append(
                (
                    errors[i],
                    position_error[i],
                    position_nees[i],
                    misalignment_nees[i],
                    nis,
                    fused,
                    estimate.delay[rows],
                    estimate.status[rows].astype(np.int8),
                )
            )
            self._outcomes[name] = self._outcomes.get(name, 0) + counts
            again = max(int(counts[FixOutcome.INITIALIZED]) - 1, 0)
            self._restarts[name] = self._restarts.get(name, 0) + again
            reason = None
            if estimate.outcome is not RunOutcome.ALIGNED:
                reason = estimate.outcome.name.lower()
            elif counts[FixOutcome.GATED] > 0.5 * (counts.sum() - counts[NEVER_JUDGED].sum()):
                reason = "locked_out"
            elif diverged[i]:
                reason = "diverged"
            if reason:
                self._failures.setdefault(name, {})[run.run_id] = reason

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
            fix_outcomes=dict(zip(FixOutcome, np.asarray(self._outcomes[name]).tolist(), strict=True)),
            failures=self._failures.get(name, {}),
            restarts=self._restarts[name],
        )


def _rms(x: Array, axis: int | tuple[int, ...]) -> Array:
    """RMS of what is finite; NaN where nothing is."""
    finite = np.isfinite(x)
    count = finite.sum(axis=axis)
    total = np.sum(np.where(finite, x, 0.0) ** 2, axis=axis)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
