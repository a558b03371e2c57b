"""The compiled loop of an observer with given gains: navigate, and correct by each fix as it arrives."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED, advance, rotate_attitude
from ...sins.earth import radii_of_curvature

SLOWEST_COURSE_MPS = 1.0
"""Below this speed the course is taken for north: gains at rest hardly depend on it."""


@njit(**COMPILED)
def run(time, increments, q_initial, fixes, window_s, vertices, gains, gravity_model, output_epoch, outputs):
    """Run over a record. Returns (epoch at which it started, or n; whether it stayed finite).

    Parameters (n epochs, k fixes, m outputs, s vertices)
    ----------
    time (n,), increments (n, 6) : record. q_initial (4,) : attitude at epoch 0.
    fixes : tuple of epoch (k,) at which each is taken, not decreasing, lla (k, 3), v_n (k, 3), age s (k,).
    window_s : time constant over which the specific force is averaged.
    vertices (s,), gains (s, 9, 6) : side forces, m/s^2, increasing, and for each the gain from [position;
        velocity] to [position; velocity; misalignment], in axes along the course, to the right of it, down.
    output_epoch (m,). outputs : tuple of X (m, 10), lla, v_n, q_nb, and innovation (k, 6).
    """
    epoch, fix_lla, fix_v_n, age = fixes
    X_out, innovation_out = outputs
    X, f_n, f_mean, increment, previous = (
        np.zeros(10),
        np.zeros(3),
        np.zeros(3),
        np.zeros(6),
        np.zeros(6),
    )
    before, z, dx = np.zeros(3), np.zeros(6), np.zeros(9)
    X[6:10] = q_initial
    n, n_fixes, n_vertices = len(time), len(epoch), len(vertices)
    start, fix, output = n, 0, 0
    for k in range(n):
        if k > 0:
            dt = time[k] - time[k - 1]
            for i in range(6):
                increment[i] = increments[k, i]
                previous[i] = increments[k - 1, i] if k > 1 else 0.0
            if start == n and n_fixes > 0:
                # Only the attitude is carried on before the first fix, at its place.
                for i in range(3):
                    X[i], X[3 + i] = fix_lla[0, i], fix_v_n[0, i]
            for i in range(3):
                before[i] = X[3 + i]
            advance(X[0:3], X[3:6], X[6:10], increment, previous, dt, gravity_model, f_n)
            share = min(1.0, dt / window_s)
            for i in range(3):
                f_mean[i] = f_n[i] if k == 1 else f_mean[i] + share * (f_n[i] - f_mean[i])
        else:
            dt = 1.0
            before[:] = X[3:6]
        while fix < n_fixes and epoch[fix] == k:
            if start == n:
                start = k
                for i in range(3):
                    X[i], X[3 + i] = fix_lla[fix, i], fix_v_n[fix, i]
                fix += 1
                continue
            R_N, R_E = radii_of_curvature(X[0])
            north, east = R_N + X[2], (R_E + X[2]) * math.cos(X[0])
            z[0] = (X[0] - fix_lla[fix, 0]) * north
            turned = X[1] - fix_lla[fix, 1]
            turned -= 2 * math.pi * round(turned / (2 * math.pi))  # the date line may lie between
            z[1] = turned * east
            z[2] = fix_lla[fix, 2] - X[2]
            for i in range(3):
                z[3 + i] = X[3 + i] - fix_v_n[fix, i] - age[fix] * (X[3 + i] - before[i]) / dt
                z[i] -= age[fix] * X[3 + i]
            for i in range(6):
                innovation_out[fix, i] = z[i]

            speed = math.hypot(X[3], X[4])
            c, s = (X[3] / speed, X[4] / speed) if speed > SLOWEST_COURSE_MPS else (1.0, 0.0)
            side = c * f_mean[1] - s * f_mean[0]
            for i in (0, 3):
                z[i], z[i + 1] = c * z[i] + s * z[i + 1], c * z[i + 1] - s * z[i]
            # Gains between two vertices, and those of the outer ones beyond.
            right = 0
            while right < n_vertices and vertices[right] < side:
                right += 1
            left = max(right - 1, 0)
            right = min(right, n_vertices - 1)
            weight = 0.0
            if right > left:
                weight = (side - vertices[left]) / (vertices[right] - vertices[left])
            for i in range(9):
                dx[i] = 0.0
                for j in range(6):
                    gain = (1 - weight) * gains[left, i, j] + weight * gains[right, i, j]
                    dx[i] += gain * z[j]
            for i in (0, 3, 6):
                dx[i], dx[i + 1] = c * dx[i] - s * dx[i + 1], s * dx[i] + c * dx[i + 1]
            X[0] -= dx[0] / north
            X[1] -= dx[1] / east
            X[2] += dx[2]
            for i in range(3):
                X[3 + i] -= dx[3 + i]
                before[i] -= dx[3 + i]
            rotate_attitude(X[6:10], dx[6], dx[7], dx[8])
            fix += 1
        for i in range(10):
            if not math.isfinite(X[i]):
                return start, False
        if output < len(output_epoch) and output_epoch[output] == k:
            if start < n:
                for i in range(10):
                    X_out[output, i] = X[i]
            output += 1
    return start, True
