"""The stochastic H2 inequality: trace of the error's covariance under white w, below g."""

from typing import Any

import cvxpy as cp

from .inequality import ClosedForm, Expression, positive


def constraints(closed: ClosedForm, g: Expression) -> list[Any]:
    """At one vertex: the inverse of P exceeds the covariance of eta, and W that of the error."""
    channels = len(closed.F)
    covariance = [closed.P] * channels + [closed.unit_w] * channels
    W = cp.Variable(closed.unit_e.shape, symmetric=True)
    return [
        positive([closed.slack], [[*closed.F, *closed.J]], covariance),
        positive([W], [[*closed.c, *closed.d]], covariance),
        cp.trace(W) <= g,
    ]
