"""A fleet's nodes followed from epoch to epoch: each epoch's estimate is a fix that a filter refines.

The filters are those of Uryvsky et al. (`repeated_ranging`), with position and velocity for their state, and
with a motion between fixes that their (5) has not: nodes go on at their velocity, and accelerate at random.
"""

from dataclasses import replace

import numpy as np

from ...sins.gaussian import transposed
from ..fleet import OWN_SHIP
from .chain import LocalizationSettings
from .epochs import Track
from .problem import Array, NodeOutcome
from .repeated_ranging import UPDATES
from .tracking import RESTART_S


class Follower:
    """Refines the `Track` of consecutive epochs, node by node.

    What anchors err is the same at all epochs, and no filter takes it away: it is kept out of the noise of
    the fixes, and added to what is stated (a consider covariance). Noise and that part are those of the
    first epoch of each call, as ``Track.cov`` is. Constant errors of single links and altimeters are not
    known for what they are, and count as noise. Nodes are filtered one by one, though an epoch locates them
    together.

    A node that an epoch does not locate has none, but goes on being predicted for `RESTART_S`.
    """

    def __init__(self, settings: LocalizationSettings) -> None:
        self._update = UPDATES[settings.tracker]
        self._limit = settings.discrepancy_limit
        self._acceleration = settings.maneuver_acceleration_mps2
        self._x, self._K, self._seen_s = np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0)
        self._t, self._centre_e, self._C_en = 0.0, np.zeros(3), np.eye(3)

    def advance(self, track: Track, t: Array, centre_e: Array, C_en: Array) -> Track:
        """The track with located nodes as followed; their standard deviations and the own ship's covariance.

        ``t`` (k,) s; ``centre_e`` (k, 3) m and ``C_en`` (k, 3, 3), origin and axes of each epoch's frame.
        """
        k, n = track.outcome.shape
        if not len(self._x):
            self._x, self._K, self._seen_s = np.zeros((n, 6)), np.zeros((n, 6, 6)), np.full(n, -np.inf)
            self._t, self._centre_e, self._C_en = float(t[0]), centre_e[0], C_en[0]
        noise = track.cov - track.shared
        z = np.concatenate([track.x, track.v], axis=-1)
        states, own_cov = z.copy(), np.full((k, 6, 6), np.nan)
        sd = track.sd.copy()
        for epoch in range(k):
            self._predict(float(t[epoch]), centre_e[epoch], C_en[epoch])
            located = np.flatnonzero(track.outcome[epoch] == NodeOutcome.LOCATED)
            known = self._t - self._seen_s[located] <= RESTART_S
            new, old = located[~known], located[known]
            self._x[new], self._K[new] = z[epoch, new], noise[new]
            self._x[old], self._K[old], *_ = self._update(
                self._x[old], self._K[old], z[epoch, old], noise[old], self._limit
            )
            self._seen_s[located] = self._t
            states[epoch, located] = self._x[located]
            stated = self._K[located] + track.shared[located]
            if epoch == 0:
                sd[located] = np.sqrt(np.einsum("nii->ni", stated))
            if len(located) and located[0] == OWN_SHIP:
                own_cov[epoch] = stated[0]
        return replace(track, x=states[..., :3], v=states[..., 3:], own_cov=own_cov, sd=sd)

    def _predict(self, t: float, centre_e: Array, C_en: Array) -> None:
        """(5) with motion: carry all nodes on in a straight line, into the frame of the epoch at ``t``."""
        dt = t - self._t
        turn = C_en.T @ self._C_en
        F = np.kron([[1.0, dt], [0.0, 1.0]], turn)
        W = np.kron([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]], np.eye(3)) * self._acceleration**2
        self._x = self._x @ F.T
        self._x[:, :3] += (self._centre_e - centre_e) @ C_en
        self._K = F @ self._K @ transposed(F) + W
        self._t, self._centre_e, self._C_en = t, centre_e, C_en
