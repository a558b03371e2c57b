"""Localisation of large networks: beside other optimisers on one problem, and how its time grows."""

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from fleetalign.network.localization._cold_start import linear_start
from fleetalign.network.localization._rows import by_rows
from fleetalign.network.localization.large import RANGE_SD_M, draw_large, large_study, localize_large
from fleetalign.network.localization.problem import RangeProblem
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from .harness import Harness, Row, package_version
from .material import SEED, Material

PEER_NODES = 1_000
"""Of the full size."""
GROWTH_LIMIT = 1.5
COLD_LIMITS_S = (20.0, 180.0)
MEMORY_LIMIT_MB = 4_000.0


def rows(harness: Harness, material: Material) -> list[Row]:
    """Peers on a thousand nodes; time a node and cold starts up to a million."""
    return [*_peers(harness), *_growth(harness), *_cold(harness)]


def _drawn(nodes: int) -> tuple[RangeProblem, np.ndarray]:
    rng = np.random.default_rng(SEED)
    truth, problem = draw_large(nodes, rng)
    return problem, truth + RANGE_SD_M * rng.standard_normal(truth.shape)


def _peers(harness: Harness) -> list[Row]:
    """Whole solves of ours, with outcomes, against the optimiser's run alone."""
    nodes = min(PEER_NODES, harness.size.nodes // 25)
    problem, near = _drawn(nodes)
    with by_rows(problem, None) as ordered:
        linear = np.empty_like(near)
        linear[ordered.order] = linear_start(ordered, problem.anchor_x[ordered.order])
    ours = {
        "near": partial(localize_large, problem, near, covariance_draws=0),
        "cold": partial(localize_large, problem, covariance_draws=0),
    }
    found = []
    for name, start, rounds in (("near", near, 5), ("cold", linear, 2)):
        subjects: dict[str, Callable[[], Any]] = {"ours": ours[name], "scipy": _scipy(problem, start)}
        if package_version("gtsam"):
            subjects["gtsam"] = _gtsam(problem, start)
        times = harness.times(f"localisation, {name} start", subjects, rounds, clock=time.perf_counter)
        x = ours[name]().x
        located = np.isfinite(x).all(axis=1)
        cost = _cost(problem, x, located)
        for package in ("gtsam", "scipy"):
            what = f"Localisation of {nodes:,} nodes, {name} start, beside {package}"
            mine = f"{1e3 * times['ours'].best:.1f} ms (median {1e3 * times['ours'].median:.1f})"
            if package not in times:
                found.append(Row(what, mine, "not installed", "", note=NOTES[package, name]))
                continue
            theirs = times[package]
            excess = _cost(problem, subjects[package](), located) / cost
            ratio = theirs.best / times["ours"].best
            found.append(
                Row(
                    what,
                    mine,
                    f"{1e3 * theirs.best:.0f} ms (median {1e3 * theirs.median:.0f}),"
                    f" {excess:.6f} times the cost",
                    f"{ratio:.3g} times",
                    "not slower, at the same cost or lower" if package == "gtsam" else "",
                    ratio >= 1 and excess > 1 - 1e-6 if package == "gtsam" else None,
                    NOTES[package, name],
                )
            )
    return found


NOTES = {
    (
        package,
        start,
    ): f"{optimiser}, {where}. Ours is the whole call, with the outcome of each node; theirs the"
    " optimiser alone, its problem built beforehand. The cost is over links between nodes that ours located,"
    " by one function."
    for package, optimiser in (
        (
            "gtsam",
            "`LevenbergMarquardtOptimizer.optimize` with a `RangeFactor3` a link and anchors held to 1 mm",
        ),
        ("scipy", "`least_squares` by `trf` and `lsmr` with a sparse Jacobian"),
    )
    for start, where in (
        ("near", "from the same start, a standard deviation of a range from the truth"),
        ("cold", "from the linear solution with which ours begins, since it has no cold start"),
    )
}


def _cost(problem: RangeProblem, x: np.ndarray, keep: np.ndarray) -> float:
    """Half the sum of squared, weighted residuals over links between nodes to keep."""
    links = keep[problem.links].all(axis=1)
    i, j = problem.links[links].T
    residual = (np.linalg.norm(x[i] - x[j], axis=1) - problem.ranges[links]) / problem.range_sd[links]
    return 0.5 * float(residual @ residual)


def _gtsam(problem: RangeProblem, start: np.ndarray) -> Callable[[], np.ndarray]:
    gtsam = import_module("gtsam")
    # Equality constraints would make every elimination of its Cholesky a slow one.
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for (i, j), r, sd in zip(problem.links, problem.ranges, problem.range_sd, strict=True):
        graph.add(gtsam.RangeFactor3(int(i), int(j), float(r), gtsam.noiseModel.Isotropic.Sigma(1, sd)))
    for k in np.flatnonzero(problem.anchor):
        graph.add(gtsam.PriorFactorPoint3(int(k), problem.anchor_x[k], tight))
    for k, known in enumerate(problem.anchor):
        values.insert(k, (problem.anchor_x if known else start)[k])

    def work() -> np.ndarray:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return np.array([result.atPoint3(k) for k in range(problem.nodes)])

    return work


def _scipy(problem: RangeProblem, start: np.ndarray) -> Callable[[], np.ndarray]:
    free = ~problem.anchor
    i, j = problem.links.T
    column = np.cumsum(free) - 1
    ends = [(np.flatnonzero(free[end]), end, sign) for end, sign in ((i, 1.0), (j, -1.0))]
    places = (
        np.concatenate([np.repeat(k, 3) for k, _, _ in ends]),
        np.concatenate([(3 * column[end[k], None] + np.arange(3)).ravel() for k, end, _ in ends]),
    )

    def whole(flat: np.ndarray) -> np.ndarray:
        x = problem.anchor_x.copy()
        x[free] = flat.reshape(-1, 3)
        return x

    def residual(flat: np.ndarray) -> np.ndarray:
        x = whole(flat)
        return (np.linalg.norm(x[i] - x[j], axis=1) - problem.ranges) / problem.range_sd

    def jacobian(flat: np.ndarray) -> csr_matrix:
        x = whole(flat)
        u = (x[i] - x[j]) / (np.linalg.norm(x[i] - x[j], axis=1) * problem.range_sd)[:, None]
        values = np.concatenate([sign * u[k].ravel() for k, _, sign in ends])
        return csr_matrix((values, places), shape=(len(i), 3 * int(free.sum())))

    def work() -> np.ndarray:
        return whole(least_squares(residual, start[free].ravel(), jacobian, tr_solver="lsmr").x)

    return work


def _growth(harness: Harness) -> list[Row]:
    sizes = (10_000, 1_000_000) if harness.size.nodes >= 1_000_000 else (1_000, harness.size.nodes)
    drawn = {nodes: _drawn(nodes) for nodes in sizes}
    subjects = {
        f"{nodes:,}": partial(localize_large, problem, near, covariance_draws=0)
        for nodes, (problem, near) in drawn.items()
    }
    repeats = {f"{sizes[0]:,}": 5}
    times = harness.times(
        "localisation, growth", subjects, rounds=3, repeats=repeats, clock=time.perf_counter
    )
    small, large = (times[f"{nodes:,}"].best / nodes for nodes in sizes)
    return [
        Row(
            f"Localisation of {sizes[1]:,} nodes, near start",
            f"{1e6 * large:.2f} us a node",
            f"of {sizes[0]:,}: {1e6 * small:.2f} us a node",
            f"{large / small:.3g} of its time",
            f"at most {GROWTH_LIMIT}",
            large / small <= GROWTH_LIMIT,
            "`network.localization.large.localize_large` from a standard deviation of a range off the truth,"
            " the whole call with the outcome of each node, without covariances, on all cores, in wall time.",
        )
    ]


def _cold(harness: Harness) -> list[Row]:
    found = []
    most = harness.size.nodes
    for nodes, limit in zip((most // 10, most), COLD_LIMITS_S, strict=True):
        study: dict[str, float] = {}
        harness.times(
            "localisation, cold",
            {"ours": lambda nodes=nodes, study=study: study.update(large_study(nodes, SEED))},
            rounds=1,
            clock=time.perf_counter,
            warm_up=False,
        )
        memory = study["peak_memory_mb"]
        reached = study["cold_s"] < limit and study["median_error_sd"] < 1 and not memory > MEMORY_LIMIT_MB
        found.append(
            Row(
                f"Localisation of {nodes:,} nodes from nothing",
                f"{study['cold_s']:.1f} s, peak {memory / 1e3:.2f} GB",
                f"median error {study['median_error_sd']:.2f} sd of a range; located"
                f" {100 * study['located_share']:.2f} %, bad {100 * study['bad_share']:.3f} %",
                "",
                f"under {limit:.0f} s and {MEMORY_LIMIT_MB / 1e3:.0f} GB, median under 1 sd",
                reached,
                f"`localize_large` with covariances over {study['links']:,.0f} links, {study['anchors']:,.0f}"
                " anchors; in wall time on all cores, other work on the machine counts against it. The peak"
                " is that of the process. Bad: counts as located and is off by more than 5 sd of a range"
                " and of its own.",
            )
        )
    return found
