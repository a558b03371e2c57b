"""Compiled location of one node by its references, looked for on either side of them.

A reference is a node whose place is taken as known: position, range, +-1 for the sign of the clock offset in
that range, and weight.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED
from ._cholesky import factorize, substitute
from ._dense import robust

_FLOOR = 1e-10
_STEPS = 15
_SAME = 9.0
NO_MIRROR = 1e9
"""Margin of a position whose mirror image falls back on itself."""


@njit(**COMPILED)
def normal_equations(s, refs, rho, sign, w, loss, height, w_height, curvature, H, g):
    """Write the normal equations of one node at ``s`` (4,), north, east, down, clock in m; return the
    cost."""
    kind, threshold, p = int(loss[0]), loss[1], len(g)
    H[:] = 0.0
    g[:] = 0.0
    u = np.zeros(4)
    cost = 0.0
    for k in range(len(rho)):
        x, y, z = s[0] - refs[k, 0], s[1] - refs[k, 1], s[2] - refs[k, 2]
        d = math.sqrt(x * x + y * y + z * z)
        inverse = 1 / d if d > 0 else 0.0
        u[0], u[1], u[2], u[3] = x * inverse, y * inverse, z * inverse, sign[k]
        r = rho[k] - d - sign[k] * s[3]
        c, weight = robust(r * math.sqrt(w[k]), kind, threshold)
        cost += c
        for a in range(p):
            g[a] += w[k] * weight * r * u[a]
            for b in range(p):
                H[a, b] += w[k] * weight * u[a] * u[b]
    if w_height > 0:
        r = height + s[2] - 0.5 * curvature * (s[0] ** 2 + s[1] ** 2)
        cost += 0.5 * w_height * r * r
        u[0], u[1], u[2] = curvature * s[0], curvature * s[1], -1.0
        for a in range(3):
            g[a] += w_height * r * u[a]
            for b in range(3):
                H[a, b] += w_height * u[a] * u[b]
    for a in range(p):
        H[a, a] += _FLOOR
    return cost


@njit(**COMPILED)
def descend(s, refs, rho, sign, w, loss, height, w_height, curvature, H, g):
    """Damped Gauss-Newton of one node, in place of ``s``; return the cost, with ``H`` and ``g`` there."""
    p = len(g)
    cost = normal_equations(s, refs, rho, sign, w, loss, height, w_height, curvature, H, g)
    H_new, g_new, A, step = np.empty((p, p)), np.empty(p), np.empty((p, p)), np.empty(p)
    damping = 1e-3
    for _ in range(_STEPS):
        A[:] = H
        for a in range(p):
            A[a, a] *= 1 + damping
        step[:] = g
        factorize(A)
        substitute(A, step)
        gain = 0.0
        for a in range(p):
            gain += step[a] * g[a]
        if gain < 1e-6:
            break
        trial = s.copy()
        trial[:p] += step
        new_cost = normal_equations(
            trial, refs, rho, sign, w, loss, height, w_height, curvature, H_new, g_new
        )
        if new_cost <= cost:
            s[:] = trial
            cost = new_cost
            H[:] = H_new
            g[:] = g_new
            damping *= 0.1
        else:
            damping *= 10
    return cost


@njit(**COMPILED)
def linear_start(refs, rho, sign, w, axes, centre, length, height, w_height, curvature, p):
    """Position (4,) of a node from the differences of its squared ranges (Theorem 1 of Gao et al.).

    ``2 x . x_k - 2 s_k rho_k b - q = |x_k|^2 - rho_k^2`` with ``q = |x|^2 - b^2`` is linear in x, b and q,
    each line weighted by the standard deviation of its right-hand side. Taken along the principal ``axes``
    of the references, so that a small ridge keeps what coplanar references leave unknown at their plane.
    """
    N = np.zeros((p + 1, p + 1))
    f = np.zeros(p + 1)
    row = np.zeros(p + 1)
    for k in range(len(rho)):
        square = 0.0
        for a in range(3):
            along = 0.0
            for c in range(3):
                along += axes[c, a] * (refs[k, c] - centre[c])
            row[a] = 2 * along
            square += along * along
        if p == 4:
            row[3] = -2 * sign[k] * rho[k]
        row[p] = -length
        weight = w[k] / (4 * max(rho[k] * rho[k], 1.0))
        for a in range(p + 1):
            f[a] += weight * row[a] * (square - rho[k] ** 2)
            for b in range(p + 1):
                N[a, b] += weight * row[a] * row[b]
    if w_height > 0:
        down = -height + 0.5 * curvature * (centre[0] ** 2 + centre[1] ** 2) - centre[2]
        for a in range(3):
            f[a] += w_height * axes[2, a] * down
            for b in range(3):
                N[a, b] += w_height * axes[2, a] * axes[2, b]
    ridge = 0.0
    for a in range(p + 1):
        ridge += 1e-9 * N[a, a]
    for a in range(p + 1):
        N[a, a] += ridge
    factorize(N)
    substitute(N, f)
    s = np.zeros(4)
    for c in range(3):
        s[c] = centre[c]
        for a in range(3):
            s[c] += axes[c, a] * f[a]
    if p == 4:
        s[3] = f[3]
    return s


@njit(**COMPILED)
def locate(start, refs, rho, sign, w, loss, height, w_height, curvature, p):
    """The better of the two optima on either side of the plane that fits the references best.

    ``start`` (4,) is a place to begin from, or NaN for the linear solution. Returns the state (4,), its
    information (p, p), the other state, and by how much twice the cost is higher there. The other side is
    looked for at the mirror image and along the least known direction.
    """
    m = len(rho)
    centre = np.zeros(3)
    total = 0.0
    for k in range(m):
        total += w[k]
        for c in range(3):
            centre[c] += w[k] * refs[k, c]
    centre /= total
    scatter = np.zeros((3, 3))
    for k in range(m):
        for a in range(3):
            for b in range(3):
                scatter[a, b] += w[k] / total * (refs[k, a] - centre[a]) * (refs[k, b] - centre[b])
    values, axes = np.linalg.eigh(scatter)
    normal = axes[:, 0]
    length = math.sqrt(values[2]) + 1.0
    first = start.copy()
    cold = math.isnan(start[0])
    if cold:
        first = linear_start(refs, rho, sign, w, axes, centre, length, height, w_height, curvature, p)
    off = 0.0
    for c in range(3):
        off += normal[c] * (first[c] - centre[c])
    reach = abs(off)
    if cold:
        # Along the normal the differences say least; the ranges themselves say how far off the plane it is.
        square = 0.0
        for k in range(m):
            r = rho[k] - sign[k] * first[3]
            square += w[k] / total * r * r
            for c in range(3):
                square -= w[k] / total * (first[c] - refs[k, c]) ** 2
        reach = math.sqrt(max(square + off * off, 0.0))
    reach = max(reach, 0.02 * length)
    side = 1.0 if off >= 0 else -1.0
    second = first.copy()
    for c in range(3):
        second[c] += normal[c] * (-side * reach - off)
        if cold:
            first[c] += normal[c] * (side * reach - off)
    H, g, H2 = np.empty((p, p)), np.empty(p), np.empty((p, p))
    cost = descend(first, refs, rho, sign, w, loss, height, w_height, curvature, H, g)
    rival, rival_cost = first, np.inf
    for attempt in range(2):
        if attempt == 1:
            second = beyond(first, H, refs, w)
        other_cost = descend(second, refs, rho, sign, w, loss, height, w_height, curvature, H2, g)
        apart = 0.0
        for a in range(p):
            for b in range(p):
                apart += (first[a] - second[a]) * H[a, b] * (first[b] - second[b])
        if apart < _SAME:
            if other_cost < cost:
                first, cost = second, other_cost
                H[:] = H2
        elif other_cost < cost:
            first, cost, rival, rival_cost = second, other_cost, first, cost
            H[:] = H2
        elif other_cost < rival_cost:
            rival, rival_cost = second, other_cost
    return first, H, rival, min(2 * (rival_cost - cost), NO_MIRROR)


@njit(**COMPILED)
def beyond(s, H, refs, w):
    """Where squared distances to the references come back to what they are at ``s``, along its least known
    direction.

    Over a step t along the unit vector v they change by ``2 p_k t + t^2``, p_k = v . (x - x_k); of the sum
    of the squares of that, weighted for ranges, this is the other minimum, or where it all but has one.
    """
    vector = np.linalg.eigh(H[:3, :3])[1][:, 0]
    pp, pq, qq = 0.0, 0.0, 0.0
    for k in range(len(w)):
        x, y, z = s[0] - refs[k, 0], s[1] - refs[k, 1], s[2] - refs[k, 2]
        along = vector[0] * x + vector[1] * y + vector[2] * z
        a = w[k] / (x * x + y * y + z * z + 1)
        pp += a * along * along
        pq += a * along
        qq += a
    root = math.sqrt(max(9 * pq * pq - 8 * pp * qq, 0.0))
    t = (-3 * pq - math.copysign(root, pq)) / (2 * qq)
    after = s.copy()
    after[:3] += t * vector
    return after


@njit(**COMPILED)
def inverse_of(H):
    p = len(H)
    C = np.zeros((p, p))
    factor = H.copy()
    factorize(factor)
    for a in range(p):
        C[a, a] = 1.0
        substitute(factor, C[a])
    return C
