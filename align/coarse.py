"""Coarse alignment in motion, from no attitude at all: optimisation-based alignment on velocity fixes.

Let i be the earth's axes of the record's start, held against inertial space, and b0 the body's. With
``v_i = C_ie v_e`` the velocity equation integrates to

    C alpha(t) + c = beta(t),    C = C_ib0 and c constant,
    alpha(t) = integral of C_b0b f_b,                              from the IMU alone,
    beta(t)  = v_i - integral of C_ie (g_e - w_ie x v_e),          from the fixes alone.

Every fix is one such equation, with the white noise of its velocity. The attitude that fits all best solves
Wahba's problem for ``alpha`` and ``beta`` less their means: it needs no starting value and has no second
minimum to fall into.

References
----------
.. [1] Y. Wu, X. Pan, "Velocity/position integration formula part I: application to in-flight coarse
       alignment", IEEE Transactions on Aerospace and Electronic Systems 49 (2013), there in n.
.. [2] F. L. Markley, "Attitude determination using vector observations and the singular value decomposition",
       Journal of the Astronautical Sciences 36 (1988).
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..sins import attitude, earth
from ..sins._kernels import COMPILED, fill_C_nb, rotate_attitude
from ..sins.earth import EARTH_RATE, STANDARD_GRAVITY, GravityModel
from ..sins.units import DEG
from .estimate import Array, FixOutcome
from .problem import Problem
from .reception import Integers
from .settings import DelayModel

LEVEL_SD = 0.5 * DEG
HEADING_SD = 2.0 * DEG
"""Standard deviations, rad, at which the coarse attitude is handed over to a filter."""


class CoarseAttitude(NamedTuple):
    """What the coarse stage found."""

    time: float
    """At which it was done, s: when the fix that decided it arrived."""
    q_nb: Array
    """(4,) attitude at the start of the record."""
    sd: Array
    """(3,) standard deviations of its misalignment, NED, rad."""


def align_in_motion(problem: Problem) -> CoarseAttitude | None:
    """The first attitude that is good enough, or None if the motion never told it.

    Fixes count in order of arrival, from the time that the delay model takes for that of their validity; the
    attitude that ``problem`` states is not looked at. Neglected: biases, so that a poor gyro must not take
    long; the error of a mean delay that is not told, which lies along the acceleration; outliers. Where
    gravity and the axes of the start are taken from may be a fix that has not arrived yet: metres of it do
    not matter.
    """
    lla, v_n, cov, t_reference, arrival_epoch, _, packet, _, _ = problem.reception
    delay = problem.initial[6] if problem.delay is DelayModel.ESTIMATED else 0.0
    t = t_reference - delay
    usable = (problem.outcome == FixOutcome.PENDING) & (arrival_epoch < len(problem.time))
    usable &= (t >= problem.time[0]) & (t <= problem.time[-1])
    usable[usable] = _first_of_each(packet[usable])
    if np.count_nonzero(usable) < 3:
        return None
    t, lla, v_n, arrival_epoch = t[usable], lla[usable], v_n[usable], arrival_epoch[usable]
    alpha, force = _from_imu(problem, t)
    weight = 1 / (np.einsum("kii->k", cov[usable, 3:, 3:]) / 3 + _lateness(problem, force))
    beta = _from_fixes(t - problem.time[0], lla, v_n, GravityModel(problem.gravity))

    # Sums over the fixes so far, of vectors less their means so far.
    alpha, beta = alpha - alpha[0], beta - beta[0]
    total = np.cumsum(weight)
    mean_a, mean_b = (np.cumsum(weight[:, None] * x, axis=0) / total[:, None] for x in (alpha, beta))
    ba = np.cumsum(weight[:, None, None] * beta[:, :, None] * alpha[:, None], axis=0)
    aa = np.cumsum(weight[:, None, None] * alpha[:, :, None] * alpha[:, None], axis=0)
    ba -= total[:, None, None] * mean_b[:, :, None] * mean_a[:, None]
    aa -= total[:, None, None] * mean_a[:, :, None] * mean_a[:, None]
    U, _, Vt = np.linalg.svd(ba)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    C_ib = U @ Vt
    C_ni = _at_start(problem, t, lla, v_n)
    C_nb = C_ni @ C_ib
    information = C_nb @ (np.einsum("kii->k", aa)[:, None, None] * np.eye(3) - aa) @ C_nb.swapaxes(1, 2)
    # Along a direction that motion has not told of there is next to no information: not none, or no inverse.
    sd = np.sqrt(np.einsum("kii->ki", np.linalg.inv(information + 1e-3 * np.eye(3))))
    good = np.flatnonzero((sd[:, :2] < LEVEL_SD).all(axis=1) & (sd[:, 2] < HEADING_SD))
    if len(good) == 0:
        return None
    k = good[0]
    return CoarseAttitude(float(problem.time[arrival_epoch[k]]), attitude.from_dcm(C_nb[k]), sd[k])


def _first_of_each(packet: Integers) -> NDArray[np.bool_]:
    """Which of the packets, in order of arrival, are no duplicates."""
    first = np.zeros(len(packet), bool)
    first[np.unique(packet, return_index=True)[1]] = True
    return first


def _from_imu(problem: Problem, t: Array) -> tuple[Array, Array]:
    """``alpha`` of the antenna and specific force, both (k, 3), at times ``t``."""
    n = len(problem.time)
    alpha, rotated = np.zeros((n, 3)), np.zeros((n, 3, 3))
    _integrate(problem.increments, alpha, rotated)
    row = np.clip(np.searchsorted(problem.time, t, side="right") - 1, 0, n - 2)
    x = ((t - problem.time[row]) / problem.dt)[:, None]
    rate, force = np.split(problem.increments[row + 1] / problem.dt, 2, axis=1)
    swing = np.einsum("kij,kj->ki", rotated[row], np.cross(rate, problem.initial[7:]))
    return alpha[row] + x * (alpha[row + 1] - alpha[row]) + swing, force


@njit(**COMPILED)
def _integrate(increments, alpha, rotated):
    """``alpha`` (n, 3) and ``C_b0b`` (n, 3, 3) at each epoch."""
    q, C = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((3, 3))
    for i in range(3):
        rotated[0, i, i] = 1.0
    for k in range(1, len(increments)):
        tx, ty, tz, vx, vy, vz = increments[k]
        sx, sy = vx + 0.5 * (ty * vz - tz * vy), vy + 0.5 * (tz * vx - tx * vz)
        sz = vz + 0.5 * (tx * vy - ty * vx)
        for i in range(3):
            turned = rotated[k - 1, i, 0] * sx + rotated[k - 1, i, 1] * sy + rotated[k - 1, i, 2] * sz
            alpha[k, i] = alpha[k - 1, i] + turned
        rotate_attitude(q, -tx, -ty, -tz)  # b0 as seen from b
        fill_C_nb(q, C)
        for i in range(3):
            for j in range(3):
                rotated[k, i, j] = C[j, i]


def _lateness(problem: Problem, force: Array) -> Array:
    """(k,) variance of velocity, (m/s)^2, by vibration and by the random part of the delay.

    The acceleration that turns the latter into velocity is that of a level turn with this specific force.
    """
    acceleration = np.maximum(np.sum(force**2, axis=1) - STANDARD_GRAVITY**2, 0.0)
    return problem.vibration_variance + problem.delay_sd**2 * acceleration


def _from_fixes(since: Array, lla: Array, v_n: Array, gravity: GravityModel) -> Array:
    """``beta`` (k, 3) of fixes (k, 3) valid at ``since`` (k,) s from the start, in any order."""
    order = np.argsort(since, kind="stable")
    since, lla, v_n = since[order], lla[order], v_n[order]
    C_en = earth.C_en(lla[:, 0], lla[:, 1])
    angle = EARTH_RATE * since
    C_ie = np.zeros((len(since), 3, 3))
    C_ie[:, 0, 0] = C_ie[:, 1, 1] = np.cos(angle)
    C_ie[:, 1, 0], C_ie[:, 0, 1], C_ie[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    g_north, g_down = earth.gravity(gravity, lla[:, 0], lla[:, 2])
    g_n = np.stack([g_north, np.zeros(len(lla)), g_down], axis=1)
    v_e, g_e = (np.einsum("kij,kj->ki", C_en, x) for x in (v_n, g_n))
    rate = np.einsum("kij,kj->ki", C_ie, g_e - np.cross([0.0, 0.0, EARTH_RATE], v_e))
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(since)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    beta = np.empty_like(v_e)
    beta[order] = np.einsum("kij,kj->ki", C_ie, v_e) - integral
    return beta


def _at_start(problem: Problem, t: Array, lla: Array, v_n: Array) -> Array:
    """C_ne (3, 3) where the record starts, from the earliest fix."""
    first = np.argmin(t)
    lat, lon, _ = earth.displaced(lla[first], -v_n[first] * (t[first] - problem.time[0]))
    return earth.C_en(lat, lon).T
