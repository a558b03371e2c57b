"""The energy-to-peak (l2-linf) inequality: E|e(k)|^2 < g (sum of |w|^2), for all k."""

from typing import Any

from .inequality import ClosedForm, Expression, positive


def constraints(closed: ClosedForm, g: Expression) -> list[Any]:
    """At one vertex, for the square ``g`` of the gain.

    The first keeps eta' P eta below the energy spent; the second keeps the error below g times that energy,
    that of w(k) included, which reaches e(k) through Df at once.
    """
    energy = [closed.P, closed.unit_w]
    return [
        positive([closed.slack] * len(closed.F), list(zip(closed.F, closed.J, strict=True)), energy),
        positive([g * closed.unit_e] * len(closed.c), list(zip(closed.c, closed.d, strict=True)), energy),
    ]
