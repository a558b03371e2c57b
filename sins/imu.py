"""Inertial measurement unit: its errors as settings, and increments that carry them.

The errors act in the order of the hardware:

1. vibration moves the accelerometers: the velocity jitter ``u_k`` adds ``u_k - u_(k-1)`` to ``dv_b``;
2. scale factor and misalignment of the axes, ``(I + M)``, and the gyros' response to specific force;
3. bias: constant and Gauss-Markov parts;
4. white noise of a given root PSD;
5. quantisation.

References
----------
.. [1] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation
       Systems", 2nd ed., section 4.4.
.. [2] IEEE Std 952-1997, annexes B and C.
.. [3] C. Gao, J. Lu, G. Zhao, S. Pan, "A Localization and In-flight Alignment Protocol for Airborne
       SINS Based on Flight-vehicle Wireless Sensor Networks", Table 1.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from ._imu_kernel import add_errors
from .settings import Settings
from .streams import Streams
from .units import (
    ARCSEC,
    DEG_PER_HOUR,
    DEG_PER_HOUR_PER_G,
    DEG_PER_SQRT_HOUR,
    MICRO_G,
    MICRO_G_PER_SQRT_HZ,
    PPM,
)

Array = NDArray[np.float64]

# One child generator each, in this order: a new source joins at the end, so that old draws stay.
_SOURCES = (
    "gyro_bias",
    "accel_bias",
    "gyro_noise",
    "accel_noise",
    "vibration",
    "gyro_bias_variation",
    "accel_bias_variation",
    "gyro_scale_factor",
    "accel_scale_factor",
    "gyro_misalignment",
    "accel_misalignment",
    "gyro_g_sensitivity",
)


class ImuError(ValueError):
    """Increments that cannot be simulated: wrong shapes or an uneven interval."""


class ImuErrors(Settings):
    """Error budget of an IMU; the defaults are those of [3]_, and zero for what it does not state.

    What is constant during a run is drawn once a run and axis: Gaussian with the stated value as
    standard deviation. [3]_ gives "constant deviations" and no sign; a Gaussian of that size makes
    a filter's prior exact, and so its consistency (NEES) testable. ``bias_draw`` changes this for
    the constant biases alone: ``"random_sign"`` takes the stated magnitude with a fair sign for each
    axis, ``"constant"`` the stated value on all axes.
    """

    gyro_bias_deg_h: float = Field(default=0.02, ge=0, le=1e4)
    accel_bias_ug: float = Field(default=100.0, ge=0, le=1e6)
    bias_draw: Literal["gaussian", "random_sign", "constant"] = "gaussian"

    gyro_arw_deg_sqrt_h: float = Field(default=0.01, ge=0, le=100)
    """Angular random walk: root PSD of the gyros' white noise (two-sided, [1]_ 4.4.3)."""
    accel_vrw_ug_sqrt_hz: float = Field(default=5.0, ge=0, le=1e5)
    """Velocity random walk: root PSD of the accelerometers' white noise (two-sided)."""
    vibration_mps: float = Field(default=0.01, ge=0, le=10)
    """RMS of a white jitter of the vehicle's velocity, each axis, which the accelerometers sense.
    It is a velocity, so the sum of its increments is the present jitter: it does not accumulate."""

    gyro_scale_factor_ppm: float = Field(default=0.0, ge=0, le=1e5)
    accel_scale_factor_ppm: float = Field(default=0.0, ge=0, le=1e5)
    gyro_misalignment_arcsec: float = Field(default=0.0, ge=0, le=36000)
    """Coupling of each gyro with either of the two axes across it (six independent angles)."""
    accel_misalignment_arcsec: float = Field(default=0.0, ge=0, le=36000)
    gyro_g_sensitivity_deg_h_g: float = Field(default=0.0, ge=0, le=1e4)
    """Gyro bias for specific force; nine independent coefficients."""

    gyro_bias_instability_deg_h: float = Field(default=0.0, ge=0, le=1e4)
    """Standard deviation of a stationary first-order Gauss-Markov bias. Its Allan deviation is
    greatest, 0.617 times this, at 1.89 correlation times ([2]_)."""
    gyro_bias_correlation_s: float = Field(default=600.0, ge=0.1, le=1e7)
    accel_bias_instability_ug: float = Field(default=0.0, ge=0, le=1e6)
    """As `gyro_bias_instability_deg_h`, for the accelerometers."""
    accel_bias_correlation_s: float = Field(default=600.0, ge=0.1, le=1e7)

    gyro_full_scale_deg_s: float = Field(default=1000.0, gt=0, le=1e5)
    """The greatest rate that the unit measures: a sample beyond is no measurement. What a unit of less range
    does at its end is a fault (`imu_faults.SaturatedFault`), and not simulated here."""
    accel_full_scale_g: float = Field(default=40.0, gt=0, le=1e5)
    """As `gyro_full_scale_deg_s`, of the specific force."""

    gyro_quantum_arcsec: float = Field(default=0.0, ge=0, le=3600)
    """Angle of one count; the remainder is carried into the next sample, as in a counter."""
    accel_quantum_mps: float = Field(default=0.0, ge=0, le=10)
    """Velocity of one count."""


