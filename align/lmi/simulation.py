"""A filter on its plant, simulated as both are written down."""

import numpy as np

from .plant import Array, Filter, Plant


def simulated_errors(
    plant: Plant, filter_: Filter, fed_back: bool, runs: int = 2_000, steps: int = 200
) -> Array:
    """Errors (runs, p) at the last of some steps from rest, under white noise of unit variance.

    Plant and filter are those of eqs. (10) and (11), late outputs and all; ``fed_back`` as in
    `analysis.analyze`.
    """
    rng = np.random.default_rng(1)
    n, width, m, _ = plant.shape
    x, x_f, y_before = np.zeros((runs, n)), np.zeros((runs, filter_.order)), np.zeros((runs, m))
    e = np.zeros((runs, len(plant.H)))
    for _ in range(steps):
        w = rng.standard_normal((runs, width))
        y = x @ plant.C.T + w @ plant.D.T
        received = np.where(rng.random((runs, 1)) < plant.rho, y, y_before)
        e = x @ plant.H.T
        if not fed_back:
            e = e - x_f @ filter_.Cf.T - received @ filter_.Df.T
        x_f = x_f @ filter_.Af.T + received @ filter_.Bf.T
        x, y_before = x @ plant.A.T + w @ plant.B.T, y
        if fed_back:
            x = x - received @ filter_.Bf.T
    return e
