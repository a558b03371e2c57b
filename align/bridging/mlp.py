"""The back-propagation network that Xu et al. 2012 compare with: scikit-learn's, one hidden layer.

The paper gives neither its size nor its training. Ours: tanh units, all weights found by L-BFGS on the
gradient that back-propagation gives, from one random start.
"""

import threading
import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..estimate import Array

if TYPE_CHECKING:
    from sklearn.neural_network import MLPRegressor

HIDDEN = 10
_MOST_ITERATIONS = 100
"""More of them fit the noise, and forecast no better."""
_FITTING = threading.Lock()


class Network:
    """A trained network."""

    def __init__(self, network: "MLPRegressor") -> None:
        self._network = network

    def predict(self, x: ArrayLike) -> Array:
        """Outputs (j, p) for inputs (j, d)."""
        x = np.asarray(x, float)
        return np.asarray(self._network.predict(x)).reshape(len(x), -1)


def fit(x: Array, y: Array, seed: int) -> Network:
    """Train on x (k, d) and y (k, p), both standardised."""
    from sklearn.exceptions import ConvergenceWarning  # slow to import
    from sklearn.neural_network import MLPRegressor

    network = MLPRegressor(
        hidden_layer_sizes=(HIDDEN,),
        activation="tanh",
        solver="lbfgs",
        max_iter=_MOST_ITERATIONS,
        random_state=seed,
    )
    # Warnings are of the whole process: one thread at a time. A training that is stopped early is none here:
    # that is the usual guard against learning the noise.
    with _FITTING, warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        network.fit(x, y)
    return Network(network)