@dataclass(frozen=True)
class DrawnImuErrors:
    """The errors that one run has drawn, SI and radians. Absent time histories are None."""

    gyro_bias: Array
    """Constant bias, rad/s, shape (3,)."""
    accel_bias: Array
    """Constant bias, m/s^2, shape (3,)."""
    gyro_bias_variation: Array | None
    """Gauss-Markov bias, rad/s, shape (n, 3)."""
    accel_bias_variation: Array | None
    """Gauss-Markov bias, m/s^2, shape (n, 3)."""
    gyro_coupling: Array
    """``M`` of the gyros, shape (3, 3): scale factors on the diagonal, misalignment beside it."""
    accel_coupling: Array
    """``M`` of the accelerometers, shape (3, 3)."""
    gyro_g_sensitivity: Array
    """Angular rate for specific force, rad s/m, shape (3, 3)."""
    vibration: Array | None
    """Velocity jitter, m/s, shape (n, 3), zero at the first row."""


@dataclass(frozen=True)
class Imu:
    """What the IMU puts out: increments over the intervals that end at ``time``, resolved in b.

    ``time`` (n,), s; ``dtheta_b`` (n, 3), rad; ``dv_b`` (n, 3), m/s; row 0 has no interval and is zero.
    """

    time: Array
    dtheta_b: Array
    dv_b: Array
    errors: DrawnImuErrors

    @property
    def gyro_bias(self) -> Array:
        """True bias of the gyros, constant and varying parts, rad/s, shape (n, 3)."""
        return self._history(self.errors.gyro_bias, self.errors.gyro_bias_variation)

    @property
    def accel_bias(self) -> Array:
        """True bias of the accelerometers, constant and varying parts, m/s^2, shape (n, 3)."""
        return self._history(self.errors.accel_bias, self.errors.accel_bias_variation)

    def _history(self, constant: Array, variation: Array | None) -> Array:
        return np.tile(constant, (len(self.time), 1)) if variation is None else constant + variation


def simulate_imu(
    time: ArrayLike, dtheta_b: ArrayLike, dv_b: ArrayLike, errors: ImuErrors, rng: Generator | SeedSequence
) -> Imu:
    """Increments as an IMU with the given errors measures them.

    Parameters: ``time`` (n,), s, evenly spaced; ideal increments ``dtheta_b`` (n, 3), rad, and
    ``dv_b`` (n, 3), m/s, whose row 0 is not used. ``rng`` is spawned once for each source of error,
    whether or not it is at work: switching one on leaves the draws of all others as they were.

    Raises `ImuError` for wrong shapes or an uneven ``time``.
    """
    time = np.array(time, float)
    dtheta, dv = np.ascontiguousarray(dtheta_b, float), np.ascontiguousarray(dv_b, float)
    dt = _interval(time, dtheta, dv)
    n = len(time)
    rngs = Streams(rng, _SOURCES)
    drawn = _draw(n, dt, errors, rngs)

    nothing = np.empty((0, 3))
    jitter = nothing if drawn.vibration is None else drawn.vibration
    if drawn.gyro_coupling.any() or drawn.gyro_g_sensitivity.any() or drawn.accel_coupling.any():
        dv = dv + np.diff(jitter, axis=0, prepend=0.0) if len(jitter) else dv
        jitter = nothing
        dtheta = dtheta + (dtheta @ drawn.gyro_coupling.T + dv @ drawn.gyro_g_sensitivity.T)
        dv = dv + dv @ drawn.accel_coupling.T
    measured: list[Array] = []
    for ideal, moved, constant, variation, root_psd, quantum, source in (
        (
            *(dtheta, nothing, drawn.gyro_bias, drawn.gyro_bias_variation),
            *(errors.gyro_arw_deg_sqrt_h * DEG_PER_SQRT_HOUR, errors.gyro_quantum_arcsec * ARCSEC, "gyro"),
        ),
        (
            *(dv, jitter, drawn.accel_bias, drawn.accel_bias_variation),
            *(errors.accel_vrw_ug_sqrt_hz * MICRO_G_PER_SQRT_HZ, errors.accel_quantum_mps, "accel"),
        ),
    ):
        bias = dt * constant
        if variation is not None:
            if len(moved):
                ideal, moved = ideal + np.diff(moved, axis=0, prepend=0.0), nothing
            ideal, bias = ideal + dt * (constant + variation), np.zeros(3)
        normal = rngs[f"{source}_noise"].standard_normal((n, 3)) if root_psd > 0 else nothing
        increments = np.empty((n, 3))
        add_errors(ideal, moved, bias, root_psd * np.sqrt(dt), normal, increments)
        if quantum > 0:
            increments[1:] = np.diff(quantum * np.round(np.cumsum(increments, axis=0) / quantum), axis=0)
        measured.append(increments)
    dtheta, dv = measured
    return Imu(time, dtheta, dv, drawn)


