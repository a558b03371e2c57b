"""Start of a small network by semidefinite programming, where successive location goes astray."""

import warnings

import numpy as np

from .problem import Array, LocalizationError, RangeProblem

MOST_NODES = 50


def sdp_start(problem: RangeProblem) -> Array:
    """Positions (n, 3) m from the relaxation of Biswas and Ye, for up to `MOST_NODES` nodes.

    With ``Y`` in the place of ``X' X``, X (3, k) the unknown positions, squared distances are linear in X
    and Y; the relaxation asks for ``[[I, X], [X', Y]]`` to be positive semidefinite, and for the least sum
    of the differences from the squared ranges, each in its own standard deviations. Exact without noise
    where a network can be realised in one way only, in any number of dimensions. Nodes without links to the
    others stay NaN.

    Raises `LocalizationError` for more nodes, for unknown clock offsets, and where the solver fails.
    """
    import cvxpy as cp  # takes half a second to import

    n = problem.nodes
    if n > MOST_NODES:
        raise LocalizationError(f"the semidefinite start takes up to {MOST_NODES} nodes; got {n}")
    if problem.clocks:
        raise LocalizationError("the semidefinite start takes no unknown clock offsets")
    linked = np.zeros(n, np.bool_)
    linked[problem.links] = True
    free = np.flatnonzero(linked & ~problem.anchor)
    x = np.where(problem.anchor[:, None], problem.anchor_x, np.nan)
    if not len(free):
        return x
    # Kilometres and the anchors' centre keep the numbers near one, which the solver needs.
    centre = problem.anchor_x[problem.anchor].mean(axis=0)
    scale = 1e-3
    place = np.full(n, -1)
    place[free] = np.arange(len(free))
    rows, targets, sds = [], [], []
    for (i, j), distance, sd in zip(problem.links, problem.ranges, problem.range_sd, strict=True):
        vector = np.zeros(3 + len(free))
        for node, sign in ((i, 1.0), (j, -1.0)):
            if problem.anchor[node]:
                vector[:3] += sign * (problem.anchor_x[node] - centre) * scale
            else:
                vector[3 + place[node]] += sign
        if not vector[3:].any():
            continue
        rows.append(np.outer(vector, vector).ravel())
        targets.append((distance * scale) ** 2)
        sds.append(2 * max(distance, sd) * sd * scale**2)
    Z = cp.Variable((3 + len(free), 3 + len(free)), PSD=True)
    weight = np.mean(sds) / np.array(sds)
    misfit = cp.multiply(weight, np.array(rows) @ cp.vec(Z, order="C") - np.array(targets))
    cost = cp.norm1(misfit)
    if problem.height is not None:
        has = np.flatnonzero(np.isfinite(problem.height[free]))
        # A level plane is near enough for a start: the curve below it is tens of metres.
        down = (-problem.height[free[has]] - centre[2]) * scale
        cost += cp.norm1(Z[2, 3 + has] - down) * float(np.mean(sds)) / (problem.height_sd * scale)
    task = cp.Problem(cp.Minimize(cost), [Z[:3, :3] == np.eye(3)])
    try:
        with warnings.catch_warnings():
            # An inaccurate solution is a start like any other.
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)
            task.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise LocalizationError(f"the semidefinite start found no solution: {error}") from error
    if Z.value is None:
        raise LocalizationError(f"the semidefinite start found no solution: {task.status}")
    x[free] = Z.value[:3, 3:].T / scale + centre
    return x
