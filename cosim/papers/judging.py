"""Verdicts from intervals: a rule holds where the whole 95 % interval keeps it, and fails where none does.

What lies on both sides, or has no interval, is undecided: noise must satisfy no claim, and refute none.
"""

from collections.abc import Iterable
from enum import Enum

import numpy as np

from .results import Value, Verdict


class Held(Enum):
    """Whether a rule holds of a measured figure."""

    YES = "yes"
    NO = "no"
    OPEN = "open"


def below(value: Value, limit: float) -> Held:
    """Whether a figure is below a limit."""
    if not (np.isfinite(value.low) and np.isfinite(value.high)):
        return Held.OPEN
    return Held.YES if value.high < limit else Held.NO if value.low >= limit else Held.OPEN


def above(value: Value, limit: float) -> Held:
    """Whether a figure is above a limit."""
    return below(Value(-value.value, -value.high, -value.low), -limit)


def within(value: Value, low: float, high: float) -> Held:
    """Whether a figure is in an interval."""
    return both(above(value, low), below(value, high))


def both(*held: Held) -> Held:
    """Whether all rules hold."""
    if Held.NO in held:
        return Held.NO
    return Held.OPEN if Held.OPEN in held else Held.YES


def either(*held: Held) -> Held:
    """Whether one rule holds."""
    if Held.YES in held:
        return Held.YES
    return Held.OPEN if Held.OPEN in held else Held.NO


def verdict(whole: Held, parts: Iterable[Held] = ()) -> Verdict:
    """Reproduced if the whole claim holds; partly if it does not, and a part of it does."""
    if whole is Held.YES:
        return Verdict.REPRODUCED
    part = either(*parts)
    if whole is Held.OPEN or part is Held.OPEN:
        return Verdict.PARTLY if part is Held.YES and whole is Held.NO else Verdict.UNDECIDED
    return Verdict.PARTLY if part is Held.YES else Verdict.NOT
