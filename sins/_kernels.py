"""Compiled time loops of the strapdown mechanisation and of the error covariance.

Each kernel has a readable numpy twin, which the tests hold it to: `mechanization.step`,
`error_model.transition_matrix`, `error_model.predict_covariance`. Scalars instead of small
vectors keep everything in registers.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from .earth import EARTH_RATE, EQUATORIAL_RADIUS, gravity_by_sine, radii_by_sine


def _can_be_kept() -> bool:
    """Whether there is a folder to keep compiled code in; numba looks for one when it decorates."""
    try:
        njit(cache=True)(_can_be_kept)
    except RuntimeError:
        return False
    return True


COMPILED = {"cache": _can_be_kept(), "nogil": True, "error_model": "numpy"}
"""Options of every compiled loop: kept on disk, free of the interpreter's lock, division as numpy does it."""


@njit(inline="always", **COMPILED)
def _quaternion_of_rotvec(x, y, z):
    """Quaternion of a rotation vector; the series is exact to rounding below 0.2 rad."""
    s = 0.25 * (x * x + y * y + z * z)
    if s < 0.01:
        cos_half = 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56)))
        sinc_half = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
    else:
        half = math.sqrt(s)
        cos_half = math.cos(half)
        sinc_half = math.sin(half) / half
    k = 0.5 * sinc_half
    return cos_half, k * x, k * y, k * z


@njit(inline="always", **COMPILED)
def quaternion_product(pw, px, py, pz, qw, qx, qy, qz):
    """Hamilton product p q of scalar-first quaternions."""
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


@njit(**COMPILED)
def rotate_attitude(q, x, y, z):
    """Turn n by the rotation vector (x, y, z), rad, in place: ``q <- exp(x, y, z) q``, normalised."""
    rw, rx, ry, rz = _quaternion_of_rotvec(x, y, z)
    w, x, y, z = quaternion_product(rw, rx, ry, rz, q[0], q[1], q[2], q[3])
    scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z)
    q[0], q[1], q[2], q[3] = w * scale, x * scale, y * scale, z * scale


