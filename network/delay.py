"""Delay of a packet between the instant at which its fix is true and its arrival.

Each model is a scenario's table ``{ kind = "...", ... }`` and knows its own mean and standard deviation,
which is what a filter may be told of it.
"""

import math
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..sins.settings import Settings
from ..sins.units import MILLISECOND
from .tables import DataFile, TableError, check_range, read_columns

Array = NDArray[np.float64]

LONGEST_DELAY_MS = 60_000.0


class NoDelay(Settings):
    """Every packet arrives at once."""

    kind: Literal["none"] = "none"

    def draw(self, k: int, rng: Generator) -> Array:
        """Delays of ``k`` packets, s."""
        return np.zeros(k)

    @property
    def mean_s(self) -> float:
        return 0.0

    @property
    def sd_s(self) -> float:
        return 0.0


class ConstantDelay(Settings):
    """Every packet takes the same time."""

    kind: Literal["constant"] = "constant"
    delay_ms: float = Field(default=50.0, ge=0, le=LONGEST_DELAY_MS)

    def draw(self, k: int, rng: Generator) -> Array:
        """Delays of ``k`` packets, s."""
        return np.full(k, self.mean_s)

    @property
    def mean_s(self) -> float:
        return self.delay_ms * MILLISECOND

    @property
    def sd_s(self) -> float:
        return 0.0


class UniformDelay(Settings):
    """Independent delays, uniform between two bounds; by default Gao et al.'s "at most 50 ms"."""

    kind: Literal["uniform"] = "uniform"
    min_ms: float = Field(default=0.0, ge=0, le=LONGEST_DELAY_MS)
    max_ms: float = Field(default=50.0, ge=0, le=LONGEST_DELAY_MS)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_ms > self.max_ms:
            raise ValueError(f"min_ms = {self.min_ms:g} must not exceed max_ms = {self.max_ms:g}")
        return self

    def draw(self, k: int, rng: Generator) -> Array:
        """Delays of ``k`` packets, s."""
        return rng.uniform(self.min_ms, self.max_ms, k) * MILLISECOND

    @property
    def mean_s(self) -> float:
        return 0.5 * (self.min_ms + self.max_ms) * MILLISECOND

    @property
    def sd_s(self) -> float:
        return (self.max_ms - self.min_ms) * MILLISECOND / math.sqrt(12)


class BernoulliDelay(Settings):
    """One-step random delay (Gao et al., eq. (10)): at once with probability ``rho``, else a step late."""

    kind: Literal["bernoulli"] = "bernoulli"
    rho: float = Field(default=0.5, ge=0, le=1)
    step_ms: float = Field(default=50.0, ge=0, le=LONGEST_DELAY_MS)

    def draw(self, k: int, rng: Generator) -> Array:
        """Delays of ``k`` packets, s."""
        return np.where(rng.random(k) < self.rho, 0.0, self.step_ms * MILLISECOND)

    @property
    def mean_s(self) -> float:
        return (1 - self.rho) * self.step_ms * MILLISECOND

    @property
    def sd_s(self) -> float:
        return math.sqrt(self.rho * (1 - self.rho)) * self.step_ms * MILLISECOND


class ReplayedDelay(Settings):
    """Delays from a recording, in its order from a random row on, its first row following its last.

    Every draw begins at a row of its own: runs differ, and a duplicate does not arrive with its original.
    ``file`` is CSV or Parquet; ``column`` names the delays and ends in their unit, ``_s`` or ``_ms``.
    """

    kind: Literal["replay"] = "replay"
    file: DataFile
    column: str = Field(default="delay_ms", pattern=r"_(ms|s)$")

    @model_validator(mode="after")
    def _readable(self) -> Self:
        # Read once, here, so that a mistake shows when the scenario is read.
        if not self.recorded.size:
            raise TableError(self.file, "no rows")
        return self

    @cached_property
    def recorded(self) -> Array:
        """The recorded delays, s."""
        unit_s = MILLISECOND if self.column.endswith("_ms") else 1.0
        delays = read_columns(self.file, required=(self.column,))[self.column]
        check_range(self.file, self.column, delays, 0.0, LONGEST_DELAY_MS * MILLISECOND / unit_s)
        return delays * unit_s

    def draw(self, k: int, rng: Generator) -> Array:
        """Delays of ``k`` packets, s."""
        first = rng.integers(len(self.recorded))
        return np.take(self.recorded, first + np.arange(k), mode="wrap")

    @property
    def mean_s(self) -> float:
        return float(self.recorded.mean())

    @property
    def sd_s(self) -> float:
        return float(self.recorded.std())


Delay = Annotated[
    NoDelay | ConstantDelay | UniformDelay | BernoulliDelay | ReplayedDelay, Field(discriminator="kind")
]
"""Any of the models, chosen by ``kind``."""
