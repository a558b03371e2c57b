"""Compiled loops of the cold start: shortest paths from anchors, and positions from their lengths."""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import njit

from ...sins._kernels import COMPILED
from ._relocate import solve_symmetric


@njit(**COMPILED)
def spread(links, x, known, total, count):
    """Give each unknown node the mean of its known neighbours; the number of nodes that became known."""
    total[:] = 0.0
    count[:] = 0
    for k in range(len(links)):
        i, j = links[k, 0], links[k, 1]
        if known[i] and not known[j]:
            total[j] += x[i]
            count[j] += 1
        elif known[j] and not known[i]:
            total[i] += x[j]
            count[i] += 1
    new = 0
    for i in range(len(x)):
        if count[i]:
            x[i] = total[i] / count[i]
            known[i] = True
            new += 1
    return new


@njit(**COMPILED)
def flood(lo, hi, start, other, ranges, anchors_before, lengths_before, anchors, lengths):
    """One round: each node keeps the nearest anchors of its own list and its neighbours', by path length.

    ``anchors``, (n, k), -1 for none, and ``lengths``, (n, k) m, are sorted by length.
    """
    k = anchors.shape[1]
    changed = 0
    for i in range(lo, hi):
        anchors[i] = anchors_before[i]
        lengths[i] = lengths_before[i]
        for slot in range(start[i], start[i + 1]):
            j = other[slot]
            # Of two nodes at one place noise may make the range nothing or less.
            r = max(ranges[slot], 1e-3)
            for c in range(k):
                a = anchors_before[j, c]
                length = np.float32(lengths_before[j, c] + r)
                if a < 0 or length >= lengths[i, k - 1]:
                    break
                # Where the anchor stands in the list already, or the end of it.
                at = k - 1
                better = True
                for e in range(k):
                    if anchors[i, e] == a:
                        at = e
                        better = length < lengths[i, e]
                        break
                if not better:
                    continue
                changed = 1
                while at > 0 and lengths[i, at - 1] > length:
                    anchors[i, at] = anchors[i, at - 1]
                    lengths[i, at] = lengths[i, at - 1]
                    at -= 1
                anchors[i, at] = a
                lengths[i, at] = length
    return changed


@njit(**COMPILED)
def path_stretch(lo, hi, fixed, x, anchors, lengths):
    """Sums of length times distance, and of length squared, over paths from anchor to anchor."""
    cross = square = 0.0
    for i in range(lo, hi):
        if not fixed[i]:
            continue
        for c in range(anchors.shape[1]):
            a = anchors[i, c]
            if a >= 0 and a != i:
                d = math.sqrt((x[i, 0] - x[a, 0]) ** 2 + (x[i, 1] - x[a, 1]) ** 2 + (x[i, 2] - x[a, 2]) ** 2)
                cross += d * lengths[i, c]
                square += lengths[i, c] * lengths[i, c]
    return cross, square


@njit(**COMPILED)
def multilaterate(lo, hi, fixed, anchors, lengths, stretch, ridge, x):
    """Positions of free nodes by linear least squares from path lengths to anchors, as in DV-distance.

    Differences from the weighted mean take the unknown square of the position out. ``ridge`` is a share of
    the mean diagonal that pulls towards the mean of the anchors where they lie in a plane or are few. No
    node comes to lie further from its nearest anchor than the path to it is long.
    """
    for i in range(lo, hi):
        if fixed[i] or anchors[i, 0] < 0:
            continue
        near = anchors[i, 0]
        sw = m0 = m1 = m2 = ms = 0.0
        for c in range(anchors.shape[1]):
            a = anchors[i, c]
            if a < 0:
                break
            d = stretch * lengths[i, c]
            w = 1 / (d * d * d * d)
            y0, y1, y2 = x[a, 0] - x[near, 0], x[a, 1] - x[near, 1], x[a, 2] - x[near, 2]
            sw += w
            m0 += w * y0
            m1 += w * y1
            m2 += w * y2
            ms += w * (y0 * y0 + y1 * y1 + y2 * y2 - d * d)
        m0, m1, m2, ms = m0 / sw, m1 / sw, m2 / sw, ms / sw
        a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = 0.0
        for c in range(anchors.shape[1]):
            a = anchors[i, c]
            if a < 0:
                break
            d = stretch * lengths[i, c]
            w = 1 / (d * d * d * d * sw)
            y0, y1, y2 = x[a, 0] - x[near, 0], x[a, 1] - x[near, 1], x[a, 2] - x[near, 2]
            # Half the squared distance from the point where all anchors' equations have mean zero.
            s = 0.5 * (y0 * y0 + y1 * y1 + y2 * y2 - d * d - ms)
            y0, y1, y2 = y0 - m0, y1 - m1, y2 - m2
            s -= m0 * y0 + m1 * y1 + m2 * y2
            b0 += w * y0 * s
            b1 += w * y1 * s
            b2 += w * y2 * s
            a00 += w * y0 * y0
            a01 += w * y0 * y1
            a02 += w * y0 * y2
            a11 += w * y1 * y1
            a12 += w * y1 * y2
            a22 += w * y2 * y2
        floor = ridge * (a00 + a11 + a22) / 3
        p0, p1, p2 = m0, m1, m2
        # One anchor alone has no spread: the node starts where it stands.
        if floor > 0.0:
            s0, s1, s2 = solve_symmetric(a00 + floor, a01, a02, a11 + floor, a12, a22 + floor, b0, b1, b2)
            p0, p1, p2 = m0 + s0, m1 + s1, m2 + s2
        norm = math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
        limit = min(1.0, lengths[i, 0] / norm) if norm > 0.0 else 1.0
        x[i, 0] = x[near, 0] + limit * p0
        x[i, 1] = x[near, 1] + limit * p1
        x[i, 2] = x[near, 2] + limit * p2
