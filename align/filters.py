"""Alignment filters by name: one closed-loop error-state filter, three ways to treat a fix's delay.

``ekf``
    Takes a fix for the present when it arrives: the EKF of Gao et al.
``ekf_stamped``
    Trusts the stamp and applies the fix at the time of its validity: what clocks in common make possible.
``l2linf``
    Has no stamp: estimates the mean delay as a state and puts its random part into the measurement noise.
    This is the finite-horizon energy-to-peak (l2-linf) filter; `docs/derivations.md` derives it and
    relates it to Theorem 2 of Gao et al.

References
----------
.. [1] C. Gao, J. Lu, G. Zhao, S. Pan, "A Localization and In-flight Alignment Protocol for Airborne
       SINS Based on Flight-vehicle Wireless Sensor Networks", eqs. (10) to (13), Table 1.
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation
       Systems", 2nd ed., section 14.2.
"""

from enum import IntEnum
from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from ..network.fixes import Fixes
from ..sins.earth import GravityModel
from ..sins.error_model import ACCEL, GYRO, MISALIGN, POSITION, VELOCITY
from ..sins.imu import ImuErrors
from ..sins.mechanization import checked_record
from ..sins.settings import Settings
from ..sins.units import (
    DEG,
    DEG_PER_HOUR,
    DEG_PER_SQRT_HOUR,
    MICRO_G,
    MICRO_G_PER_SQRT_HZ,
    MILLISECOND,
)
from . import _alignment_kernel, _kernels
from .consistency import chi_square_quantile
from .estimate import Estimate, RunOutcome
from .measurement import DELAY, LEVER, N_STATES
from .reception import Integers, Reception, finite_increments, received

Array = NDArray[np.float64]

DIFFUSE_POSITION_M = 1e3
DIFFUSE_VELOCITY_MPS = 1e2
"""Least standard deviations before the first fix; at any rate 100 times the fix's own: it alone decides."""


class DelayModel(IntEnum):
    """How a filter treats the delay of a fix."""

    IGNORED = _kernels.IGNORED
    STAMPED = _kernels.STAMPED
    ESTIMATED = _kernels.ESTIMATED


FILTERS = {"ekf": DelayModel.IGNORED, "ekf_stamped": DelayModel.STAMPED, "l2linf": DelayModel.ESTIMATED}
"""Filters that a scenario can name."""


Coordinate = Annotated[float, Field(ge=-100, le=100)]


class FilterSettings(Settings):
    """What the filters are told, besides the error budget of the IMU and the covariance of each fix."""

    level_sd_deg: float = Field(default=1.0, gt=0, le=30)
    heading_sd_deg: float = Field(default=10.0, gt=0, le=60)
    """Standard deviations of the coarse attitude that the filter starts from."""
    delay_mean_ms: float = Field(default=25.0, ge=0, le=10_000)
    delay_mean_sd_ms: float = Field(default=30.0, ge=0, le=10_000)
    """Prior of the mean delay that ``l2linf`` estimates."""
    delay_sd_ms: float = Field(default=14.4, ge=0, le=10_000)
    """Random part of the delay that ``l2linf`` allows for: 50 ms / sqrt(12) for U[0, 50] ms."""
    stamp_sd_ms: float = Field(default=0.0, ge=0, le=10_000)
    """Random part of the stamps that ``ekf_stamped`` allows for."""
    gate_probability: float = Field(default=0.99999, gt=0.5, lt=1)
    """Probability with which a good fix passes the innovation gate."""
    restart_after_gated: int = Field(default=20, ge=2, le=100_000)
    """So many fixes refused in a row mean that the filter is wrong and not the fixes: it starts again."""
    horizon_s: float = Field(default=2.0, ge=0.1, le=60)
    """How far back a stamped fix may reach."""
    acceleration_window_s: float = Field(default=0.05, gt=0, le=2)
    """Time over which the specific force is averaged to predict where the vehicle was: long enough to see
    through vibration, and not so long that its middle comes before the fix, or the mean is late in a roll."""
    lever_arm_b_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    """The antenna that fixes are valid for, as surveyed from the IMU, in b."""
    lever_arm_sd_m: float = Field(default=0.0, ge=0, le=10)
    """Standard deviation of each component of that; above zero the filters estimate the lever arm."""
    coarse_stage: Literal["none", "in_motion"] = "none"
    """Whether attitude is known coarsely at the start, or is to be found in motion (`coarse`) first."""
    output_rate_hz: float = Field(default=10.0, gt=0, le=1000)


