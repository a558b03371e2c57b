"""An alignment as the compiled loops take it, with one way to treat delays; and its run."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..sins.imu import ImuErrors
from ..sins.units import MILLISECOND
from . import _alignment_kernel, _cubature_kernel, _memory
from ._kernels import N_X
from .consistency import chi_square_quantile
from .estimate import HISTORIES, Array, Estimate, NavStatus, RunOutcome, SampleOutcome
from .inputs import AlignmentInput
from .measurement import N_STATES
from .reception import Integers, Reception, counted_from
from .settings import DelayModel, FilterSettings, Transform, initial_sd, noise_density


class Problem(NamedTuple):
    """A record and fixes, and what the compiled loops take of the settings."""

    time: Array
    increments: Array
    """(n, 6)."""
    gap_variance: Array
    q_nb_coarse: Array
    reception: Reception
    outcome: Integers
    """(k,) of fixes in order of arrival, `FixOutcome`; filled by `run`."""
    delay: DelayModel
    delay_sd: float
    initial: Array
    initial_sd: Array
    noise_density: Array
    vibration_variance: float
    gate: float
    patience: int
    dead_reckoning_after: float
    horizon: int
    """Epochs by which a stamped fix may be late."""
    samples: int
    """Intervals over which specific force and rate are averaged."""
    gravity: int
    output_epoch: Integers
    held: int
    imu_samples: dict[SampleOutcome, int]
    lost: Array
    """(j,) s, further outputs that there would be, had the IMU not been lost."""

    @property
    def dt(self) -> float:
        """Mean interval, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    @property
    def kept(self) -> int:
        """Epochs of which state and covariance are kept."""
        return self.horizon + 1 if self.delay is DelayModel.STAMPED else 1


def pose(given: AlignmentInput, delay: DelayModel) -> Problem:
    """The problem of a filter that treats delays so; its arrays are those of ``given``, but for `outcome`."""
    record, settings = given.record, given.settings
    time, dt = record.time[: record.end], given.dt
    stamped, estimated = delay is DelayModel.STAMPED, delay is DelayModel.ESTIMATED
    delay_sd_ms = settings.stamp_sd_ms * stamped + settings.delay_sd_ms * estimated
    outcome, reception = counted_from(time, given.received, stamped, settings.stamp_sd_ms * MILLISECOND)
    before, after = given.output_epochs
    # Frozen settings have a hash, which the types do not tell.
    initial, sd, density = _told(settings, given.imu, delay)  # pyright: ignore[reportArgumentType]
    return Problem(
        time=time,
        increments=record.increments[: record.end],
        gap_variance=record.gap_variance[: record.end],
        q_nb_coarse=given.q_nb_coarse,
        reception=reception,
        outcome=outcome,
        delay=delay,
        delay_sd=delay_sd_ms * MILLISECOND,
        initial=initial,
        initial_sd=sd,
        noise_density=density,
        vibration_variance=given.imu.vibration_mps**2,
        gate=_gate(settings.gate_probability),
        patience=settings.restart_after_gated,
        dead_reckoning_after=settings.dead_reckoning_after_s,
        horizon=round(settings.horizon_s / dt),
        samples=max(1, round(settings.acceleration_window_s / dt)),
        gravity=int(given.gravity),
        output_epoch=before,
        held=record.held,
        imu_samples=record.counts,
        lost=record.time[after],
    )


def run_all(problems: Sequence[Problem], transform: Transform = Transform.DERIVATIVES) -> list[Estimate]:
    """Run the filter over several records, of one ``settings``.

    One working memory serves them all, and the loops follow each other: both stay in a processor's caches.
    """
    if not problems:
        return []
    fixes, kept = max(len(one.outcome) for one in problems), max(one.kept for one in problems)
    memory = _memory.working_memory(fixes, kept, len(problems[0].initial_sd))
    outputs = [_outputs(one) for one in problems]
    outcomes = [_run(one, of_one, memory, transform) for one, of_one in zip(problems, outputs, strict=True)]
    return [_estimate(*of_one) for of_one in zip(problems, outputs, outcomes, strict=True)]


def run(
    problem: Problem, transform: Transform = Transform.DERIVATIVES
) -> tuple[Estimate, tuple[Array, Array]]:
    """Run the filter; also state (`Problem.kept`, 22) and covariance (`Problem.kept`, n, n) of the last
    epochs, each before its fixes, at the epoch's number modulo `Problem.kept`."""
    memory = _memory.working_memory(len(problem.outcome), problem.kept, len(problem.initial_sd))
    outputs = _outputs(problem)
    return _estimate(problem, outputs, _run(problem, outputs, memory, transform)), memory[2:4]


