"""The paper's own model: ten error states of a strapdown INS at a frozen point of a flight, as eq. (10).

States of Gao et al., section 4: errors of position (3, here m, NED), velocity (3, m/s, NED) and attitude
quaternion (4). To first order the additive error of the quaternion is

    q_computed - q = q nu - U phi / 2,      U = columns of (0, e_i) q

with phi the misalignment of `sins.error_model` and nu the error of the norm. [q, U] is orthogonal: the ten
states are the nine of the error model and nu in other axes, and no gain depends on which one takes. nu is
zero after each step of a navigator that normalises; without that nothing would see it, nor would it fade.

The paper's disturbance w is the six sensor errors. With it alone the problem is not well posed. Added are

* errors of the fix, six more components of w, in D. Without them a fix would be the truth.
* the correction of the navigator by what the filter finds (`design.Kind.FEEDBACK`). Errors of position and
  velocity are integrals, and that of the sink rate even grows with that of the height: A is not Schur stable,
  and no filter of eq. (11) beside the navigator makes the whole so. Nor would a late output of an error that
  grows be small.
* a leak in the attitude, and three more components of w that drive it to a stated deviation. No fix shows a
  turn about the specific force, which in level flight is the heading, but through the turn of the earth and
  over hours; and over an infinite horizon the initial misalignment is forgotten, so that with the sensor
  errors of a navigation grade the filter would hold its attitude for known. The deviation is a prior made
  stationary. It sets the filter's bandwidth, and is a choice.
"""

import numpy as np
from pydantic import Field
from scipy.linalg import expm

from ...sins import attitude
from ...sins.error_model import MISALIGN, POSITION, VELOCITY, system_matrix
from ...sins.settings import Settings
from ...sins.units import DEG, DEG_PER_HOUR, MICRO_G
from .lmmse import predicted
from .plant import Array, Plant

GRAVITY_MPS2 = 9.80665
N_STATES = 10
QUATERNION = slice(6, 10)


class SinsPlantSettings(Settings):
    """What the designs of the paper's filter are told: flight, fixes, sensors, what makes them well posed."""

    speed_mps: float = Field(default=200.0, ge=0, le=1000)
    latitude_deg: float = Field(default=30.0, ge=-85, le=85)
    altitude_m: float = Field(default=1015.0, ge=-500, le=30_000)
    fix_interval_s: float = Field(default=0.1, gt=0, le=10)
    position_sd_m: float = Field(default=10.0, gt=0, le=1e4)
    velocity_sd_mps: float = Field(default=0.1, gt=0, le=100)
    rho: float = Field(default=0.75, gt=0, le=1)
    """Share of prompt fixes, in intervals: 0.75 is a mean delay of 25 ms at 10 Hz."""
    gyro_sd_deg_h: float = Field(default=0.02, gt=0, le=1e4)
    accel_sd_ug: float = Field(default=100.0, gt=0, le=1e6)
    """Sensor errors, held over an interval: w counts in these."""
    attitude_leak_s: float = Field(default=300.0, gt=0, le=10_000)
    level_sd_deg: float = Field(default=0.23, gt=0, le=30)
    heading_sd_deg: float = Field(default=0.55, gt=0, le=60)
    """Deviations that the attitude errors are driven to."""


def quaternion_axes(q_nb: Array) -> Array:
    """[q, U], shape (4, 4), orthogonal: what nu and -phi / 2 make of the quaternion."""
    basis = np.hstack([np.zeros((3, 1)), np.eye(3)])
    return np.column_stack([q_nb, *[attitude.multiply(axis, q_nb) for axis in basis]])


def misalignment_of(q_nb: Array) -> Array:
    """(3, 4), phi of the additive error of the quaternion."""
    return -2 * quaternion_axes(q_nb)[:, 1:].T


def level_attitude(side_mps2: float) -> Array:
    """(4,) of a coordinated turn to the right with this side force, m/s^2, on a northern course."""
    return attitude.from_euler(np.arctan2(side_mps2, GRAVITY_MPS2), 0.0, 0.0)


def sins_plant(settings: SinsPlantSettings, side_mps2: float = 0.0) -> Plant:
    """The ten states in steady flight or a steady turn, on a northern course, from fix to fix.

    x is the error after the correction by a fix; y is what the next fix shows of it, position and velocity,
    so that the gain of `Kind.FEEDBACK` is what corrects the navigator. z is the errors of position, velocity
    and misalignment (9), each in units of the deviation that the Kalman filter leaves if nothing is late. In
    these gamma is of size one for every plant: it has no meaning without the units of w and z.

    Components of w: gyros (3), accelerometers (3), position (3) and velocity (3) of the fix, attitude (3).
    """
    T, q_nb = settings.fix_interval_s, level_attitude(side_mps2)
    lla = np.array([settings.latitude_deg * DEG, 0.0, settings.altitude_m])
    v_n, f_n = np.array([settings.speed_mps, 0.0, 0.0]), np.array([0.0, side_mps2, -GRAVITY_MPS2])
    C_nb = attitude.to_dcm(q_nb)
    F = system_matrix(lla, v_n, f_n, C_nb)[:9, :9]
    F[MISALIGN, MISALIGN] -= np.eye(3) / settings.attitude_leak_s
    driven = np.array([settings.level_sd_deg, settings.level_sd_deg, settings.heading_sd_deg]) * DEG

    A9, B9 = expm(F * T), np.zeros((9, 15))
    B9[MISALIGN, 0:3] = -C_nb * settings.gyro_sd_deg_h * DEG_PER_HOUR * T
    B9[VELOCITY, 3:6] = C_nb * settings.accel_sd_ug * MICRO_G * T
    B9[MISALIGN, 12:15] = np.diag(driven * np.sqrt(-np.expm1(-2 * T / settings.attitude_leak_s)))
    D = np.zeros((6, 15))
    D[POSITION, 6:9] = settings.position_sd_m * np.eye(3)
    D[VELOCITY, 9:12] = settings.velocity_sd_mps * np.eye(3)

    # From the nine to the ten and back. nu is not driven and does not last.
    into, back = np.zeros((N_STATES, 9)), nine_of_ten(q_nb)
    into[:6, :6] = np.eye(6)
    into[QUATERNION, MISALIGN] = -quaternion_axes(q_nb)[:, 1:] / 2
    A, B, C = into @ A9 @ back, into @ B9, np.eye(6, N_STATES)
    P, _ = predicted(A, B, C @ A, C @ B + D, (C @ B + D) @ (C @ B + D).T)
    deviation = np.sqrt(np.einsum("ij,jk,ik->i", back, P, back))
    return Plant(A, B, C @ A, C @ B + D, back / deviation[:, None], settings.rho)


def nine_of_ten(q_nb: Array) -> Array:
    """(9, 10), position, velocity and misalignment of the ten states."""
    back = np.zeros((9, N_STATES))
    back[:6, :6] = np.eye(6)
    back[MISALIGN, QUATERNION] = misalignment_of(q_nb)
    return back