def n_states(settings: FilterSettings) -> int:
    """Number of error states: 16, and three more where the lever arm is estimated."""
    return N_STATES + 3 * (settings.lever_arm_sd_m > 0)


def noise_density(imu: ImuErrors) -> Array:
    """Power spectral densities, shape (16,), of the white noises that drive the error state.

    A Gauss-Markov bias enters as the random walk that it is over times short against its correlation.
    """
    density = np.zeros(N_STATES)
    density[VELOCITY] = (imu.accel_vrw_ug_sqrt_hz * MICRO_G_PER_SQRT_HZ) ** 2
    density[MISALIGN] = (imu.gyro_arw_deg_sqrt_h * DEG_PER_SQRT_HOUR) ** 2
    density[ACCEL] = 2 * (imu.accel_bias_instability_ug * MICRO_G) ** 2 / imu.accel_bias_correlation_s
    density[GYRO] = 2 * (imu.gyro_bias_instability_deg_h * DEG_PER_HOUR) ** 2 / imu.gyro_bias_correlation_s
    return density


def initial_sd(settings: FilterSettings, imu: ImuErrors, delay: DelayModel) -> Array:
    """Standard deviations of the error state, shape (n,), before the first fix."""
    sd = np.zeros(n_states(settings))
    sd[LEVER] = settings.lever_arm_sd_m
    sd[POSITION] = DIFFUSE_POSITION_M
    sd[VELOCITY] = DIFFUSE_VELOCITY_MPS
    sd[MISALIGN] = np.array([settings.level_sd_deg, settings.level_sd_deg, settings.heading_sd_deg]) * DEG
    sd[ACCEL] = np.hypot(imu.accel_bias_ug, imu.accel_bias_instability_ug) * MICRO_G
    sd[GYRO] = np.hypot(imu.gyro_bias_deg_h, imu.gyro_bias_instability_deg_h) * DEG_PER_HOUR
    if delay is DelayModel.ESTIMATED:
        sd[DELAY] = settings.delay_mean_sd_ms * MILLISECOND
    return sd


def align(
    time: ArrayLike,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    q_nb_coarse: ArrayLike,
    fixes: Fixes,
    delay: DelayModel,
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
) -> Estimate:
    """Align over one record, as it would happen: a fix counts from its arrival on.

    Parameters
    ----------
    time : (n,) s, increasing. dtheta_b, dv_b : (n, 3) rad and m/s over the interval that ends at ``time``.
    q_nb_coarse : (4,) attitude at ``time[0]``, wrong by the initial misalignment.
    fixes : in any order; taken by arrival. The first one starts position and velocity; after
        ``restart_after_gated`` refused ones in a row the next one does so again, with the attitude of then
        and the uncertainty of the start.
    delay : how to treat delays. imu : error budget that the filter is told. gravity : model to navigate with.

    Returns
    -------
    Estimate at ``output_rate_hz`` and at the end. Samples and fixes that are not finite never enter the
    state: such a sample is replaced, at a cost to the covariance, such a fix is left out; both are counted.

    Raises ValueError for arrays that do not make up a record (`mechanization.checked_record`) or an
    attitude that is no unit quaternion.
    """
    problem = pose(time, dtheta_b, dv_b, q_nb_coarse, fixes, delay, settings, imu, gravity)
    horizon = round(settings.horizon_s / problem.dt)
    return run(problem, horizon, kept=horizon + 1 if delay is DelayModel.STAMPED else 1)[0]


