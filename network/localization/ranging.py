"""Ranges by signal strength: errors grow with the distance, and what a filter may take for their size.

References
----------
.. [1] Xu W., Wang G., Chen M., "Node localization of wireless sensor networks based on SR-CKF assisted by
       unmanned aerial vehicles", CAAI Transactions on Intelligent Systems 14 (2019).
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.random import Generator
from pydantic import Field

from ...sins.settings import Settings
from .problem import Array


class RangeNoise(NamedTuple):
    """Standard deviation of ranges: a part that does not depend on the distance d, and one that grows
    with it."""

    sd_m: float = 0.0
    share: float = 0.0

    def at(self, d: Array) -> Array:
        """(...) m, in the precision of ``d``."""
        return np.hypot(np.asarray(self.sd_m, d.dtype), np.asarray(self.share, d.dtype) * d)


class UniformErrors(Settings):
    """Errors that are uniform within a share of the distance ([1]_ section 3.2: 0.15)."""

    kind: Literal["uniform"] = "uniform"
    share: float = Field(default=0.15, gt=0, lt=1)

    @property
    def noise(self) -> RangeNoise:
        """What least squares and filters are told: the standard deviation of the uniform law."""
        return RangeNoise(share=self.share / np.sqrt(3))

    def draw(self, d: Array, rng: Generator) -> Array:
        """Ranges of distances, m."""
        return d * (1 + self.share * rng.uniform(-1, 1, d.shape))


class PathLossErrors(Settings):
    """Distances read off the received power under log-normal shadowing ([1]_ eq. 1).

    ``P_r = P_t - 10 gamma lg(d / d_i) + W`` gives back d times ``10^(W / 10 gamma)``, whatever power and
    reference distance: the error is a factor, too. Its mean is above one; what is put out is divided by it.
    """

    kind: Literal["path_loss"]
    shadowing_db: float = Field(default=1.0, gt=0, le=20)
    """Standard deviation of W."""
    path_loss_exponent: float = Field(default=2.5, ge=1, le=8)
    """gamma"""

    @property
    def log_sd(self) -> float:
        """Standard deviation of the logarithm of a range."""
        return self.shadowing_db * np.log(10) / (10 * self.path_loss_exponent)

    @property
    def noise(self) -> RangeNoise:
        """That of a log-normal factor of mean one."""
        return RangeNoise(share=float(np.sqrt(np.expm1(self.log_sd**2))))

    def draw(self, d: Array, rng: Generator) -> Array:
        """Ranges of distances, m."""
        lost_db = rng.normal(0.0, self.shadowing_db, d.shape)
        biased = d * 10 ** (lost_db / (10 * self.path_loss_exponent))
        return biased * np.exp(-0.5 * self.log_sd**2)
