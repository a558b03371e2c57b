"""A fix as a measurement of the error state: innovation, H, R, and the Joseph-form update.

A fix is of the antenna, at the lever arm ``l`` from the IMU: its position is that of the IMU and ``C_nb l``,
its velocity that of the IMU and ``C_nb (w x l)``. A fix that was valid ``age`` ago is compared with where the
navigator says the antenna was then: with its velocity and acceleration ``u`` the prediction is that of now
less ``age u``. Its error is

    dp + [C_nb l x] phi - age dv + C_nb dl,
    dv + [C_nb (w x l) x] phi - C_nb [l x] bg + C_nb [w x] dl - age ([f_n x] phi + C_nb ba),

and -u (delay error) if the age is estimated. The random part of the age, of standard deviation ``delay_sd``,
adds ``delay_sd^2 u u'`` to R: position and velocity jointly.

These functions are the readable twins of the compiled ones in `align._kernels`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..sins import attitude, earth
from ..sins.attitude import skew
from ..sins.earth import GravityModel
from ..sins.error_model import ACCEL, GYRO, MISALIGN, POSITION, VELOCITY
from ..sins.mechanization import NavigationState

Array = NDArray[np.float64]

DELAY = 15
"""Index of the delay's error behind the states of `sins.error_model`."""
N_STATES = 16
LEVER = slice(16, 19)
"""The lever arm's error, m, body, where it is estimated."""


class Motion(NamedTuple):
    """What a late fix depends on besides the state."""

    u: Array
    """(6,) velocity and acceleration of the antenna, NED."""
    f_n: Array
    """(3,) specific force at the IMU, NED, m/s^2."""
    w_b: Array
    """(3,) rate of b against n, rad/s, in b."""
    lever_arm_b: Array
    """(3,) from the IMU to the antenna, m, in b."""


class Measurement(NamedTuple):
    """Innovation (6,), predicted minus received; measurement matrix H (6, 19); noise covariance R (6, 6)."""

    innovation: Array
    H: Array
    R: Array


def kinematics(
    state: NavigationState, f_b: Array, w_ib_b: Array, lever_arm_b: Array, gravity: GravityModel
) -> Motion:
    """The motion of the antenna.

    ``f_b``, shape (3,), is the specific force in b, m/s^2, averaged over vibration; ``w_ib_b``, shape (3,),
    the rate against inertial space, rad/s, of now. What an angular acceleration does to the antenna's
    acceleration is left out.
    """
    lat, _, height = state.lla
    C_nb = attitude.to_dcm(state.q_nb)
    f_n = C_nb @ f_b
    g_north, g_down = earth.gravity(gravity, lat, height)
    w_ie = np.array(earth.earth_rate_n(lat))
    w_en = np.array(earth.transport_rate_n(lat, height, state.v_n[0], state.v_n[1]))
    a_n = f_n + np.array([g_north, 0.0, g_down]) - np.cross(2 * w_ie + w_en, state.v_n)
    w_b = w_ib_b - C_nb.T @ (w_ie + w_en)
    v_arm = np.cross(w_b, lever_arm_b)
    u = np.concatenate([state.v_n + C_nb @ v_arm, a_n + C_nb @ np.cross(w_b, v_arm)])
    return Motion(u, f_n, w_b, lever_arm_b)


def measure(
    state: NavigationState,
    fix_lla: Array,
    fix_v_n: Array,
    fix_cov: Array,
    vibration_variance: float,
    age: float,
    delay_sd: float,
    estimated: bool,
    motion: Motion,
) -> Measurement:
    """Compare a fix, valid ``age`` seconds ago, with the navigation state of now.

    Parameters: ``fix_lla`` (3,), ``fix_v_n`` (3,), ``fix_cov`` (6, 6) in m and m/s, NED;
    ``vibration_variance``, (m/s)^2; ``delay_sd``, s; ``estimated``, whether the age rests on the delay
    state; ``motion`` from `kinematics`.
    """
    u, f_n, w_b, lever_arm_b = motion
    C_nb = attitude.to_dcm(state.q_nb)
    arm, v_arm = C_nb @ lever_arm_b, C_nb @ np.cross(w_b, lever_arm_b)
    # Metres per radian are those of the navigated position, as in the error state.
    p_error = -earth.displacement_n(fix_lla, state.lla)
    navigated = np.concatenate([p_error + arm, state.v_n + v_arm - fix_v_n])

    H = np.zeros((6, LEVER.stop))
    H[:3, POSITION] = np.eye(3)
    H[:3, VELOCITY] = -age * np.eye(3)
    H[:3, MISALIGN] = skew(arm)
    H[:3, LEVER] = C_nb
    H[3:, VELOCITY] = np.eye(3)
    H[3:, MISALIGN] = skew(v_arm) - age * skew(f_n)
    H[3:, ACCEL] = -age * C_nb
    H[3:, GYRO] = -C_nb @ skew(lever_arm_b)
    H[3:, LEVER] = C_nb @ skew(w_b)
    if estimated:
        H[:, DELAY] = -u
    R = fix_cov + delay_sd**2 * np.outer(u, u)
    R[3:, 3:] += vibration_variance * np.eye(3)
    return Measurement(navigated - age * u, H, R)
