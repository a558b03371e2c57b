"""What alignment filters are told: settings, how to treat a delay, noise and uncertainty of the start."""

from enum import IntEnum
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..sins.error_model import ACCEL, GYRO, MISALIGN, POSITION, VELOCITY
from ..sins.imu import ImuErrors
from ..sins.settings import Settings
from ..sins.units import (
    DEG,
    DEG_PER_HOUR,
    DEG_PER_SQRT_HOUR,
    MICRO_G,
    MICRO_G_PER_SQRT_HZ,
    MILLISECOND,
)
from . import _kernels
from .estimate import Array
from .measurement import DELAY, LEVER, N_STATES

DIFFUSE_POSITION_M = 1e3
DIFFUSE_VELOCITY_MPS = 1e2
"""Least standard deviations before the first fix; at any rate 100 times the fix's own: it alone decides."""


class DelayModel(IntEnum):
    """How a filter treats the delay of a fix."""

    IGNORED = _kernels.IGNORED
    STAMPED = _kernels.STAMPED
    ESTIMATED = _kernels.ESTIMATED


class Transform(IntEnum):
    """How a filter carries a covariance through what is not linear."""

    DERIVATIVES = 0
    """By the derivatives at the estimate: the extended Kalman filter."""
    CUBATURE = 1
    """By points around the estimate, a pair along each axis of the covariance: the cubature Kalman filter."""
    SQUARE_ROOT = 2
    """The same on square roots of the covariance, which cannot cease to be one."""


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
    """So many fixes refused in a row mean that the filter is wrong and not the fixes: it starts again from
    the next, though not within `dead_reckoning_after_s` of one that it took after its start. The status says
    dead reckoning before, or in the row of the restart where outputs are rarer than fixes."""
    dead_reckoning_after_s: float = Field(default=3.0, ge=0.1, le=60)
    """Time without a fix that was taken, after which the status says so."""
    imu_patience_s: float = Field(default=1.0, ge=0.01, le=60)
    """Time for which samples of the IMU may be held, less that of good samples since: after more of it a run
    ends. What is lost of the heading in longer is too much for derivatives, and the covariance too small."""
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
