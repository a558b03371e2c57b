"""What the designs of the paper's filter are made for, from what is given to align on.

All of it stands for what is known before a flight: the noise that fixes will have, and how steep the
manoeuvre will be. It is taken from the record, which holds the same. Figures are rounded to two digits: the
gains feel no more, and designs, which are kept, serve many records.
"""

import numpy as np
from numpy.typing import ArrayLike

from ...network.fixes import Fixes
from ...sins.imu import ImuErrors
from ...sins.units import MILLISECOND
from ..estimate import Array
from ..settings import FilterSettings
from .sins_plant import GRAVITY_MPS2, SinsPlantSettings

STEEPEST = 0.95
"""Quantile of the force to the side, over a record, that the steep vertex stands for."""


def sins_plant_settings(
    fixes: Fixes, settings: FilterSettings, imu: ImuErrors, side_mps2: float = 0.0
) -> SinsPlantSettings:
    """Noise and rate of the fixes, delay and sensor errors as the filters are told them; flight as by
    default.

    Raises ValueError (pydantic's) for figures that no design is made for.
    """
    finite = fixes[np.flatnonzero(np.isfinite(fixes.cov).all(axis=(1, 2)))]
    variance = np.median(np.einsum("kii->ki", finite.cov), axis=0) if len(finite) else np.ones(6)
    intervals = np.diff(np.unique(finite.t_valid))
    interval = float(np.median(intervals)) if len(intervals) else 0.1
    prompt = np.clip(1 - settings.delay_mean_ms * MILLISECOND / interval, 0.05, 1.0)
    late = np.hypot(settings.delay_mean_ms, settings.delay_sd_ms) * MILLISECOND * side_mps2 / np.sqrt(2)
    return SinsPlantSettings(
        fix_interval_s=_two_digits(interval),
        position_sd_m=_two_digits(np.sqrt(variance[:3].mean())),
        velocity_sd_mps=_two_digits(np.hypot(np.sqrt(variance[3:].mean()), late)),
        rho=_two_digits(prompt),
        gyro_sd_deg_h=_two_digits(np.hypot(imu.gyro_bias_deg_h, imu.gyro_bias_instability_deg_h)),
        accel_sd_ug=_two_digits(np.hypot(imu.accel_bias_ug, imu.accel_bias_instability_ug)),
    )


def steepest_side_mps2(time: ArrayLike, dv_b: ArrayLike, fixed_s: float = 1.0) -> float | None:
    """Force to the side in the steep turns of a record, m/s^2; None where there are none.

    In a coordinated turn the specific force is that of gravity and of the turn, whatever the bank. It is
    averaged over ``fixed_s``.
    """
    time, dv_b = np.asarray(time, float), np.asarray(dv_b, float)
    samples = max(1, round(fixed_s * (len(time) - 1) / (time[-1] - time[0])))
    force: Array = np.add.reduceat(np.nan_to_num(dv_b[1:]), np.arange(0, len(dv_b) - 1, samples), axis=0)
    square = np.sum((force[:-1] / (samples * (time[-1] - time[0]) / (len(time) - 1))) ** 2, axis=1)
    side = np.sqrt(np.maximum(square - GRAVITY_MPS2**2, 0.0))
    steep = _two_digits(float(np.quantile(side, STEEPEST))) if len(side) else 0.0
    return steep if steep >= 1.0 else None


def _two_digits(value: float) -> float:
    return float(f"{value:.1e}")
