"""A large network by rows in Morton order, and the cores that work on blocks of them."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _flood, _sparse, _usable
from .problem import Array, Booleans, Integers, NodeOutcome, RangeProblem

Indices = NDArray[np.int32]
ROWS_A_BLOCK = 4096
MOST_BLOCKS = 32
"""Blocks depend on the network alone, and sums go block by block: the number of cores changes nothing."""


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Rows:
    """What `_sparse` works on. Row k is node ``order[k]`` of the problem."""

    order: Integers
    start: Integers
    other: Indices
    ranges: Array
    root_weight: Array
    anchor: Booleans
    fixed: Booleans
    """Anchors, and nodes that are left out."""
    outcome: Integers
    blocks: tuple[tuple[int, int], ...]
    pool: ThreadPoolExecutor | None

    @property
    def links(self) -> tuple[Integers, Indices, Array, Array]:
        """What most loops take first."""
        return self.start, self.other, self.ranges, self.root_weight

    def each(self, loop: Callable[..., Any], *arguments: object) -> list[Any]:
        """Run a loop over each block of rows, on all cores; what it returns, in the order of the blocks."""
        if self.pool is None:
            return [loop(lo, hi, *arguments) for lo, hi in self.blocks]
        return list(self.pool.map(lambda block: loop(*block, *arguments), self.blocks))

    def total(self, loop: Callable[..., float], *arguments: object) -> float:
        """Sum of what a loop returns, in the order of the blocks."""
        return sum(self.each(loop, *arguments))

    def leave_out(self, out: Booleans, outcome: NodeOutcome) -> None:
        """Take nodes out, and then those that cannot be located without them."""
        n = len(out)
        self.outcome[out] = outcome
        out = self.fixed & ~self.anchor | out
        while True:
            before = out.copy()
            _usable.peel(self.start, self.other, self.anchor, out)
            self.outcome[out & ~before] = NodeOutcome.TOO_FEW_NEIGHBOURS
            reach = np.full(n, n, np.int32)
            _usable.anchors_in_reach(self.start, self.other, self.anchor, out, reach)
            # Three anchors leave a group and its mirror image, fewer leave it free to turn.
            self.outcome[reach == 3] = NodeOutcome.AMBIGUOUS
            self.outcome[reach < 3] = NodeOutcome.SINGULAR
            out |= reach < _usable.LEAST_NEIGHBOURS
            if np.array_equal(before, out):
                break
        _usable.drop_links(self.start, self.other, out, self.root_weight)
        self.fixed[out] = True


@contextmanager
def by_rows(problem: RangeProblem, x0: Array | None) -> Iterator[Rows]:
    """The problem by rows, with a pool of threads for as long as it is needed."""
    n = problem.nodes
    order = np.argsort(_morton(_rough(problem) if x0 is None else x0), kind="stable")
    rank = np.empty(n, np.int32)
    rank[order] = np.arange(n, dtype=np.int32)
    start = np.empty(n + 1, np.int64)
    _sparse.count_links(problem.links, rank, start)
    ends = int(start[-1])
    other, ranges, root_weight = np.empty(ends, np.int32), np.empty(ends), np.empty(ends)
    _sparse.fill_rows(
        problem.links, problem.ranges, problem.range_sd, rank, start, other, ranges, root_weight
    )
    count = min(max(n // ROWS_A_BLOCK, 1), MOST_BLOCKS)
    edges = [n * k // count for k in range(count + 1)]
    anchor = problem.anchor[order]
    outcome = np.where(anchor, NodeOutcome.ANCHOR, NodeOutcome.LOCATED).astype(np.int64)
    blocks = tuple(pairwise(edges))
    threads = min(cores(), count)
    pool = ThreadPoolExecutor(threads) if threads > 1 else None
    try:
        rows = Rows(order, start, other, ranges, root_weight, anchor, anchor.copy(), outcome, blocks, pool)
        rows.leave_out(np.zeros(n, np.bool_), NodeOutcome.TOO_FEW_NEIGHBOURS)
        yield rows
    finally:
        if pool is not None:
            pool.shutdown()


def _rough(problem: RangeProblem) -> Array:
    """Positions good enough to say who lies near whom: means of neighbours, outwards from the anchors."""
    n = problem.nodes
    x = np.where(problem.anchor[:, None], problem.anchor_x, 0.0)
    known, total, count = problem.anchor.copy(), np.empty((n, 3)), np.empty(n, np.int32)
    while _flood.spread(problem.links, x, known, total, count):
        pass
    return x


def _morton(x: Array) -> NDArray[np.uint64]:
    """Morton code of each position: the bits of its three coordinates by turns."""
    low = x.min(axis=0)
    extent = max(float((x - low).max()), 1e-9)
    grid = ((x - low) / extent * (2**21 - 1)).astype(np.uint64)
    code = np.zeros(len(x), np.uint64)
    for axis in range(3):
        bits = grid[:, axis]
        for shift, mask in _SPREAD_BITS:
            bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


_SPREAD_BITS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shift and mask: 21 bits come to stand at every third place."""
