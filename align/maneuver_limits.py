"""Limits within which a manoeuvre is sought, and a check of them that knows nothing of the search."""

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..sins.settings import Settings
from ..sins.units import DEG


class ManeuverLimits(Settings):
    """What the profile must keep to; it starts and ends with the wings level and no roll rate."""

    duration_s: float = Field(default=40.0, ge=5, le=40)
    max_bank_deg: float = Field(default=60.0, ge=5, le=80)
    """That the aircraft may reach, either side."""
    bank_margin_deg: float = Field(default=1.2, ge=0, le=10)
    """The profile stays so far below `max_bank_deg`: room for the aircraft to overshoot."""
    max_load_factor_g: float = Field(default=3.0, ge=1.01, le=9)
    """Of the steady turn, ``1 / cos(bank)``; rolling adds to it in flight."""
    max_roll_rate_deg_s: float = Field(default=30.0, ge=2, le=180)
    max_roll_acceleration_deg_s2: float = Field(default=30.0, ge=2, le=1000)
    """So that the aircraft can follow: the roll rate steps at the knots by this times their interval."""
    max_heading_excursion_deg: float = Field(default=180.0, ge=1, le=3600)
    """From the course at the start, either side, at any time."""
    course_tolerance_deg: float = Field(default=180.0, ge=0.1, le=3600)
    """Departure from the course at the end; small means back on course when the alignment ends."""
    whole_turns: bool = False
    """Whether a course regained after a full circle counts as regained."""

    @property
    def profile_bank_deg(self) -> float:
        """Largest bank of the profile: by bank, margin and load factor."""
        return min(self.max_bank_deg - self.bank_margin_deg, np.arccos(1 / self.max_load_factor_g) / DEG)

    def broken(self, bank: ArrayLike, dt: float, heading: ArrayLike, slack: float = 0.0) -> list[str]:
        """Limits that a profile breaks by more than the part ``slack`` of them, one line each.

        ``bank`` and ``heading``, (n + 1,) rad, at knots ``dt`` s apart; lines straight between them.
        """
        bank, turn = np.asarray(bank, float) / DEG, (np.asarray(heading, float) - np.ravel(heading)[0]) / DEG
        rate = np.diff(bank) / dt
        acceleration = np.diff(rate, prepend=0.0, append=0.0) / dt
        off_course = turn[-1] - 360 * np.round(turn[-1] / 360) if self.whole_turns else turn[-1]
        worst = (
            ("bank", np.abs(bank).max(), self.profile_bank_deg, "deg"),
            ("load factor", 1 / np.cos(bank * DEG).min(), self.max_load_factor_g, "g"),
            ("roll rate", np.abs(rate).max(), self.max_roll_rate_deg_s, "deg/s"),
            ("roll acceleration", np.abs(acceleration).max(), self.max_roll_acceleration_deg_s2, "deg/s^2"),
            ("heading excursion", np.abs(turn).max(), self.max_heading_excursion_deg, "deg"),
            ("course at the end", abs(off_course), self.course_tolerance_deg, "deg"),
        )
        told = [
            f"{what} {value:.2f} {unit}: at most {limit:g}"
            for what, value, limit, unit in worst
            if not value <= limit * (1 + slack) + 1e-6
        ]
        ends = np.abs(bank[[0, -1]]).max()
        return [*told, f"bank at an end {ends:.2f} deg: must be 0"] if ends > 1e-6 else told
