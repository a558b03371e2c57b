"""Error-state dynamics of the local-level mechanisation: 15 states.

=========  =======================================  ======
slice      state                                    unit
=========  =======================================  ======
POSITION   position error, NED                      m
VELOCITY   velocity error, NED                      m/s
MISALIGN   misalignment phi, NED                    rad
ACCEL      accelerometer bias, body                 m/s^2
GYRO       gyro bias, body                          rad/s
=========  =======================================  ======

All errors are computed (or measured) minus true; the signs follow from
``C_nb_computed = (I - [phi x]) C_nb``.

References
----------
.. [1] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation
       Systems", 2nd ed., section 14.2.4 (there in latitude, longitude and height, with the opposite
       sign of the attitude error).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import attitude, earth
from .earth import GravityModel

Array = NDArray[np.float64]

POSITION, VELOCITY, MISALIGN, ACCEL, GYRO = (slice(k, k + 3) for k in range(0, 15, 3))
N_STATES = 15


def system_matrix(lla: ArrayLike, v_n: ArrayLike, f_n: ArrayLike, C_nb: ArrayLike) -> Array:
    """F of ``dx/dt = F x + noise``, shape (15, 15).

    Parameters: ``lla`` (3,) rad, rad, m; ``v_n`` (3,) m/s; ``f_n`` (3,) specific force in n, m/s^2;
    ``C_nb`` (3, 3). Exact to first order on a sphere of the local radii; what is neglected is the
    change of the radii of curvature and of gravity with latitude, below 1e-7 in every entry.
    """
    lat, _, height = np.asarray(lla, float)
    north, east, down = v = np.asarray(v_n, float)
    R_N, R_E = earth.radii_of_curvature(lat)
    r_n, r_e, tan_lat = 1 / (R_N + height), 1 / (R_E + height), np.tan(lat)
    w_ie = np.array(earth.earth_rate_n(lat))
    w_en = np.array(earth.transport_rate_n(lat, height, north, east))

    # Derivatives of the two rates by displacement (columns north, east, down) and by velocity.
    w_ie_r = np.zeros((3, 3))
    w_ie_r[:, 0] = np.array([w_ie[2], 0, -w_ie[0]]) * r_n
    w_en_r = np.zeros((3, 3))
    w_en_r[2, 0] = -east * r_e * r_n / np.cos(lat) ** 2
    w_en_r[:, 2] = w_en * np.array([r_e, r_n, r_e])
    w_en_v = np.array([[0, r_e, 0], [-r_n, 0, 0], [0, -tan_lat * r_e, 0]])
    _, g_down = earth.gravity(GravityModel.J2, lat, height)
    gravity_gradient = np.diag([0, 0, 2 * g_down * np.sqrt(r_n * r_e)])

    F = np.zeros((N_STATES, N_STATES))
    F[POSITION, POSITION] = [
        [-down * r_n, 0, north * r_n],
        [east * tan_lat * r_n, -down * r_e - north * tan_lat * r_n, east * r_e],
        [0, 0, 0],
    ]
    F[POSITION, VELOCITY] = np.eye(3)
    F[VELOCITY, POSITION] = attitude.skew(v) @ (2 * w_ie_r + w_en_r) + gravity_gradient
    F[VELOCITY, VELOCITY] = attitude.skew(v) @ w_en_v - attitude.skew(2 * w_ie + w_en)
    F[VELOCITY, MISALIGN] = attitude.skew(f_n)
    F[VELOCITY, ACCEL] = C_nb
    F[MISALIGN, POSITION] = w_ie_r + w_en_r
    F[MISALIGN, VELOCITY] = w_en_v
    F[MISALIGN, MISALIGN] = -attitude.skew(w_ie + w_en)
    F[MISALIGN, GYRO] = -np.asarray(C_nb, float)
    return F


def transition_matrix(lla: ArrayLike, v_n: ArrayLike, f_n: ArrayLike, C_nb: ArrayLike, dt: float) -> Array:
    """``I + F dt``, shape (15, 15), for a short interval ``dt``, s; parameters as `system_matrix`."""
    return np.eye(N_STATES) + system_matrix(lla, v_n, f_n, C_nb) * dt


def predict_covariance(P: ArrayLike, Phi: ArrayLike, noise: ArrayLike) -> Array:
    """``Phi P Phi' + diag(noise)``, shape (15, 15)."""
    Phi = np.asarray(Phi, float)
    return Phi @ np.asarray(P, float) @ Phi.T + np.diag(np.asarray(noise, float))
