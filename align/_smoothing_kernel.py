"""The compiled backward pass of the fixed-interval smoother, over what the filter kept of every epoch.

Modified Bryson-Frazier recursion: the adjoint ``y``, shape (n,), and its covariance ``Y``, (n, n), go back
through transitions and updates; with the filtered covariance P they give the smoothed error ``-P y`` and its
covariance ``P - P Y P``. No covariance is inverted, so states that do not move (delay, lever arm) need no
care.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ..sins._kernels import COMPILED
from ._kernels import ESTIMATED, correct, kinematics, predict, update
from ._state_kernel import start


@njit(**COMPILED)
def back_through_update(y, Y, H, S, K, innovation):
    """``y <- A' y - H' S^-1 z`` and ``Y <- A' Y A + H' S^-1 H`` with ``A = I - K H``.

    ``S``, shape (6, 6), holds the Cholesky factor of the innovation's covariance in its lower triangle.
    """
    n = len(y)
    z, L_H = innovation.copy(), H.copy()
    for i in range(6):
        for k in range(i):
            z[i] -= S[i, k] * z[k]
            for c in range(n):
                L_H[i, c] -= S[i, k] * L_H[k, c]
        z[i] /= S[i, i]
        for c in range(n):
            L_H[i, c] /= S[i, i]
    gain_y, gain_Y = K.T @ y, K.T @ Y
    Y -= H.T @ gain_Y
    Y -= (Y @ K) @ H
    Y += L_H.T @ L_H
    y -= H.T @ gain_y + L_H.T @ z


@njit(**COMPILED)
def back_through_transition(y, Y, Phi):
    """``y <- Phi' y`` and ``Y <- Phi' Y Phi``; of ``Phi`` the first nine rows, (9, 15), the rest is the
    identity."""
    change = Phi.copy()
    for i in range(9):
        change[i, i] -= 1.0
    y[:15] += change.T @ y[:9].copy()
    Y[:15] += change.T @ Y[:9].copy()
    Y[:, :15] += Y[:, :9].copy() @ change


@njit(**COMPILED)
def smooth(
    time,
    increments,
    gap_variance,
    fixes,
    restarts,
    delay_model,
    delay_sd,
    initial,
    initial_sd,
    noise_density,
    vibration_variance,
    samples,
    gravity_model,
    output_epoch,
    X_kept,
    P_kept,
    outputs,
    memory,
):
    """Go back over a filtered record, from its end to the first fix.

    Parameters, where they are not those of `_alignment_kernel.align`
    ----------
    fixes : `reception.Reception` of those that it applied, in order. restarts (k,) : which of them,
        but for the first, it started again from.
    X_kept (n, 22), P_kept (n, n_states, n_states) : its state and covariance at each epoch, before the fixes
    there.
    outputs : tuple of X (m, 22), variances (m, n_states), misalignment covariance (m, 3, 3), which are
    filled.
    """
    fix_lla, fix_v_n, fix_cov, t_reference = fixes.lla, fixes.v_n, fixes.cov, fixes.t_reference
    fix_epoch = fixes.reference_epoch
    X_out, variance_out, misalignment_out = outputs
    motion, innovation, work, buffers = memory
    C, f_n, w_b, arm, u = motion
    H, _, S, _, K, _, _, _ = buffers
    n_states = len(initial_sd)
    y, Y = np.zeros(n_states), np.zeros((n_states, n_states))
    X, P = np.empty_like(X_kept[0]), np.empty_like(P_kept[0])
    X_next, P_next = X.copy(), P.copy()
    here = 8
    H_here, S_here, K_here = (
        np.empty((here, 6, n_states)),
        np.empty((here, 6, 6)),
        np.empty((here, n_states, 6)),
    )
    z_here = np.empty((here, 6))
    estimated = delay_model == ESTIMATED
    last, output = len(fix_epoch), len(output_epoch)
    for k in range(len(time) - 1, -1, -1):
        # What the filter did here, once more.
        first = last
        while first > 0 and fix_epoch[first - 1] == k:
            first -= 1
        X[:], P[:] = X_kept[k], P_kept[k]
        applied, restarted = 0, first == 0
        for f in range(first, last):
            if restarts[f]:
                # Nothing after it tells of what was before.
                start(X, P, fix_lla[f], fix_v_n[f], fix_cov[f], initial, initial_sd)
                applied, restarted = 0, True
            kinematics(X, time, increments, k, samples, gravity_model, C, f_n, w_b, arm, u)
            age = time[k] - t_reference[f] + (X[16] if estimated else 0.0)
            update(
                X,
                P,
                fix_lla[f],
                fix_v_n[f],
                fix_cov[f],
                vibration_variance,
                age,
                delay_sd,
                estimated,
                C,
                f_n,
                w_b,
                arm,
                u,
                math.inf,
                innovation,
                buffers,
            )
            if applied == len(z_here):
                H_here, S_here = np.concatenate((H_here, H_here)), np.concatenate((S_here, S_here))
                K_here, z_here = np.concatenate((K_here, K_here)), np.concatenate((z_here, z_here))
            H_here[applied], S_here[applied], K_here[applied], z_here[applied] = H, S, K, innovation
            applied += 1
        last = first
        if k < len(time) - 1:
            X_next[:], P_next[:] = X, P
            predict(X_next, P_next, time, increments, gap_variance, k + 1, noise_density, gravity_model, work)
            back_through_transition(y, Y, work[0])
        if output > 0 and output_epoch[output - 1] == k:
            output -= 1
            PY = P @ Y
            P_smoothed = P - PY @ P
            X_next[:] = X
            correct(X_next, -(P @ y))
            X_out[output] = X_next
            for i in range(n_states):
                variance_out[output, i] = P_smoothed[i, i]
            misalignment_out[output] = P_smoothed[6:9, 6:9]
        if restarted:
            y[:], Y[:] = 0.0, 0.0
        else:
            for f in range(applied - 1, -1, -1):
                back_through_update(y, Y, H_here[f], S_here[f], K_here[f], z_here[f])
        if first == 0:
            return
