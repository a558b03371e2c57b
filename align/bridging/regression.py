"""Models of a function by name, learnt from pairs of input and output: ``"lssvm"`` or ``"mlp"``."""

from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..estimate import Array
from . import lssvm, mlp

Bridging = Literal["coast", "lssvm", "mlp"]
"""``coast`` is the filter's own prediction, which needs no model."""
LEAST_ROWS = 10
"""Of a training area: half of them choose the parameters, half of them verify the choice."""


class TrainingError(ValueError):
    """A training area from which nothing can be learnt; one line."""


class Model(Protocol):
    """What was learnt."""

    def predict(self, x: ArrayLike) -> Array:
        """Outputs (j, p) for inputs (j, d)."""
        ...


class Standardized:
    """A model in units of the training's own mean and standard deviation."""

    def __init__(self, model: Model, x: Array, y: Array) -> None:
        self.model = model
        self.x_mean, self.x_sd = x.mean(axis=0), spread(x)
        self.y_mean, self.y_sd = y.mean(axis=0), spread(y)

    def predict(self, x: ArrayLike) -> Array:
        """Outputs (j, p) for inputs (j, d)."""
        return self.y_mean + self.y_sd * self.model.predict((np.asarray(x, float) - self.x_mean) / self.x_sd)


def spread(values: Array) -> Array:
    """Standard deviation of each column (k, c); one where a column does not vary."""
    sd = values.std(axis=0)
    return np.where(sd > 1e-12 * (1 + np.abs(values).max(axis=0)), sd, 1.0)


def fit(name: Bridging, x: ArrayLike, y: ArrayLike, seed: int = 0) -> Standardized:
    """Learn y (k, p) as a function of x (k, d), rows in order of time.

    ``seed`` : of the network's first weights. Raises `TrainingError` for fewer than `LEAST_ROWS` rows, what
    is not finite, and ``coast``, which is no model.
    """
    x, y = checked(x, y)
    inputs, outputs = (x - x.mean(axis=0)) / spread(x), (y - y.mean(axis=0)) / spread(y)
    if name == "lssvm":
        return Standardized(lssvm.fit(inputs, outputs), x, y)
    if name == "mlp":
        return Standardized(mlp.fit(inputs, outputs, seed), x, y)
    raise TrainingError(f"no model {name!r}; known: lssvm, mlp")


def checked(x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Both as arrays (k, d) and (k, p). Raises `TrainingError`."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y):
        raise TrainingError(f"inputs {x.shape} and outputs {y.shape} must be (k, d) and (k, p)")
    if len(x) < LEAST_ROWS:
        held = f"holds {len(x)} point" + "s" * (len(x) > 1) if len(x) else "is empty"
        raise TrainingError(f"the training area {held}: at least {LEAST_ROWS} are needed")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise TrainingError("the training area holds a number that is not finite")
    return x, y