def _run(
    problem: Problem, outputs: tuple[Any, ...], memory: tuple[Any, ...], transform: Transform
) -> RunOutcome:
    cubature = None
    if transform is not Transform.DERIVATIVES:
        rooted = transform is Transform.SQUARE_ROOT
        cubature = _cubature_kernel.points_memory(len(problem.initial_sd), rooted)
    started, finite_to_the_end = _alignment_kernel.align(
        problem.time,
        problem.increments,
        problem.gap_variance,
        problem.q_nb_coarse,
        problem.reception,
        problem.outcome,
        int(problem.delay),
        problem.delay_sd,
        problem.initial,
        problem.initial_sd,
        problem.noise_density,
        problem.vibration_variance,
        problem.gate,
        problem.patience,
        problem.dead_reckoning_after,
        problem.horizon,
        problem.samples,
        problem.gravity,
        problem.output_epoch,
        outputs,
        memory,
        cubature,
    )
    if not started:
        return RunOutcome.NO_FIX
    return RunOutcome.ALIGNED if finite_to_the_end else RunOutcome.NOT_FINITE


def unaligned(problem: Problem, outcome: RunOutcome) -> Estimate:
    """What is known where no filter ran: nothing."""
    outputs = _outputs(problem)
    outputs[7][:] = NavStatus.NOT_STARTED
    return _estimate(problem, outputs, outcome)


def status_of(time: Array, taken: Array, after_s: float) -> Integers:
    """`NavStatus` at some times, (m,) s, from those at which fixes arrived that were taken, (k,) s,
    increasing."""
    count = np.searchsorted(taken, time, side="right")
    since = time - np.append(-np.inf, taken)[count]
    status = np.where(since > after_s, NavStatus.DEAD_RECKONING, NavStatus.AIDED)
    return np.where(count > 0, status, NavStatus.NOT_STARTED).astype(np.int64)


def _outputs(problem: Problem) -> tuple[Any, ...]:
    m, k, states = len(problem.output_epoch), len(problem.outcome), len(problem.initial_sd)
    shapes = ((m, N_X), (m, states), (m, 3, 3), (k, 6), (k,), (k,), (k,))
    unknown = tuple(np.full(shape, np.nan) for shape in shapes)
    return *unknown, np.full(m, NavStatus.STOPPED, np.int64), np.full(m, np.nan)


def _estimate(problem: Problem, outputs: tuple[Any, ...], outcome: RunOutcome) -> Estimate:
    X, variance, misalignment_cov, innovation, nis, fix_time, fix_jump, status, jump = outputs
    return Estimate(
        time=problem.time[problem.output_epoch],
        **state_columns(X),
        sd=np.sqrt(variance),
        misalignment_cov=misalignment_cov,
        innovation=innovation,
        nis=nis,
        fix_time=fix_time,
        fix_outcome=problem.outcome,
        fix_jump=fix_jump,
        status=status,
        jump=jump,
        held_imu_samples=problem.held,
        outcome=outcome,
        imu_samples=problem.imu_samples,
    )


def to_the_end(problem: Problem, found: Estimate) -> Estimate:
    """With rows that know nothing for the time after the IMU was lost, and that for the outcome."""
    j = len(problem.lost)
    if j == 0:
        return found
    histories = {
        name: np.concatenate([value, np.full((j, *value.shape[1:]), np.nan)])
        for name in HISTORIES
        for value in (getattr(found, name),)
    }
    lost = found.outcome is RunOutcome.ALIGNED
    return replace(
        found,
        **histories,
        time=np.append(found.time, problem.lost),
        status=np.append(found.status, np.full(j, NavStatus.STOPPED)),
        outcome=RunOutcome.IMU_LOST if lost else found.outcome,
    )


def state_columns(X: Array) -> dict[str, Array]:
    """The fields of an `Estimate` that state vectors, (m, 22), holds."""
    return {
        "lla": X[:, 0:3],
        "v_n": X[:, 3:6],
        "q_nb": X[:, 6:10],
        "accel_bias": X[:, 10:13],
        "gyro_bias": X[:, 13:16],
        "delay": X[:, 16],
        "lever_arm_b": X[:, 17:20],
    }


@lru_cache(maxsize=16)
def _told(settings: FilterSettings, imu: ImuErrors, delay: DelayModel) -> tuple[Array, Array, Array]:
    """Biases, delay and lever arm at the start, (10,), standard deviations there, (n,), and noise densities,
    (n,): the same for many runs, and written to by none."""
    delay_mean_ms = settings.delay_mean_ms if delay is DelayModel.ESTIMATED else 0.0
    initial = np.array([0.0] * 6 + [delay_mean_ms * MILLISECOND, *settings.lever_arm_b_m])
    sd = initial_sd(settings, imu, delay)
    density = np.zeros(len(sd))
    density[:N_STATES] = noise_density(imu)
    return initial, sd, density


@cache
def _gate(probability: float) -> float:
    """Largest NIS of a fix that passes; cached, since the quantile costs as much as a hundred samples."""
    return float(chi_square_quantile(probability, 6))
