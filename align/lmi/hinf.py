"""The energy-to-energy (H-infinity) inequality: sum of E|e|^2 < g (sum of |w|^2)."""

from typing import Any

from .inequality import ClosedForm, Expression, positive


def constraints(closed: ClosedForm, g: Expression) -> list[Any]:
    """At one vertex, for the square ``g`` of the gain: the bounded real lemma, in the mean."""
    channels = len(closed.F)
    rows = [*zip(closed.F, closed.J, strict=True), *zip(closed.c, closed.d, strict=True)]
    return [
        positive([closed.slack] * channels + [closed.unit_e] * channels, rows, [closed.P, g * closed.unit_w])
    ]
