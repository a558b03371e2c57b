"""The compiled recursion behind the gains of `analysis`."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED


@njit(**COMPILED)
def settles(mean, random, error, weight, price, adapted, energy, tolerance, most_steps):
    """Whether the value of the game "error minus ``price`` times energy" stays finite, back from the end.

    Parameters
    ----------
    mean, random (n, n + l) : [A0, B0], and s [A1, B1]. error (n + l, n + l) : of [eta; w].
    weight (n, n) : covariance of eta, to measure the value by.
    adapted : whether the disturbance knows the delays so far. energy : the error counts in each step, or in
        the last alone.

    Ends when the value has faded to ``tolerance`` of the price, or, with ``energy``, changes by less.
    """
    n, whole = mean.shape
    width = whole - n
    # Q: value function. S: the same without further disturbances, which is all that one fixed in advance has
    # of what the delays will do.
    Q, S = np.zeros((n, n)), np.zeros((n, n))
    A0, A1 = np.ascontiguousarray(mean[:, :n]), np.ascontiguousarray(random[:, :n])
    mean_t, random_t = np.ascontiguousarray(mean.T), np.ascontiguousarray(random.T)
    A0_t, A1_t = np.ascontiguousarray(A0.T), np.ascontiguousarray(A1.T)
    factor, won = np.zeros((width, width)), np.zeros((width, n))
    value = 0.0
    for step in range(most_steps):
        counts = energy or step == 0
        game = np.dot(np.dot(mean_t, Q), mean)
        game += np.dot(np.dot(random_t, Q if adapted else S), random)
        if counts:
            game += error
        if not adapted:
            S = np.dot(np.dot(A0_t, S), A0) + np.dot(np.dot(A1_t, S), A1)
            if counts:
                S += error[:n, :n]
        # Cholesky factor of what is left of the price, and what the disturbance can make of it.
        for i in range(width):
            for j in range(i + 1):
                left = (price if i == j else 0.0) - game[n + i, n + j]
                for k in range(j):
                    left -= factor[i, k] * factor[j, k]
                if i == j:
                    if not left > 0.0:
                        return False
                    factor[i, i] = math.sqrt(left)
                else:
                    factor[i, j] = left / factor[j, j]
        for i in range(width):
            for c in range(n):
                right = game[n + i, c]
                for k in range(i):
                    right -= factor[i, k] * won[k, c]
                won[i, c] = right / factor[i, i]
        before, value = value, 0.0
        for i in range(n):
            for j in range(n):
                gained = game[i, j]
                for k in range(width):
                    gained += won[k, i] * won[k, j]
                Q[i, j] = gained
                value += gained * weight[i, j]
        if (abs(value - before) if energy else value) <= tolerance * price:
            return True
    return False
