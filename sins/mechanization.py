"""Strapdown mechanisation in the local-level frame with quaternion attitude.

`mechanize` runs the compiled loop; `step` is the same algorithm to read, and its oracle in tests.

References
----------
.. [1] P. G. Savage, "Strapdown Inertial Navigation Integration Algorithm Design, Part 1: Attitude
       Algorithms" and "Part 2: Velocity and Position Algorithms", Journal of Guidance, Control,
       and Dynamics 21 (1998): two-interval coning (Part 1, eq. 47 in its first order) and sculling.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _kernels, attitude, earth
from .earth import GravityModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NavigationState:
    """Position, velocity and attitude at one time, or a history of them with time first.

    ``lla`` (..., 3) in rad, rad, m; ``v_n`` (..., 3) in m/s, NED; ``q_nb`` (..., 4).
    """

    lla: Array
    v_n: Array
    q_nb: Array


def step(
    state: NavigationState,
    dtheta_b: ArrayLike,
    dv_b: ArrayLike,
    previous_dtheta_b: ArrayLike,
    previous_dv_b: ArrayLike,
    dt: float,
    gravity: GravityModel,
) -> NavigationState:
    """Advance one interval.

    Parameters
    ----------
    state : navigation state at the start of the interval.
    dtheta_b, dv_b : shape (3,), integrals of angular rate (rad) and specific force (m/s) over it.
    previous_dtheta_b, previous_dv_b : the same of the interval before, zero if there is none.
    dt : s.
    gravity : model by which to compute gravity.
    """
    dtheta, dv = np.asarray(dtheta_b, float), np.asarray(dv_b, float)
    dtheta_0, dv_0 = np.asarray(previous_dtheta_b, float), np.asarray(previous_dv_b, float)

    rotvec = dtheta + np.cross(dtheta_0, dtheta) / 12
    sculling = (np.cross(dtheta_0, dv) + np.cross(dv_0, dtheta)) / 12
    dv_f = attitude.rotate(state.q_nb, dv + 0.5 * np.cross(dtheta, dv) + sculling)

    # Everything that varies slowly is taken at the middle of the interval.
    lat = state.lla[0] + 0.5 * dt * state.v_n[0] / earth.EQUATORIAL_RADIUS
    height = state.lla[2] - 0.5 * dt * state.v_n[2]
    g_north, g_down = earth.gravity(gravity, lat, height)
    g_n = np.array([g_north, 0.0, g_down])
    v_mid = state.v_n + 0.5 * (dv_f + g_n * dt)
    w_ie = np.array(earth.earth_rate_n(lat))
    w_en = np.array(earth.transport_rate_n(lat, height, v_mid[0], v_mid[1]))
    zeta = (w_ie + w_en) * dt

    dv_f = dv_f - 0.5 * np.cross(zeta, dv_f)
    v_n = state.v_n + dv_f + (g_n - np.cross(2 * w_ie + w_en, v_mid)) * dt

    v_mean = 0.5 * (state.v_n + v_n)
    R_N, R_E = earth.radii_of_curvature(lat)
    rates = [v_mean[0] / (R_N + height), v_mean[1] / ((R_E + height) * np.cos(lat)), -v_mean[2]]
    lla = state.lla + np.array(rates) * dt

    q_nb = attitude.multiply(
        attitude.from_rotvec(-zeta), attitude.multiply(state.q_nb, attitude.from_rotvec(rotvec))
    )
    return NavigationState(lla, v_n, q_nb / np.linalg.norm(q_nb))


def checked_shapes(time: ArrayLike, dtheta_b: ArrayLike, dv_b: ArrayLike) -> tuple[Array, Array, Array]:
    """The three as contiguous float64 arrays, (n,), (n, 3), (n, 3). Raises ValueError for other shapes."""
    time, dtheta_b, dv_b = (np.ascontiguousarray(a, float) for a in (time, dtheta_b, dv_b))
    n = len(time)
    if time.shape != (n,) or dtheta_b.shape != (n, 3) or dv_b.shape != (n, 3):
        shapes = f"{time.shape}, {dtheta_b.shape} and {dv_b.shape}"
        raise ValueError(f"time, dtheta_b and dv_b must be (n,), (n, 3) and (n, 3), not {shapes}")
    return time, dtheta_b, dv_b


def checked_record(time: ArrayLike, dtheta_b: ArrayLike, dv_b: ArrayLike) -> tuple[Array, Array, Array]:
    """As `checked_shapes`; ValueError for fewer than two rows, and a time that does not increase."""
    time, dtheta_b, dv_b = checked_shapes(time, dtheta_b, dv_b)
    if len(time) < 2 or not (np.diff(time) > 0).all():
        raise ValueError("time must increase, over two rows or more")
    return time, dtheta_b, dv_b


def mechanize(
    time: ArrayLike, dtheta_b: ArrayLike, dv_b: ArrayLike, initial: NavigationState, gravity: GravityModel
) -> NavigationState:
    """Integrate a whole record of increments.

    Parameters
    ----------
    time : shape (n,), s, increasing; ``initial`` is the state at ``time[0]``.
    dtheta_b, dv_b : shape (n, 3), rad and m/s, over the interval that ends at ``time``; row 0 is not used.

    Returns
    -------
    History of n states. Raises ValueError as `checked_record` does.
    """
    time, dtheta_b, dv_b = checked_record(time, dtheta_b, dv_b)
    n = len(time)
    lla, v_n, q_nb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    lla[0], v_n[0], q_nb[0] = initial.lla, initial.v_n, initial.q_nb
    _kernels.mechanize(time, dtheta_b, dv_b, int(gravity), lla, v_n, q_nb)
    return NavigationState(lla, v_n, q_nb)
