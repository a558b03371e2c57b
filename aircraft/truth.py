"""From the flight model's inertial states to navigation truth and ideal IMU increments.

The increments are differences of the truth itself in inertial axes, so that a navigator that integrates
them without error returns to the truth; samples of rate and specific force would leave the flight model's
own integration error between the two.

References
----------
.. [1] P. G. Savage, "Strapdown Inertial Navigation Integration Algorithm Design", parts 1 and 2, Journal
       of Guidance, Control, and Dynamics 21 (1998).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sins import attitude, earth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InertialStates:
    """Motion of the body at the flight model's rate, resolved in i, with i's angle to the earth at the start.

    ``r_i``, ``v_i`` (n, 3) m, m/s; ``euler`` (n, 3) roll, pitch, heading against the geodetic local level,
    rad; ``earth_angle`` of e against i in the first row, rad; ``dt`` s.
    """

    r_i: Array
    v_i: Array
    euler: Array
    earth_angle: float
    dt: float


def gravitation_i(r_i: Array) -> Array:
    """Gravitation (without the centrifugal part) of the J2 earth in inertial axes, m/s^2, (..., 3).

    The same field as `earth.gravity_j2`; any axes serve whose third is the earth's.
    """
    r2 = np.sum(r_i**2, axis=-1, keepdims=True)
    oblate = 1.5 * earth.J2 * earth.EQUATORIAL_RADIUS**2 / r2
    s2 = 5 * r_i[..., 2:] ** 2 / r2
    factor = 1 + oblate * (np.array([1.0, 1.0, 3.0]) - s2)
    return -earth.GRAVITATIONAL_PARAMETER / (r2 * np.sqrt(r2)) * factor * r_i


def _about_third_axis(angle: ArrayLike) -> Array:
    """Quaternion of a rotation about the third axis, (n, 4); as ``q_ie`` for the earth's angle."""
    half = 0.5 * np.asarray(angle, float)
    o = np.zeros_like(half)
    return np.stack([np.cos(half), o, o, np.sin(half)], axis=-1)


def navigation_truth(states: InertialStates) -> tuple[Array, Array, Array, Array]:
    """``(lla, v_n, q_nb, q_ib)`` of each row."""
    angle = states.earth_angle + earth.EARTH_RATE * states.dt * np.arange(len(states.r_i))
    q_ie = _about_third_axis(angle)
    q_ei = attitude.conjugate(q_ie)
    r_e = attitude.rotate(q_ei, states.r_i)
    lla = earth.lla_from_ecef(r_e)
    swept = earth.EARTH_RATE * np.stack([-r_e[:, 1], r_e[:, 0], np.zeros(len(r_e))], axis=-1)
    # n from e: about the earth's axis by the longitude, then about east by -(90 deg + latitude).
    lat_turn = -0.5 * (np.pi / 2 + lla[:, 0])
    o = np.zeros_like(lat_turn)
    q_en = attitude.multiply(
        _about_third_axis(lla[:, 1]), np.stack([np.cos(lat_turn), o, np.sin(lat_turn), o], axis=-1)
    )
    v_n = attitude.rotate(attitude.conjugate(q_en), attitude.rotate(q_ei, states.v_i) - swept)
    q_nb = attitude.from_euler(*states.euler.T)
    q_ib = attitude.multiply(attitude.multiply(q_ie, q_en), q_nb)
    return lla, v_n, q_nb, q_ib


def increments(states: InertialStates, q_ib: Array) -> tuple[Array, Array]:
    """``(dtheta_b, dv_b)`` over each step of the flight model, (n - 1, 3).

    Rotation ``dtheta`` from row to row, and the ``dv`` that gives the change of velocity when rate and
    specific force are constant in the body over the step: ``(I + [dtheta x] / 2) dv`` is the change in the
    axes at the step's start ([1]_ part 2, rotation compensation).
    """
    q_bi = attitude.conjugate(q_ib[:-1])
    dtheta = attitude.to_rotvec(attitude.multiply(q_bi, q_ib[1:]))
    r_mid = 0.5 * (states.r_i[:-1] + states.r_i[1:])
    change = attitude.rotate(q_bi, np.diff(states.v_i, axis=0) - gravitation_i(r_mid) * states.dt)
    # Solves (I + [a x]) dv = change in closed form, a = dtheta / 2.
    a = 0.5 * dtheta
    along = a * np.sum(a * change, axis=-1, keepdims=True)
    dv = (change - np.cross(a, change) + along) / (1 + np.sum(a * a, axis=-1, keepdims=True))
    return dtheta, dv


def summed(step_increments: Array, ratio: int) -> Array:
    """Increments of ``ratio`` steps added up, with a leading row of zeros: (n // ratio + 1, 3)."""
    blocks = step_increments[: len(step_increments) // ratio * ratio].reshape(-1, ratio, 3)
    return np.concatenate([np.zeros((1, 3)), blocks.sum(axis=1)])
