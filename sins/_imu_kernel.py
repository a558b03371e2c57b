"""The compiled sum of an increment and the errors that most units have."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from numba import njit

from ._kernels import COMPILED


@njit(**COMPILED)
def add_errors(ideal, jitter, bias, noise_sd, normal, increments):
    """Fill ``increments`` (n, 3) with the sum of ``ideal`` (n, 3), the steps of ``jitter`` (n, 3), ``bias``
    (3,) and ``noise_sd`` times ``normal`` (n, 3); row 0 is zero. Jitter and normal may have no rows."""
    increments[0] = 0.0
    for k in range(1, len(ideal)):
        for j in range(3):
            value = ideal[k, j]
            if len(jitter) > 0:
                value += jitter[k, j] - jitter[k - 1, j]
            value += bias[j]
            if len(normal) > 0:
                value += noise_sd * normal[k, j]
            increments[k, j] = value
