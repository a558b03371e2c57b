"""Compiled search for nodes that can have a position: with enough neighbours, in reach of enough anchors."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED

LEAST_NEIGHBOURS = 4
"""Ranges that leave one place, and no mirror image, in three dimensions."""


@njit(**COMPILED)
def peel(start, other, anchor, out):
    """Mark in ``out``, (n,), free nodes with too few neighbours, and again, until all others have enough."""
    n = len(anchor)
    left = np.zeros(n, np.int32)
    stack = np.empty(n, np.int32)
    height = 0
    for i in range(n):
        if anchor[i] or out[i]:
            continue
        for slot in range(start[i], start[i + 1]):
            left[i] += not out[other[slot]]
        if left[i] < LEAST_NEIGHBOURS:
            out[i] = True
            stack[height] = i
            height += 1
    while height:
        height -= 1
        i = stack[height]
        for slot in range(start[i], start[i + 1]):
            j = other[slot]
            if anchor[j] or out[j]:
                continue
            left[j] -= 1
            if left[j] < LEAST_NEIGHBOURS:
                out[j] = True
                stack[height] = j
                height += 1


@njit(**COMPILED)
def anchors_in_reach(start, other, anchor, out, reach):
    """``reach``, (n,): anchors next to the group of linked free nodes that a node belongs to."""
    n = len(anchor)
    group = np.full(n, -1, np.int32)
    members = np.empty(n, np.int32)
    for seed in range(n):
        if anchor[seed] or out[seed] or group[seed] >= 0:
            continue
        members[0], group[seed] = seed, seed
        size, done, anchors = 1, 0, 0
        while done < size:
            i = members[done]
            done += 1
            for slot in range(start[i], start[i + 1]):
                j = other[slot]
                if out[j] or group[j] == seed:
                    continue
                # An anchor belongs to the group that met it last.
                group[j] = seed
                if anchor[j]:
                    anchors += 1
                else:
                    members[size] = j
                    size += 1
        for k in range(size):
            reach[members[k]] = anchors


@njit(**COMPILED)
def drop_links(start, other, out, root_weight):
    """Take the weight from all links of nodes that are ``out``."""
    for i in range(len(out)):
        for slot in range(start[i], start[i + 1]):
            if out[i] or out[other[slot]]:
                root_weight[slot] = 0.0
