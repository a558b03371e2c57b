"""A fix as a measurement of the error state: innovation, H, R, and the Joseph-form update.

A fix that was valid ``age`` ago is compared with where the navigator says the vehicle was then:
with velocity and acceleration ``u = [v_n; a_n]`` the prediction is ``[p; v] - age u``. Its error is

    dp - age dv,    dv - age ([f_n x] phi + C_nb ba),    and -u (delay error) if the age is estimated,

and the random part of the age, of standard deviation ``delay_sd``, adds ``delay_sd^2 u u'`` to R:
position and velocity jointly.

These functions are the readable twins of the compiled ones in `align._kernels`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..sins import attitude, earth
from ..sins.earth import GravityModel
from ..sins.error_model import ACCEL, MISALIGN, POSITION, VELOCITY
from ..sins.mechanization import NavigationState

Array = NDArray[np.float64]

DELAY = 15
"""Index of the delay's error behind the states of `sins.error_model`."""
N_STATES = 16


class Measurement(NamedTuple):
    """Innovation (6,), predicted minus received; measurement matrix H (6, 16); noise covariance R (6, 6)."""

    innovation: Array
    H: Array
    R: Array


def kinematics(state: NavigationState, f_b: Array, gravity: GravityModel) -> tuple[Array, Array]:
    """Velocity and acceleration ``u``, shape (6,), and the specific force ``f_n``, shape (3,), both in n.

    ``f_b``, shape (3,), is the specific force in b, m/s^2, averaged over vibration.
    """
    lat, _, height = state.lla
    f_n = attitude.rotate(state.q_nb, f_b)
    g_north, g_down = earth.gravity(gravity, lat, height)
    w_ie = np.array(earth.earth_rate_n(lat))
    w_en = np.array(earth.transport_rate_n(lat, height, state.v_n[0], state.v_n[1]))
    a_n = f_n + np.array([g_north, 0.0, g_down]) - np.cross(2 * w_ie + w_en, state.v_n)
    return np.concatenate([state.v_n, a_n]), f_n


def measure(
    state: NavigationState,
    fix_lla: Array,
    fix_v_n: Array,
    fix_cov: Array,
    vibration_variance: float,
    age: float,
    delay_sd: float,
    estimated: bool,
    f_n: Array,
    u: Array,
) -> Measurement:
    """Compare a fix, valid ``age`` seconds ago, with the navigation state of now.

    Parameters: ``fix_lla`` (3,), ``fix_v_n`` (3,), ``fix_cov`` (6, 6) in m and m/s, NED;
    ``vibration_variance``, (m/s)^2; ``delay_sd``, s; ``estimated``, whether the age rests on the delay
    state; ``f_n`` and ``u`` from `kinematics`.
    """
    C_nb = attitude.to_dcm(state.q_nb)
    # Metres per radian are those of the navigated position, as in the error state.
    p_error = -earth.displacement_n(fix_lla, state.lla)
    navigated = np.concatenate([p_error, state.v_n - fix_v_n])

    H = np.zeros((6, N_STATES))
    H[:3, POSITION] = np.eye(3)
    H[:3, VELOCITY] = -age * np.eye(3)
    H[3:, VELOCITY] = np.eye(3)
    H[3:, MISALIGN] = -age * attitude.skew(f_n)
    H[3:, ACCEL] = -age * C_nb
    if estimated:
        H[:, DELAY] = -u
    R = fix_cov + delay_sd**2 * np.outer(u, u)
    R[3:, 3:] += vibration_variance * np.eye(3)
    return Measurement(navigated - age * u, H, R)


def joseph_update(P: Array, measurement: Measurement) -> tuple[Array, Array, float]:
    """Error estimate (16,), covariance (16, 16) and NIS of a Kalman update, Joseph form."""
    innovation, H, R = measurement
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    A = np.eye(len(P)) - K @ H
    nis = float(innovation @ np.linalg.solve(S, innovation))
    return K @ innovation, A @ P @ A.T + K @ R @ K.T, nis
