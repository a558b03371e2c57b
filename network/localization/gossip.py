"""The distributed solver: each node follows itself by its ranges and by what its neighbours broadcast.

It is Wan et al.'s distributed refinement, as mended, in space and in motion (`distributed_ekf` has it as
printed, for nodes that stand still). The state is position and velocity, with a clock where ranging is
one-way; ranges and range rates are the measurements. At an epoch a node predicts itself, P with the fading
factor lambda at its limit, and then for each sweep:

1. broadcasts its state and covariance; a broadcast that is lost leaves the one before with all others, who
   carry it on in a straight line;
2. estimates itself anew from its prediction and the ranges of the epoch, with its neighbours where they said
   that they are, and R with their covariance along the line of sight.

Departures from the paper: a range counts once an epoch, not once a sweep; the covariance along the line of
sight stands for tr(P_j) / 2; lambda is constant, since (9) needs measurements that are as many as the filter
believes; Q is what accelerations do, not Sage's.

Errors of neighbours are taken for independent of each other and of the node's own. They are not, and the
less so the more sweeps there are: with some, what is stated is too small. And since P fades by half an epoch,
errors of epochs in a row are correlated, where those of the central solver are not.
"""

import numpy as np

from . import _distributed
from ._dense import Terms
from .chain import LocalizationSettings
from .epochs import Epochs
from .problem import Array, Booleans, Integers


class Gossip:
    """What nodes know of themselves and were told of others, from one call to the next.

    Parameters
    ----------
    weak : (B, B), covariance of the state of a node that has none.
    n : number of nodes.
    """

    def __init__(self, settings: LocalizationSettings, weak: Array, n: int) -> None:
        self._sweeps, self._acceleration = settings.sweeps, settings.maneuver_acceleration_mps2
        self._weak = weak
        self._P = np.tile(weak, (n, 1, 1))
        self._told = np.zeros((n, len(weak))), self._P.copy()
        self._beliefs: Array | None = None

    def start(self, S: Array, new: Booleans, cov: Array) -> None:
        """Nodes that are ``new`` (n,) have the states S (n, B), known to all, and ``cov`` (n, 3, 3) m^2 of
        their positions."""
        self._P[new] = self._weak
        self._P[new, :3, :3] = cov[new]
        told_S, told_P = self._told
        told_S[:], told_P[new] = S, self._P[new]

    def advance(
        self,
        S: Array,
        place: Integers,
        epochs: Epochs,
        times: Array,
        terms: Terms,
        w_range: Array,
        w_rate: Array,
        beliefs: Array,
        heights: Array,
        out: tuple[Array | Integers | Booleans, ...],
    ) -> None:
        """The next epochs; S and ``out`` are written, as `_tracking.track` has them."""
        if self._beliefs is None:
            self._beliefs = beliefs[0].copy()
        lost = np.zeros((len(epochs.t), self._sweeps, len(S)), np.bool_)
        if epochs.lost is not None:
            lost[:] = epochs.lost
        _distributed.track(
            times, S, self._P, *self._told, place, terms, w_range, w_rate, epochs.ranges, epochs.rates,
            beliefs, heights, _adjacent(epochs.pairs, len(S)), self._beliefs, self._acceleration, lost, out,
        )  # fmt: skip


def _adjacent(pairs: Integers, n: int) -> tuple[Integers, Integers, Integers, Array]:
    """The links by node, as `_distributed.track` takes them."""
    m, node = len(pairs), pairs.T.ravel()
    order = np.argsort(node, kind="stable")
    first = np.searchsorted(node[order], np.arange(n + 1))
    return first, pairs[:, ::-1].T.ravel()[order], order % max(m, 1), np.where(order < m, 1.0, -1.0)
