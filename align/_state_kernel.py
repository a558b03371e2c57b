"""Compiled steps of one alignment's state and covariance: start them, carry, compare and copy them."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

from numba import njit

from ..sins._kernels import COMPILED, advance
from ._cubature_kernel import error_between
from ._kernels import REFUSED, navigate


@njit(**COMPILED)
def start(X, P, lla, v_n, cov, initial, sd, rooted=False):
    """Take position and velocity from a fix, all but the attitude as it was first; forget all
    correlations. ``rooted``: ``P`` is to be the square root."""
    for i in range(3):
        X[i], X[3 + i] = lla[i], v_n[i]
    for i in range(10):
        X[10 + i] = initial[i]
    X[REFUSED] = 0.0
    for i in range(len(P)):
        for j in range(len(P)):
            P[i, j] = sd[i] * sd[i] if i == j else 0.0
    for i in range(6):
        # Diffuse against this fix, however bad it is.
        P[i, i] = max(P[i, i], 1e4 * cov[i, i])
    if rooted:
        for i in range(len(P)):
            P[i, i] = math.sqrt(P[i, i])


@njit(**COMPILED)
def covariance(P, rooted, i, j):
    """Element of the covariance that ``P`` is, or whose lower square root it is."""
    if not rooted:
        return P[i, j]
    s = 0.0
    for k in range(min(i, j) + 1):
        s += P[i, k] * P[j, k]
    return s


@njit(**COMPILED)
def carry_attitude(X, time, increments, k, q_initial, lla, v_n, gravity_model, work):
    """Attitude at epoch k, from epoch 0 by the gyros, at a position and velocity that are held."""
    increment, previous, f_n = work[3], work[4], work[5]
    for i in range(4):
        X[6 + i] = q_initial[i]
    for j in range(1, k + 1):
        for i in range(3):
            X[i], X[3 + i] = lla[i], v_n[i]
        for i in range(6):
            increment[i] = increments[j, i]
            previous[i] = increments[j - 1, i] if j > 1 else 0.0
        dt = time[j] - time[j - 1]
        advance(X[0:3], X[3:6], X[6:10], increment, previous, dt, gravity_model, f_n)


@njit(**COMPILED)
def carried_on(X, P, rooted, time, increments, k, gravity_model, work, before):
    """Write to ``before`` where X, of epoch k - 1, comes to without further fixes, and its standard
    deviations."""
    X_before, sd, _ = before
    for i in range(len(X)):
        X_before[i] = X[i]
    for i in range(9):
        sd[i] = math.sqrt(max(covariance(P, rooted, i, i), 0.0))
    navigate(X_before, time, increments, k, gravity_model, work[3], work[4], work[5])


@njit(**COMPILED)
def greatest_move(X, before):
    """How far X is from where it would be without the latest fixes: the greatest change of position,
    velocity or misalignment over its standard deviation before."""
    X_before, sd, e = before
    error_between(X_before, X, e)
    greatest = 0.0
    for i in range(9):
        if e[i] != 0.0:
            greatest = max(greatest, abs(e[i]) / sd[i] if sd[i] > 0 else math.inf)
    return greatest


@njit(**COMPILED)
def copy_state(X_from, P_from, X_to, P_to):
    """Copy state and covariance; loops compile much faster than array assignments."""
    for i in range(len(X_to)):
        X_to[i] = X_from[i]
    for i in range(len(P_to)):
        for j in range(len(P_to)):
            P_to[i, j] = P_from[i, j]


@njit(**COMPILED)
def meaningful(X, P):
    """Whether the state is finite and no variance is negative."""
    for i in range(REFUSED):
        if not math.isfinite(X[i]):
            return False
    trace = 0.0
    for i in range(len(P)):
        if P[i, i] < 0:
            return False
        trace += P[i, i]
    return math.isfinite(trace)