@njit(**COMPILED)
def fill_C_nb(q, C):
    """Write the direction cosines of ``q_nb`` into ``C``, shape (3, 3)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    C[0, 0], C[0, 1], C[0, 2] = w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)
    C[1, 0], C[1, 1], C[1, 2] = 2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)
    C[2, 0], C[2, 1], C[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z


@njit(**COMPILED)
def advance(lla, v_n, q_nb, increment, previous, dt, gravity_model, f_n):
    """One step of the mechanisation, in place on ``lla``, ``v_n``, ``q_nb``; twin of `mechanization.step`.

    Parameters: ``increment`` and ``previous``, shape (6,): dtheta_b (rad) and dv_b (m/s) over this
    interval and the one before, zero if there is none. ``f_n``, shape (3,), is written: the mean
    specific force in n over the interval, m/s^2.
    """
    ax, ay, az = increment[0], increment[1], increment[2]
    ux, uy, uz = increment[3], increment[4], increment[5]
    bx, by, bz = previous[0], previous[1], previous[2]
    sx, sy, sz = previous[3], previous[4], previous[5]
    k = 1.0 / 12.0
    # Coning.
    px = ax + k * (by * az - bz * ay)
    py = ay + k * (bz * ax - bx * az)
    pz = az + k * (bx * ay - by * ax)
    # Rotation of the specific force within the interval, and sculling.
    wx = ux + 0.5 * (ay * uz - az * uy) + k * (by * uz - bz * uy + sy * az - sz * ay)
    wy = uy + 0.5 * (az * ux - ax * uz) + k * (bz * ux - bx * uz + sz * ax - sx * az)
    wz = uz + 0.5 * (ax * uy - ay * ux) + k * (bx * uy - by * ux + sx * ay - sy * ax)

    qw, qx, qy, qz = q_nb[0], q_nb[1], q_nb[2], q_nb[3]
    tx, ty, tz = 2 * (qy * wz - qz * wy), 2 * (qz * wx - qx * wz), 2 * (qx * wy - qy * wx)
    dv_north = wx + qw * tx + qy * tz - qz * ty
    dv_east = wy + qw * ty + qz * tx - qx * tz
    dv_down = wz + qw * tz + qx * ty - qy * tx

    # Everything that varies slowly is taken at the middle of the interval.
    north, east, down = v_n[0], v_n[1], v_n[2]
    lat = lla[0] + 0.5 * dt * north / EQUATORIAL_RADIUS
    height = lla[2] - 0.5 * dt * down
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    g_north, g_down = gravity_by_sine(gravity_model, sin_lat, cos_lat, height)
    R_N, R_E = radii_by_sine(sin_lat)
    r_n, r_e = 1 / (R_N + height), 1 / (R_E + height)
    north_mid = north + 0.5 * (dv_north + g_north * dt)
    east_mid = east + 0.5 * dv_east
    down_mid = down + 0.5 * (dv_down + g_down * dt)
    ie_north, ie_down = EARTH_RATE * cos_lat, -EARTH_RATE * sin_lat
    en_north, en_east = east_mid * r_e, -north_mid * r_n
    en_down = -en_north * sin_lat / cos_lat

    zeta_north = (ie_north + en_north) * dt
    zeta_east = en_east * dt
    zeta_down = (ie_down + en_down) * dt
    rotated_north = dv_north - 0.5 * (zeta_east * dv_down - zeta_down * dv_east)
    rotated_east = dv_east - 0.5 * (zeta_down * dv_north - zeta_north * dv_down)
    rotated_down = dv_down - 0.5 * (zeta_north * dv_east - zeta_east * dv_north)
    f_n[0], f_n[1], f_n[2] = rotated_north / dt, rotated_east / dt, rotated_down / dt

    c_north, c_east, c_down = 2 * ie_north + en_north, en_east, 2 * ie_down + en_down
    v_n[0] = north + rotated_north + (g_north - c_east * down_mid + c_down * east_mid) * dt
    v_n[1] = east + rotated_east + (-c_down * north_mid + c_north * down_mid) * dt
    v_n[2] = down + rotated_down + (g_down - c_north * east_mid + c_east * north_mid) * dt

    lla[0] += 0.5 * (north + v_n[0]) * dt * r_n
    lla[1] += 0.5 * (east + v_n[1]) * dt * r_e / cos_lat
    lla[2] -= 0.5 * (down + v_n[2]) * dt

    rw, rx, ry, rz = _quaternion_of_rotvec(px, py, pz)
    q_nb[0], q_nb[1], q_nb[2], q_nb[3] = quaternion_product(qw, qx, qy, qz, rw, rx, ry, rz)
    rotate_attitude(q_nb, -zeta_north, -zeta_east, -zeta_down)


@njit(**COMPILED)
def mechanize(time, dtheta_b, dv_b, gravity_model, lla, v_n, q_nb):
    """Fill rows 1.. of ``lla``, ``v_n``, ``q_nb`` from row 0 and the increments, (n, 3) each."""
    position, velocity, attitude = lla[0].copy(), v_n[0].copy(), q_nb[0].copy()
    increment, previous, f_n = np.zeros(6), np.zeros(6), np.empty(3)
    for k in range(1, len(time)):
        for i in range(6):
            previous[i] = increment[i]
        for i in range(3):
            increment[i], increment[3 + i] = dtheta_b[k, i], dv_b[k, i]
        advance(position, velocity, attitude, increment, previous, time[k] - time[k - 1], gravity_model, f_n)
        for i in range(3):
            lla[k, i], v_n[k, i] = position[i], velocity[i]
        for i in range(4):
            q_nb[k, i] = attitude[i]


@njit(**COMPILED)
def fill_transition(lla, v_n, f_n, C, dt, Phi):
    """Write the first nine rows of ``I + F dt``, shape (9, 15); twin of `error_model.transition_matrix`.

    Only the blocks that can differ from zero are written: ``Phi`` must come in as zeros.
    """
    height = lla[2]
    north, east, down = v_n[0], v_n[1], v_n[2]
    sin_lat, cos_lat = math.sin(lla[0]), math.cos(lla[0])
    tan_lat = sin_lat / cos_lat
    R_N, R_E = radii_by_sine(sin_lat)
    r_n, r_e = 1 / (R_N + height), 1 / (R_E + height)
    _, g_down = gravity_by_sine(0, sin_lat, cos_lat, height)
    ie_north, ie_down = EARTH_RATE * cos_lat, -EARTH_RATE * sin_lat
    en_north, en_east = east * r_e, -north * r_n
    en_down = -en_north * tan_lat

    Phi[0, 0] = 1 - down * r_n * dt
    Phi[0, 2] = north * r_n * dt
    Phi[0, 3] = dt
    Phi[1, 0] = east * tan_lat * r_n * dt
    Phi[1, 1] = 1 - (down * r_e + north * tan_lat * r_n) * dt
    Phi[1, 2] = east * r_e * dt
    Phi[1, 4] = dt
    Phi[2, 2] = 1.0
    Phi[2, 5] = dt

    # d(w_ie), d(w_en) by north and down displacement.
    ie_north_n, ie_down_n = ie_down * r_n, -ie_north * r_n
    en_down_n = -east * r_e * r_n * (1 + tan_lat * tan_lat)
    en_north_d, en_east_d, en_down_d = en_north * r_e, en_east * r_n, en_down * r_e
    w_north, w_down = 2 * ie_north_n * dt, (2 * ie_down_n + en_down_n) * dt
    Phi[3, 0] = east * w_down
    Phi[4, 0] = down * w_north - north * w_down
    Phi[5, 0] = -w_north * east
    Phi[3, 2] = (east * en_down_d - down * en_east_d) * dt
    Phi[4, 2] = (down * en_north_d - north * en_down_d) * dt
    Phi[5, 2] = (north * en_east_d - east * en_north_d + 2 * g_down * math.sqrt(r_n * r_e)) * dt

    c_north, c_east, c_down = 2 * ie_north + en_north, en_east, 2 * ie_down + en_down
    Phi[3, 3] = 1 + down * r_n * dt
    Phi[3, 4] = (c_down - east * tan_lat * r_e) * dt
    Phi[3, 5] = -c_east * dt
    Phi[4, 3] = -c_down * dt
    Phi[4, 4] = 1 + (down * r_e + north * tan_lat * r_e) * dt
    Phi[4, 5] = c_north * dt
    Phi[5, 3] = (c_east - north * r_n) * dt
    Phi[5, 4] = (-c_north - east * r_e) * dt
    Phi[5, 5] = 1.0

    Phi[3, 7], Phi[3, 8] = -f_n[2] * dt, f_n[1] * dt
    Phi[4, 6], Phi[4, 8] = f_n[2] * dt, -f_n[0] * dt
    Phi[5, 6], Phi[5, 7] = -f_n[1] * dt, f_n[0] * dt

    Phi[6, 0], Phi[8, 0] = ie_north_n * dt, (ie_down_n + en_down_n) * dt
    Phi[6, 2], Phi[7, 2], Phi[8, 2] = en_north_d * dt, en_east_d * dt, en_down_d * dt
    Phi[6, 4], Phi[7, 3], Phi[8, 4] = r_e * dt, -r_n * dt, -tan_lat * r_e * dt
    in_north, in_east, in_down = ie_north + en_north, en_east, ie_down + en_down
    Phi[6, 6] = Phi[7, 7] = Phi[8, 8] = 1.0
    Phi[6, 7], Phi[6, 8] = in_down * dt, -in_east * dt
    Phi[7, 6], Phi[7, 8] = -in_down * dt, in_north * dt
    Phi[8, 6], Phi[8, 7] = in_east * dt, -in_north * dt
    for i in range(3):
        for j in range(3):
            Phi[3 + i, 9 + j] = C[i, j] * dt
            Phi[6 + i, 12 + j] = -C[i, j] * dt


@njit(**COMPILED)
def predict_covariance(P, Phi, noise, W):
    """``P <- Phi P Phi' + diag(noise)``, in place; twin of `error_model.predict_covariance`.

    Parameters: ``P``, shape (m, m) with m >= 15, symmetric; ``Phi``, shape (9, 15), the first rows of a
    transition that is the identity below; ``noise``, shape (m,), variances added on the diagonal;
    ``W``, shape (9, m), workspace. Blocks of ``Phi`` that are always zero are skipped.
    """
    m = P.shape[0]
    for i in range(9):
        for c in range(m):
            W[i, c] = 0.0
        for k in range(15):
            if (i < 3 and k >= 6) or (3 <= i < 6 and k >= 12) or (i >= 6 and 9 <= k < 12):
                continue
            a = Phi[i, k]
            for c in range(m):
                W[i, c] += a * P[k, c]
    for j in range(9):
        for i in range(j + 1):
            s = 0.0
            for k in range(6):
                s += W[i, k] * Phi[j, k]
            if j >= 3:
                for k in range(6, 9):
                    s += W[i, k] * Phi[j, k]
                first = 9 if j < 6 else 12
                for k in range(first, first + 3):
                    s += W[i, k] * Phi[j, k]
            P[i, j] = s
            P[j, i] = s
    for i in range(9):
        for c in range(9, m):
            P[i, c] = W[i, c]
            P[c, i] = W[i, c]
    for i in range(m):
        P[i, i] += noise[i]
