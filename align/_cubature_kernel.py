"""Compiled steps of the alignment by cubature points, on the state of `align._kernels`, without derivatives.

A point is a state that could be the true one: the filter's less an error, as `correct` takes it off. So the
points lie on the sphere of attitudes, and not beside it. Errors propagate through the mechanisation itself,
and fixes through the innovation itself. The square-root form holds the lower square root of the covariance
where the other holds the covariance.

References
----------
.. [1] I. Arasaratnam, S. Haykin, "Cubature Kalman Filters", IEEE Transactions on Automatic Control 54 (2009).
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ..sins._kernels import COMPILED, fill_C_nb, quaternion_product
from ..sins.earth import radii_of_curvature
from ._kernels import LEVER, N_X, correct, fill_innovation, kinematics, navigate


def points_memory(n, rooted):
    """What `cubature_predict` and `cubature_update` work in: whether by square roots, and arrays."""
    shapes = ((n, n), (3 * n, n), (2 * n + 6, 6 + n), (6 + n, 6 + n), (6, 6), (n, 6))
    return rooted, tuple(np.zeros(s) for s in shapes), tuple(np.zeros(m) for m in (N_X, N_X, n, n, 6, 6))


@njit(**COMPILED)
def error_between(X, Y, e):
    """Write the error (n,) of state X that `correct` would take off it to leave Y."""
    R_N, R_E = radii_of_curvature(X[0])
    e[0] = (X[0] - Y[0]) * (R_N + X[2])
    east = X[1] - Y[1]
    east -= 2 * math.pi * round(east / (2 * math.pi))
    e[1] = east * (R_E + X[2]) * math.cos(Y[0])
    e[2] = Y[2] - X[2]
    w, x, y, z = quaternion_product(Y[6], Y[7], Y[8], Y[9], X[6], -X[7], -X[8], -X[9])
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2 * math.atan2(length, w) / length if length > 1e-12 else 2.0
    e[6], e[7], e[8] = scale * x, scale * y, scale * z
    for i in range(3):
        e[3 + i] = X[3 + i] - Y[3 + i]
        e[9 + i] = Y[10 + i] - X[10 + i]
        e[12 + i] = Y[13 + i] - X[13 + i]
    e[15] = X[16] - Y[16]
    if len(e) > LEVER:
        for i in range(3):
            e[LEVER + i] = X[17 + i] - Y[17 + i]


@njit(**COMPILED)
def factorize(A, L):
    """Write the lower Cholesky factor of A; False, and NaN in it, where A is not positive definite.

    Rows and columns of states that are known, all zero, stay zero.
    """
    n = len(A)
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if s < 0 or not math.isfinite(s):
                    L[0, 0] = math.nan
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j] if L[j, j] > 0 else 0.0
        for j in range(i + 1, n):
            L[i, j] = 0.0
    return True


@njit(**COMPILED)
def triangularize(A, L):
    """Write the lower square root of A' A, A (m, n) with m >= n, by Householder's reflections; A is lost."""
    m, n = A.shape
    for j in range(n):
        norm = 0.0
        for i in range(j, m):
            norm += A[i, j] * A[i, j]
        norm = math.sqrt(norm)
        if norm > 0:
            pivot = A[j, j]
            alpha = -norm if pivot > 0 else norm
            head = pivot - alpha
            # The reflector's length squared, over two: norm (norm + |pivot|).
            half = norm * (norm + abs(pivot))
            for c in range(j + 1, n):
                s = head * A[j, c]
                for i in range(j + 1, m):
                    s += A[i, j] * A[i, c]
                s /= half
                A[j, c] -= s * head
                for i in range(j + 1, m):
                    A[i, c] -= s * A[i, j]
            A[j, j] = alpha
        sign = -1.0 if A[j, j] < 0 else 1.0
        for c in range(n):
            L[c, j] = sign * A[j, c] if c >= j else 0.0


@njit(**COMPILED)
def _point(X, root, p, n, e, Y):
    """Write the p-th of the 2n points about X, and the error that sets it apart."""
    spread = math.sqrt(n) if p < n else -math.sqrt(n)
    for i in range(n):
        e[i] = spread * root[i, p % n]
    for i in range(len(X)):
        Y[i] = X[i]
    correct(Y, e)


@njit(**COMPILED)
def cubature_predict(X, P, time, increments, gap_variance, k, noise, gravity_model, work, memory):
    """Carry state and covariance, or its square root, from epoch k - 1 to epoch k ([1]_ eqs. 31 to 37).

    noise (n,) : variances that are added. gap_variance (n, 6), work : as for `predict`.
    """
    rooted, (root, E, _, _, _, _), (Y, start, e, mean, _, _) = memory
    increment, previous, f_n = work[3], work[4], work[5]
    n = len(P)
    if rooted:
        for i in range(n):
            for j in range(n):
                root[i, j] = P[i, j]
    elif not factorize(P, root):
        P[0, 0] = math.nan
        return
    for i in range(len(X)):
        start[i] = X[i]
    navigate(X, time, increments, k, gravity_model, increment, previous, f_n)
    for i in range(n):
        mean[i] = 0.0
    for p in range(2 * n):
        _point(start, root, p, n, e, Y)
        navigate(Y, time, increments, k, gravity_model, increment, previous, f_n)
        error_between(X, Y, e)
        for i in range(n):
            E[p, i] = e[i]
            mean[i] += e[i] / (2 * n)
    weight = math.sqrt(1 / (2 * n))
    for p in range(2 * n):
        for i in range(n):
            E[p, i] = (E[p, i] - mean[i]) * weight
    correct(X, mean)
    for i in range(n):
        for j in range(n):
            E[2 * n + i, j] = math.sqrt(noise[i]) if i == j else 0.0
    if gap_variance[k].any():
        # The noise of three axes is the same, and so may be turned.
        fill_C_nb(X[6:10], work[2])
        for first, of in ((3, 3), (6, 0)):
            for b in range(3):
                sd = math.sqrt(noise[first + b] + gap_variance[k, of + b])
                for i in range(3):
                    E[2 * n + first + b, first + i] = sd * work[2][i, b]
    if rooted:
        triangularize(E, P)
        return
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for p in range(3 * n):
                s += E[p, i] * E[p, j]
            P[i, j] = s
            P[j, i] = s


@njit(**COMPILED)
def cubature_update(
    X,
    P,
    lla,
    v_n,
    R,
    age,
    estimated,
    time,
    increments,
    k,
    samples,
    gravity_model,
    motion,
    gate,
    innovation,
    memory,
):
    """Correct state and covariance, or its square root, by one fix ([1]_ eqs. 38 to 47). Returns (NIS,
    applied).

    R (6, 6) : covariance of the fix's errors. age : s, without the delay that the state may hold
    (``estimated``). motion : for `kinematics`. Where the fix is not applied, nothing but ``innovation`` is
    written.
    """
    rooted, (root, _, joint, L, root_R, K), (Y, _, e, _, z, x) = memory
    C, f_n, w_b, arm, u = motion
    n = len(P)
    if rooted:
        for i in range(n):
            for j in range(n):
                root[i, j] = P[i, j]
    elif not factorize(P, root):
        return math.nan, False
    for i in range(6):
        innovation[i] = 0.0
    for p in range(2 * n):
        _point(X, root, p, n, e, Y)
        kinematics(Y, time, increments, k, samples, gravity_model, C, f_n, w_b, arm, u)
        fill_innovation(Y, lla, v_n, age + (Y[16] if estimated else 0.0), arm, u, z)
        for i in range(6):
            joint[p, i] = z[i]
            innovation[i] += z[i] / (2 * n)
        for i in range(n):
            joint[p, 6 + i] = e[i]
    weight = math.sqrt(1 / (2 * n))
    for p in range(2 * n):
        for i in range(6):
            # Against the error: a state that errs more leaves less for the innovation of its truth.
            joint[p, i] = (innovation[i] - joint[p, i]) * weight
        for i in range(n):
            joint[p, 6 + i] *= weight
    if not factorize(R, root_R):
        return math.nan, False
    for i in range(6):
        for j in range(6):
            joint[2 * n + i, j] = root_R[j, i]
        for j in range(n):
            joint[2 * n + i, 6 + j] = 0.0
    # One triangle has all: the root of S, K times it, and the root of what is left of P.
    triangularize(joint, L)
    nis = 0.0
    for i in range(6):
        s = innovation[i]
        for j in range(i):
            s -= L[i, j] * x[j]
        x[i] = s / L[i, i]
        nis += x[i] * x[i]
    if not nis <= gate:
        return nis, False
    for r in range(n):
        e[r] = 0.0
        for i in range(6):
            K[r, i] = L[6 + r, i]
            e[r] += K[r, i] * x[i]
    correct(X, e)
    for r in range(n):
        for c in range(r + 1):
            if rooted:
                P[r, c] = L[6 + r, 6 + c]
                continue
            s = P[r, c]
            for i in range(6):
                s -= K[r, i] * K[c, i]
            P[r, c] = s
            P[c, r] = s
    return nis, True