class Problem(NamedTuple):
    """A record and fixes, checked, and what the compiled loops take of the settings."""

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
    samples: int
    """Intervals over which specific force and rate are averaged."""
    gravity: int
    output_epoch: Integers
    held: int

    @property
    def dt(self) -> float:
        """Mean interval, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


def pose(
    time: ArrayLike,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    q_nb_coarse: ArrayLike,
    fixes: Fixes,
    delay: DelayModel,
    settings: FilterSettings,
    imu: ImuErrors,
    gravity: GravityModel,
) -> Problem:
    """Check what `align` is given; parameters and errors are those of `align`."""
    time, dtheta_b, dv_b = checked_record(time, dtheta_b, dv_b)
    q_nb_coarse = np.array(q_nb_coarse, float)
    if q_nb_coarse.shape != (4,) or not abs(np.linalg.norm(q_nb_coarse) - 1) < 1e-6:
        raise ValueError(f"q_nb_coarse must be a unit quaternion, not {q_nb_coarse}")
    n = len(time)
    dt = (time[-1] - time[0]) / (n - 1)
    stamped, estimated = delay is DelayModel.STAMPED, delay is DelayModel.ESTIMATED
    delay_sd_ms = settings.stamp_sd_ms * stamped + settings.delay_sd_ms * estimated
    increments, gap_variance, held = finite_increments(np.hstack([dtheta_b, dv_b]), dt)
    outcome, reception = received(
        time, fixes.sorted_by_arrival(), stamped, settings.stamp_sd_ms * MILLISECOND
    )
    every = max(1, round(1 / (settings.output_rate_hz * dt)))
    initial = np.zeros(10)
    initial[6] = settings.delay_mean_ms * MILLISECOND if estimated else 0.0
    initial[7:] = settings.lever_arm_b_m
    sd = initial_sd(settings, imu, delay)
    return Problem(
        time=time,
        increments=increments,
        gap_variance=gap_variance,
        q_nb_coarse=q_nb_coarse,
        reception=reception,
        outcome=outcome,
        delay=delay,
        delay_sd=delay_sd_ms * MILLISECOND,
        initial=initial,
        initial_sd=sd,
        noise_density=np.pad(noise_density(imu), (0, len(sd) - N_STATES)),
        vibration_variance=imu.vibration_mps**2,
        gate=_gate(settings.gate_probability),
        patience=settings.restart_after_gated,
        samples=max(1, round(settings.acceleration_window_s / dt)),
        gravity=int(gravity),
        output_epoch=np.unique(np.append(np.arange(every, n, every), n - 1)),
        held=held,
    )


def run(problem: Problem, horizon: int, kept: int) -> tuple[Estimate, tuple[Array, Array]]:
    """Run the filter; also state (kept, 21) and covariance (kept, n, n) of the last ``kept`` epochs, each
    before its fixes, at the epoch's number modulo ``kept``."""
    outputs = _outputs(problem)
    memory = _alignment_kernel.working_memory(len(problem.outcome), kept, len(problem.initial_sd))
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
        horizon,
        problem.samples,
        problem.gravity,
        problem.output_epoch,
        outputs,
        memory,
    )
    ending = RunOutcome.ALIGNED if finite_to_the_end else RunOutcome.NOT_FINITE
    return _estimate(problem, outputs, ending if started else RunOutcome.NO_FIX), memory[2:4]


def unaligned(problem: Problem, outcome: RunOutcome) -> Estimate:
    """What is known where no filter ran: nothing."""
    return _estimate(problem, _outputs(problem), outcome)


def _outputs(problem: Problem) -> tuple[Array, ...]:
    m, k, states = len(problem.output_epoch), len(problem.outcome), len(problem.initial_sd)
    shapes = ((m, 21), (m, states), (m, 3, 3), (k, 6), (k,), (k,))
    return tuple(np.full(shape, np.nan) for shape in shapes)


def _estimate(problem: Problem, outputs: tuple[Array, ...], outcome: RunOutcome) -> Estimate:
    X, variance, misalignment_cov, innovation, nis, fix_time = outputs
    return Estimate(
        time=problem.time[problem.output_epoch],
        **state_columns(X),
        sd=np.sqrt(variance),
        misalignment_cov=misalignment_cov,
        innovation=innovation,
        nis=nis,
        fix_time=fix_time,
        fix_outcome=problem.outcome,
        held_imu_samples=problem.held,
        outcome=outcome,
    )


def state_columns(X: Array) -> dict[str, Array]:
    """The fields of an `Estimate` that a state vector, (m, 21), holds."""
    return {
        "lla": X[:, 0:3],
        "v_n": X[:, 3:6],
        "q_nb": X[:, 6:10],
        "accel_bias": X[:, 10:13],
        "gyro_bias": X[:, 13:16],
        "delay": X[:, 16],
        "lever_arm_b": X[:, 17:20],
    }


@cache
def _gate(probability: float) -> float:
    """Largest NIS of a fix that passes; cached, since the quantile costs as much as a hundred samples."""
    return float(chi_square_quantile(probability, 6))
