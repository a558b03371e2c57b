"""Messages and multiplications of Wan et al.'s two networks, counted in networks of growing size."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import splu

from ...network.localization.central_ekf import refine_central
from ...network.localization.distributed_ekf import refine_distributed
from ...network.localization.plane_network import plane_network
from .results import Array, Form, Metric, Row, Table, Value
from .wan2008_runs import Cell, Network, draw_network
from .wan2008_settings import Refinement

COUNTS = {
    "h_dense": ("entries of H, central", Form.PUBLISHED, "2 n (m - k), the paper's measure"),
    "h_distributed": ("entries of H, distributed", Form.PUBLISHED, "4 m - 2 L - 4 k, the paper's measure"),
    "h_sparse": (
        "entries of H that are not zero, central",
        Form.MENDED,
        "the same number: four or two a link",
    ),
    "dense": ("multiplications a step, central dense", Form.PUBLISHED, "of (10) and (17) to (20)"),
    "sparse": (
        "multiplications a step, central sparse",
        Form.MENDED,
        "H^T R^-1 H, its factor of least fill, the solutions",
    ),
    "distributed": (
        "multiplications a sweep, distributed",
        Form.MENDED,
        "the compiled sweep: 31 a link and 20 a node",
    ),
    "steps_central": ("steps, central", Form.MENDED, "until the stop rule, or the most there may be"),
    "steps_distributed": ("sweeps, distributed", Form.MENDED, "likewise"),
    "messages_step": ("messages, central, every step by the sink", Form.PUBLISHED, "2 hops a node and step"),
    "messages_once": ("messages, central, once to the sink and back", Form.MENDED, "2 hops a node"),
    "messages_distributed": ("messages, distributed", Form.PUBLISHED, "one broadcast a node and sweep"),
    "error_central": ("mean error, central, % of the radius", Form.MENDED, "one network of each size"),
    "error_distributed": ("mean error, distributed, % of the radius", Form.MENDED, "likewise"),
}

_LEAST_FILL = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
"""Of a sparse factor. The filter itself takes a band, which a few hundred nodes are sooner done with."""


@dataclass(frozen=True)
class Costs:
    """What was counted at each number of nodes, NaN where it was not."""

    nodes: Array
    counts: dict[str, Array]
    exponents: dict[str, float]
    """b of count = a n^b by least squares of logarithms over all sizes but the smallest."""


def costs(settings: Refinement, seed: int) -> Costs:
    """One network of each size at the second connectivity and the low share."""
    cell = Cell(settings.connectivities[1], settings.low_share)
    rows = [_counted(settings, cell, n, seed) for n in settings.cost_nodes]
    nodes = np.array(settings.cost_nodes, float)
    counts = {key: np.array([row.get(key, np.nan) for row in rows], float) for key in COUNTS}
    return Costs(nodes, counts, {key: _exponent(nodes, values) for key, values in counts.items()})


def table(found: Costs) -> Table:
    """By the number of nodes, and the exponents."""
    metrics = [Metric(f"n_{n:.0f}", f"{n:.0f}", 0, f"in a network of {n:.0f} nodes") for n in found.nodes]
    metrics.append(
        Metric("exponent", "exponent", 2, "of the number of nodes, over all sizes but the smallest")
    )
    rows: list[Row] = []
    for key, (name, form, about) in COUNTS.items():
        values = {f"n_{n:.0f}": Value(v) for n, v in zip(found.nodes, found.counts[key], strict=True)}
        told = {name: value for name, value in values.items() if np.isfinite(value.value)}
        if not key.startswith(("steps", "error")):
            told["exponent"] = Value(found.exponents[key])
        rows.append(Row(name, form, told, about))
    return Table("cost", "Messages and multiplications by the number of nodes", tuple(metrics), tuple(rows))


def _counted(settings: Refinement, cell: Cell, nodes: int, seed: int) -> dict[str, float]:
    side = settings.side_m * np.sqrt(nodes / settings.nodes)
    net = draw_network(settings.model_copy(update={"nodes": nodes, "side_m": side}), cell, 0, seed)
    ekf = settings.ekf(net.radius, net.range_sd)
    central = refine_central(net.problem, net.start, ekf, covariance=False)
    distributed = refine_distributed(net.problem, net.start, ekf)
    from_plane = _from_plane(net, nodes <= settings.dense_most)
    unknown = int(net.unknown.sum())
    hops = _hops(net)
    return from_plane | {
        "steps_central": central.steps,
        "steps_distributed": distributed.steps,
        "messages_step": 2 * hops * central.steps,
        "messages_once": 2 * hops,
        "messages_distributed": unknown * distributed.steps,
        "error_central": _error(net, central.x),
        "error_distributed": _error(net, distributed.x),
    }


def _error(net: Network, x: Array) -> float:
    return float(100 * np.nanmean(np.linalg.norm(x - net.x, axis=1)[net.unknown]) / net.radius)


def _from_plane(net: Network, dense: bool) -> dict[str, float]:
    """Sizes of the matrices of one step, and the multiplications that they take."""
    plane = plane_network(net.problem, net.start)
    _, H = plane.predicted(plane.x)
    m, N = len(plane.ranges), plane.unknowns
    in_row = np.diff(H.indptr)
    A = plane.normal(plane.entries(H, np.ones(m), 1.0))
    factor = splu(A, **_LEAST_FILL)
    in_column = np.diff(factor.L.tocsc().indptr)
    # A column of c entries below and on the diagonal: c - 1 quotients, and c (c - 1) / 2 products.
    factored = float(np.sum((in_column - 1) * (1 + in_column / 2)))
    solved = 2.0 * factor.L.nnz
    degree = np.bincount(plane.place[plane.links][plane.place[plane.links] >= 0], minlength=N // 2)
    both = int((plane.place[plane.links] >= 0).all(axis=1).sum())
    found = {
        "h_dense": float(N * m),
        "h_distributed": float(4 * both + 2 * (m - both)),
        "h_sparse": float(H.nnz),
        # H^T R^-1 H, H^T R^-1 v, the factor, its solution, H P H^T by eight probes, and A / lambda.
        "sparse": float(np.sum(in_row**2 + 2 * in_row) + factored + 9 * solved + 8 * 2 * H.nnz + A.nnz),
        "distributed": float(np.sum(31 * degree + 20)),
    }
    if dense:
        found["dense"] = float(dense_multiplications(N, m))
    return found


def dense_multiplications(n: int, m: int) -> int:
    """Of one step of n unknowns and m ranges by whole matrices, in the order of the equations."""
    fading = m * n * n + m * n  # (10): H P, and the diagonal of its product with H^T
    predicted = n * n  # (17)
    innovation = m * n * n + m * m * n  # (18): H P^-, and its product with H^T
    gain = m**3 + n * m * m  # (18): the inverse, by elimination, and P^- H^T times it
    update = n * m  # (19)
    covariance = n * n * m + n**3  # (20)
    return fading + predicted + innovation + gain + update + covariance


def _hops(net: Network) -> int:
    """Sum over the unknown nodes of their hops to the sink, the node that is nearest to all of its part."""
    i, j = net.problem.links.T
    n = len(net.x)
    graph = csr_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    hops = dijkstra(graph, directed=False, unweighted=True)
    reached = np.isfinite(hops)
    total = np.where(reached, hops, 0.0).sum(axis=1)
    sink = int(np.argmin(np.where(reached.sum(axis=1) == reached.sum(axis=1).max(), total, np.inf)))
    return int(hops[sink][net.unknown & reached[sink]].sum())


def _exponent(nodes: Array, values: Array) -> float:
    known = np.isfinite(values) & (values > 0)
    known[0] = False
    if known.sum() < 2:
        return np.nan
    return float(np.polyfit(np.log(nodes[known]), np.log(values[known]), 1)[0])
