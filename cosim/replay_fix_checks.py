"""Whether fixes are what a map says, by themselves: the way from fix to fix against their velocities."""

from pathlib import Path

import numpy as np

from ..network.fixes import Fixes
from ..sins import earth
from .replay_map import ANGLE_UNITS, SPEED_UNITS, TO_NED, Array, FixColumns, ReplayError

FACTOR = 3.0
"""What two measures of one motion may differ by; every pair of units differs by more."""
NOISE = 20.0
"""So many standard deviations of a fix must a displacement have to count."""
STRAY = 0.3
"""Median difference between the way from fix to fix and that of the velocities, as a share of it."""


def check_displacement(file: Path, fixes: Fixes, layout: FixColumns) -> float | None:
    """Way from fix to fix over the integral of the velocities, by the median of both; None if not to be told.

    Parameters: ``fixes`` finite, in order of their stamps. Raises `ReplayError`, which names what fits.
    """
    if len(fixes) < 3:
        return None
    dt = np.diff(fixes.t_stamp)[:, None]
    way = np.vstack([np.zeros(3), np.cumsum(0.5 * (fixes.v_n[1:] + fixes.v_n[:-1]) * dt, axis=0)])
    sd = float(np.nanmedian(np.sqrt(np.einsum("kii->ki", fixes.cov)[:, :3])))
    speed = float(np.median(np.linalg.norm(fixes.v_n, axis=1)))
    needed_s = max(NOISE * sd, 5.0) / max(speed, 1e-9)
    lag = max(1, int(np.ceil(needed_s / float(np.median(dt)))))
    if speed < 1e-3 or lag > len(fixes) // 2:
        return None
    expected = way[lag:] - way[:-lag]
    moved = earth.displacement_n(fixes.lla[lag:], fixes.lla[:-lag])

    def stray(seen: Array, by_velocity: Array) -> float:
        apart = np.median(np.linalg.norm(seen - by_velocity, axis=1))
        size = np.median(np.linalg.norm(seen, axis=1)) + np.median(np.linalg.norm(by_velocity, axis=1))
        return float(2 * apart / size)

    ratio = float(np.median(np.linalg.norm(moved, axis=1)) / np.median(np.linalg.norm(expected, axis=1)))
    level = slice(0, 2)
    if stray(moved[:, level], expected[:, level]) > STRAY:
        fitting = [
            told
            for told, seen, by_velocity in _other_layouts(moved, expected, layout, fixes.lla)
            if stray(seen[:, level], by_velocity[:, level]) < STRAY
        ]
        if fitting or not 1 / FACTOR < ratio < FACTOR:
            hint = f"; they do with {' or '.join(fitting)}" if fitting else ""
            raise ReplayError(
                f"{file}: positions and velocities do not belong together: the way from fix to fix is "
                f"{ratio:.3g} times that of the velocities; allowed is {1 / FACTOR:.2g} to {FACTOR:g}{hint}"
            )
    _check_climb(file, fixes, way, layout, max(NOISE * sd, 2.0))
    return ratio


def _check_climb(file: Path, fixes: Fixes, way: Array, layout: FixColumns, least_m: float) -> None:
    """Raise `ReplayError` where heights fall as the vertical velocity says they rise."""
    lag = max(1, len(fixes) // 4)
    expected = way[lag:, 2] - way[:-lag, 2]
    moved = earth.displacement_n(fixes.lla[lag:], fixes.lla[:-lag])[:, 2]
    climbing = np.abs(expected) > least_m
    if np.count_nonzero(climbing) <= 10:
        return
    share = float(np.median(moved[climbing] / expected[climbing]))
    if share < 0:
        raise ReplayError(
            f"{file}, columns {layout.height}, {layout.velocity[2]}: height changes {share:.3g} times as the "
            f"vertical velocity says: allowed is a positive number; heights count upwards, and the third "
            f"velocity is {'down' if layout.axes == 'NED' else 'up'} with axes = {layout.axes}"
        )


def _other_layouts(
    moved: Array, expected: Array, layout: FixColumns, lla: Array
) -> list[tuple[str, Array, Array]]:
    """What the map may mean instead: its words, the way by positions, and the way by velocities."""
    other_axes = "ENU" if layout.axes == "NED" else "NED"
    swap = TO_NED[other_axes] @ TO_NED[layout.axes].T
    other_angle = "deg" if layout.angle_unit == "rad" else "rad"
    angle = ANGLE_UNITS[other_angle] / ANGLE_UNITS[layout.angle_unit]
    # A degree of longitude is as long as the cosine of the true latitude makes it.
    shorter = np.cos(np.median(lla[:, 0]) * angle) / np.cos(np.median(lla[:, 0]))
    others = [
        (f"axes = {other_axes}", moved, expected @ swap.T),
        (f"angle_unit = {other_angle}", moved * [angle, angle * shorter, 1.0], expected),
    ]
    for unit, factor in SPEED_UNITS.items():
        if unit != layout.velocity_unit:
            scaled = expected * factor / SPEED_UNITS[layout.velocity_unit]
            others.append((f"velocity_unit = {unit}", moved, scaled))
    return others
