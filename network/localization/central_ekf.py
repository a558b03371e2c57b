"""Central refinement of Wan, Wu and Feng: the positions of all nodes in one state of one fading filter.

`refine_central` with ``dense=True`` works equations (8) to (20) out with whole matrices, as printed; Q and R
by Sage's method are then whole matrices too. Its sparse form goes by the information matrix, which stays as
sparse as H^T H only as long as nothing is added to P: Q is zero there, as nodes stand still, R is diagonal,
and what fading forgets is put back as at the start. Without Q and fading the two forms are one filter.

H of the printed example (five nodes, two of them unknown) has the derivatives of z(4) and z(5) by node 4 in
the columns of node 3; `fig_2_derivatives` gives both.
"""

from typing import Literal

import numpy as np

from ._fading import LOST_M
from .distributed_ekf import RefinedPlane
from .fading_ekf import FadingEkf, initial, sage_share, step, stopped
from .plane import distances
from .plane_network import PlaneNetwork, plane_network
from .problem import Array, RangeProblem

_PROBES = 8
"""Random signs that tr(H P H^T) is estimated by, which the sparse form has no other use for (Hutchinson):
of some hundred ranges to a few per cent."""


def refine_central(
    problem: RangeProblem,
    x0: Array,
    settings: FadingEkf | None = None,
    dense: bool = False,
    covariance: bool = True,
) -> RefinedPlane:
    """Steps over a network in the plane (`plane.in_plane`) from a start x0 (n, 2) m, all nodes together.

    Nodes whose start is NaN take no part. Raises `LocalizationError` for a start of another shape. The sparse
    form takes ``noise="sage_husa"`` for ``"positive"``: what is left of R's diagonal could be negative.
    Without ``covariance`` its P is NaN: of thousands of nodes it is most of the work.
    """
    settings = settings or FadingEkf()
    net = plane_network(problem, x0)
    if not net.free.any():
        return _refined(net, net.x, np.zeros((0, 2, 2)), 0, True, False)
    return _by_matrices(net, settings) if dense else _by_information(net, settings, covariance)


def _by_information(net: PlaneNetwork, settings: FadingEkf, covariance: bool) -> RefinedPlane:
    """(8) to (20) with Y = P^-1: ``Y^- = Y / lambda``, ``Y = Y^- + H^T R^-1 H``.

    Where the ranges hold a node in one direction alone, fading would let P grow without end in the other:
    ``(1 - 1 / lambda) Y_0`` keeps it at what it was at the start.
    """
    x, N, m = net.x, net.unknowns, len(net.links)
    Y_0 = settings.initial_sd_m**-2.0
    Y = net.entries(net.predicted(x)[1], np.zeros(m), Y_0)
    R, lam, k, ended, lost = np.full(m, settings.range_sd_m**2), 1.0, 0, False, False
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (m, _PROBES))
    factor = net.factorized(Y)
    while k < settings.max_steps and not (ended or lost):
        d, H = net.predicted(x)
        innovation = net.ranges - d
        H_T = H.T
        M = factor.squares(H_T @ signs) / _PROBES
        share = lam / (1 + lam) if k else 0.5
        N_trace = share * float(innovation @ innovation) - R.sum()
        lam = float(np.clip(N_trace / M, 1.0, settings.max_fading)) if M > 0 else 1.0
        Y = net.entries(H, 1 / R, (1 - 1 / lam) * Y_0) + Y / lam
        factor, k = net.factorized(Y), k + 1
        moved = factor.solve(H_T @ (innovation / R))
        before, x = x, net.moved(x, moved)
        if settings.noise != "fixed":
            left = innovation - H @ moved
            # (m,) estimate of the diagonal of H P H^T
            spread = np.maximum(np.mean(signs * (H @ factor.solve(H_T @ signs)), axis=1), 0.0)
            weight = sage_share(k, settings.sage_forgetting)
            R = (1 - weight) * R + weight * (left**2 + spread)
        lost = not np.abs(x).max() < LOST_M
        ended = not lost and stopped(x[net.free], before[net.free], settings)
    own = factor.own_blocks() if covariance else np.full((N // 2, 2, 2), np.nan)
    return _refined(net, x, own, k, ended, lost)


def _by_matrices(net: PlaneNetwork, settings: FadingEkf) -> RefinedPlane:
    x, free, m = net.x, net.free, len(net.links)
    f = initial(x[free].ravel(), m, settings)
    heard, ended, lost = np.ones(m, np.bool_), False, False
    while f.steps < settings.max_steps and not (ended or lost):
        d, H = net.predicted(x)
        with np.errstate(all="ignore"):
            after = step(f, net.ranges - d, H.toarray(), settings, heard)
        sizes = [np.abs(values).max() for values in (after.P, after.Q, after.R, after.x * LOST_M)]
        lost = not max(sizes) < LOST_M**2
        if lost:
            break
        f, before = after, x
        x = x.copy()
        x[free] = f.x.reshape(-1, 2)
        ended = stopped(x[free], before[free], settings)
    k = int(free.sum())
    own = f.P.reshape(k, 2, k, 2)[np.arange(k), :, np.arange(k), :]
    return _refined(net, x, own, f.steps, ended, lost)


def _refined(net: PlaneNetwork, x: Array, own: Array, steps: int, ended: bool, lost: bool) -> RefinedPlane:
    P = np.zeros((net.problem.nodes, 2, 2))
    P[net.free] = own
    return RefinedPlane(np.where(net.part[:, None], x, np.nan), P, steps, ended, net.free & lost)


def fig_2_derivatives(nodes: Array, form: Literal["printed", "mended"] = "mended") -> tuple[Array, Array]:
    """Distances (5,) of the paper's Fig. 2 and H (5, 4), at positions (5, 2) of its nodes 1 to 5.

    Rows are the ranges 2-3, 3-5, 3-4, 4-1 and 4-5; columns the positions of node 3 and of node 4. As printed,
    rows 4 and 5 tell of node 3 what is true of node 4.
    """
    pairs = np.array([[2, 1], [2, 4], [2, 3], [3, 0], [3, 4]])
    d, u = (values[:, 0] for values in distances(nodes[pairs[:, 0]], nodes[pairs[:, 1], None]))
    H = np.zeros((5, 4))
    H[:3, :2], H[2, 2:] = u[:3], -u[2]
    H[3:, slice(0, 2) if form == "printed" else slice(2, 4)] = u[3:]
    return d, H