def _interval(time: Array, dtheta_b: Array, dv_b: Array) -> float:
    """The one interval between the samples, s; raises `ImuError` where there is none."""
    n = len(time) if time.ndim == 1 else 0
    if n < 2 or dtheta_b.shape != (n, 3) or dv_b.shape != (n, 3):
        raise ImuError(
            f"increments need time (n,), dtheta_b (n, 3), dv_b (n, 3) with n >= 2; "
            f"got {time.shape}, {dtheta_b.shape}, {dv_b.shape}"
        )
    dt = (time[-1] - time[0]) / (n - 1)
    uneven = np.abs(np.diff(time) - dt)
    # Negated, so that a time that is not a number is refused as well.
    if not (dt > 0 and uneven.max() < 1e-3 * dt):
        row = int(np.argmax(uneven)) + 1
        raise ImuError(f"IMU samples must be {dt:.6g} s apart throughout; row {row} is at {time[row]:.6f} s")
    return float(dt)


def _draw(n: int, dt: float, errors: ImuErrors, rngs: Streams) -> DrawnImuErrors:
    """Draw what is constant in a run and the time histories of bias and vibration."""
    vibration = None
    if errors.vibration_mps > 0:
        vibration = rngs["vibration"].standard_normal((n, 3))
        vibration *= errors.vibration_mps
        vibration[0] = 0.0
    return DrawnImuErrors(
        gyro_bias=_constant_bias(errors.gyro_bias_deg_h * DEG_PER_HOUR, errors, rngs["gyro_bias"]),
        accel_bias=_constant_bias(errors.accel_bias_ug * MICRO_G, errors, rngs["accel_bias"]),
        gyro_bias_variation=_gauss_markov(
            errors.gyro_bias_instability_deg_h * DEG_PER_HOUR,
            dt / errors.gyro_bias_correlation_s,
            n,
            rngs,
            "gyro_bias_variation",
        ),
        accel_bias_variation=_gauss_markov(
            errors.accel_bias_instability_ug * MICRO_G,
            dt / errors.accel_bias_correlation_s,
            n,
            rngs,
            "accel_bias_variation",
        ),
        gyro_coupling=_coupling(errors.gyro_scale_factor_ppm, errors.gyro_misalignment_arcsec, "gyro", rngs),
        accel_coupling=_coupling(
            errors.accel_scale_factor_ppm, errors.accel_misalignment_arcsec, "accel", rngs
        ),
        gyro_g_sensitivity=_normal(
            errors.gyro_g_sensitivity_deg_h_g * DEG_PER_HOUR_PER_G, (3, 3), rngs, "gyro_g_sensitivity"
        ),
        vibration=vibration,
    )


def _constant_bias(size: float, errors: ImuErrors, rng: Generator) -> Array:
    normal = rng.standard_normal(3)
    match errors.bias_draw:
        case "gaussian":
            return size * normal
        case "random_sign":
            return size * np.sign(normal)
        case "constant":
            return np.full(3, size)


def _coupling(scale_factor_ppm: float, misalignment_arcsec: float, sensor: str, rngs: Streams) -> Array:
    scale_factor = _normal(scale_factor_ppm * PPM, (3,), rngs, f"{sensor}_scale_factor")
    misalignment = _normal(misalignment_arcsec * ARCSEC, (3, 3), rngs, f"{sensor}_misalignment")
    np.fill_diagonal(misalignment, scale_factor)
    return misalignment


def _normal(sd: float, shape: tuple[int, ...], rngs: Streams, source: str) -> Array:
    return sd * rngs[source].standard_normal(shape) if sd > 0 else np.zeros(shape)


def _gauss_markov(
    sigma: float, dt_over_correlation: float, n: int, rngs: Streams, source: str
) -> Array | None:
    """Stationary first-order Gauss-Markov process, sampled exactly, shape (n, 3); None for no process."""
    if sigma == 0:
        return None
    from scipy.signal import lfilter  # takes a second to import

    drive = rngs[source].standard_normal((n, 3))
    drive[0] *= sigma
    drive[1:] *= sigma * np.sqrt(-np.expm1(-2 * dt_over_correlation))
    return np.asarray(lfilter([1.0], [1.0, -np.exp(-dt_over_correlation)], drive, axis=0))
