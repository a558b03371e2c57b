"""Profiles to start the search from, and the families of simple S-manoeuvres to compare its end with."""

from itertools import islice, product

import numpy as np

from ..sins.earth import STANDARD_GRAVITY as G
from ..sins.units import DEG
from .maneuver_bound import AlignmentTask, Array, headings, knot_times
from .maneuver_limits import ManeuverLimits

ENTRIES_S = (2.0, 3.0, 4.0, 6.0, 8.0)
"""Times over which an S of the grid is raised and lowered; the shortest that holds the limits counts."""


def s_bank(time: Array, bank_deg: float, period_s: float, phase_deg: float, entry_s: float) -> Array:
    """Bank, rad, of an S of sinusoidal lateral acceleration, raised and lowered over ``entry_s``."""
    edge = np.clip(np.minimum(time, time[-1] - time) / entry_s, 0.0, 1.0)
    wave = np.sin(2 * np.pi * time / period_s + phase_deg * DEG)
    acceleration = G * np.tan(bank_deg * DEG) * wave
    return np.arctan((0.5 - 0.5 * np.cos(np.pi * edge)) * acceleration / G)


def turns(time: Array, limits: ManeuverLimits, switches_s: tuple[float, ...]) -> Array:
    """Steepest turns, first right, the other way from each of ``switches_s`` on; rolls at the limits."""
    steepest, rate = limits.profile_bank_deg, limits.max_roll_rate_deg_s
    fastest = limits.max_roll_acceleration_deg_s2
    dt = time[1] - time[0]
    steps = max(1, round(dt / 0.02))
    h = dt / steps
    # Time to roll out of the turn, from the roll rate's limit or, if it is not reached, the acceleration's.
    level_s = (
        steepest / rate + rate / fastest if rate**2 < steepest * fastest else 2 * (steepest / fastest) ** 0.5
    )
    bank = roll_rate = 0.0
    found = np.zeros(len(time))
    for k in range(1, len(time)):
        for j in range(steps):
            t = time[k - 1] + j * h
            wanted = (
                0.0 if t >= time[-1] - level_s else steepest * (-1) ** np.searchsorted(switches_s, t, "right")
            )
            error = wanted - bank
            asked = np.copysign(min(rate, np.sqrt(2 * fastest * abs(error))), error)
            roll_rate += np.clip(asked - roll_rate, -fastest * h, fastest * h)
            bank += roll_rate * h
        found[k] = bank
    found[-1] = 0.0
    return np.clip(found, -steepest, steepest) * DEG


def starts(
    limits: ManeuverLimits, dt: float, n: int, simple: int, random: int, seed: int
) -> dict[str, Array]:
    """Named starts, banks (n + 1,) rad: the first ``simple`` of eight simple ones, and random ones."""
    time, whole = knot_times(n, dt), limits.duration_s
    bank_deg = 0.95 * limits.profile_bank_deg
    named = {
        "two turns, 1/5 and 4/5": turns(time, limits, (whole / 5,)),
        "three turns": turns(time, limits, (whole / 5, 0.8 * whole)),
        "S, one period, from its peak": s_bank(time, bank_deg, whole, 90.0, 2.0),
        "S, one period": s_bank(time, bank_deg, whole, 0.0, 2.0),
        "one long turn": turns(time, limits, ()),
        "two turns, 4/5 and 1/5": turns(time, limits, (0.8 * whole,)),
        "two equal turns": turns(time, limits, (whole / 2,)),
        "S, two periods": s_bank(time, bank_deg, whole / 2, 0.0, 2.0),
    }
    found = dict(islice(named.items(), simple))
    rng = np.random.default_rng(seed)
    for i in range(random):
        points = rng.uniform(-bank_deg, bank_deg, 9) * DEG
        points[[0, -1]] = 0.0
        found[f"random {i + 1}"] = np.interp(time, np.linspace(0, whole, 9), points)
    return found


def s_families(
    task: AlignmentTask,
    limits: ManeuverLimits,
    dt: float,
    n: int,
    steps: tuple[int, int, int] = (4, 8, 4),
) -> dict[tuple[float, float, float, float], Array]:
    """Grid of S-manoeuvres by (bank, deg; period, s; phase, deg; entry, s): banks (n + 1,) rad.

    ``steps`` in bank, period and phase, 0 to 180 deg: the other half is the mirror image. Each is raised and
    lowered in the least of `ENTRIES_S` with which it holds the limits; those that hold them with none are
    left out.
    """
    time = knot_times(n, dt)
    banks = limits.profile_bank_deg * np.linspace(0.4, 1.0, steps[0])
    periods = limits.duration_s * np.geomspace(0.2, 2.0, steps[1])
    phases = 180.0 * np.arange(steps[2]) / steps[2]
    found = {}
    for bank_deg, period, phase in product(banks.tolist(), periods.tolist(), phases.tolist()):
        for entry in ENTRIES_S:
            bank = s_bank(time, bank_deg, period, phase, entry)
            if not limits.broken(bank, dt, headings(bank, dt, task)):
                found[bank_deg, period, phase, entry] = bank
                break
    return found
