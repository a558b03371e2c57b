"""The study of the command `maneuver`: a scenario's best bank profile, flown and aligned on beside its S."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..aircraft.flight import Flight
from ..aircraft.mission import BankProfile, SManeuver
from ..aircraft.phases import maneuver_bank
from ..align.bound import Knowledge
from ..align.estimate import Array, Estimate
from ..align.maneuver import Maneuver, ManeuverSearch, Profile
from ..align.maneuver_bound import AlignmentTask
from ..align.maneuver_limits import ManeuverLimits
from ..align.maneuver_starts import s_families
from ..network.source import FixSource
from ..sins import attitude
from ..sins.units import DEG, MILLISECOND
from .bound import bound_of
from .run import Run, alignment_window, fixes_of, simulate_all
from .scenario import Scenario, ScenarioError, replaced
from .score import FilterScore, Scorer, standard_deviations

Progress = Callable[[float, float], None]

POSITION_SD_M = 10.0
VELOCITY_SD_MPS = 0.03
"""Of the fixes, where the scenario has a network and the options do not say."""
TAIL_S = 40.0
"""Level flight after the manoeuvre: the aircraft returns to its course."""
BANK_STEP_DEG = 0.01
"""To which the profile is rounded for the scenario."""


@dataclass(frozen=True)
class Flown:
    """A manoeuvre as flown, and what the filters make of it.

    ``bound_sd`` (m, 5), with stamps known, and ``unstamped_sd`` (5,), at the end with delays unknown, as
    `score.standard_deviations` gives them; ``first`` is run 0.
    """

    scenario: Scenario
    flight: Flight
    window: Flight
    bound: Estimate
    bound_sd: Array
    unstamped_sd: Array
    scores: dict[str, FilterScore]
    first: Run

    @property
    def asked_bank(self) -> Array:
        """Bank that was asked for, rad, at the rows of the window."""
        since = self.window.time - self.window.time[0]
        return np.array([maneuver_bank(self.scenario.flight.s_maneuver, t) for t in since])

    @property
    def course(self) -> Array:
        """Heading against that at the start, rad, without jumps, at the rows of the window."""
        heading = np.unwrap(attitude.to_euler(self.window.q_nb)[:, 2])
        return heading - heading[0]


@dataclass(frozen=True)
class GridPoint:
    """An S of the grid: bank, deg, period, s, phase, deg, entry, s; bounds at its end."""

    bank_deg: float
    period_s: float
    phase_deg: float
    entry_s: float
    level_arcsec: float
    heading_arcmin: float
    cost: float


@dataclass(frozen=True)
class ManeuverStudy:
    """All that the report shows."""

    task: AlignmentTask
    limits: ManeuverLimits
    search: ManeuverSearch
    maneuver: Maneuver
    seconds: float
    """That the search took."""
    grid: tuple[GridPoint, ...]
    s: Flown
    best: Flown


def with_stated_fixes(
    scenario: Scenario, origin: str, limits: ManeuverLimits, options: dict[str, Any]
) -> Scenario:
    """The scenario on simulated fixes, aligning for the manoeuvre's duration from its start, and with an S.

    ``options``: `rate_hz`, `position_sd_m`, `velocity_sd_mps`, each None where the scenario decides.
    Raises `ScenarioError`.
    """
    if scenario.fixes.kind == "replay":
        raise ScenarioError(f"{origin}: fixes.kind = 'replay': the noise of recorded fixes is not stated")
    content: dict[str, Any] = {"variants": {}, "paper": None}
    if not isinstance(scenario.fixes, FixSource):
        stated = {"position_sd_m": POSITION_SD_M, "velocity_sd_mps": VELOCITY_SD_MPS}
        content["fixes"] = {"kind": "simulated", "rate_hz": scenario.fixes.rate_hz, **stated}
        content["alignment.settings.delay_sd_ms"] = round(FixSource().delay_sd_s / MILLISECOND, 3)
        scenario = replaced(scenario, content, origin="option")
        content = {}
    if not isinstance(scenario.flight.s_maneuver, SManeuver):
        content["flight.s_maneuver"] = {"kind": "s"}
        scenario = replaced(scenario, content, origin="option")
    content |= {f"fixes.{name}": value for name, value in options.items() if value is not None}
    content |= {
        "flight.s_maneuver.duration_s": limits.duration_s,
        "alignment.start": "s_maneuver",
        "alignment.duration_s": limits.duration_s,
    }
    return replaced(scenario, content, origin="option")


def task_of(scenario: Scenario) -> AlignmentTask:
    """What the scenario aligns, on what. Raises TypeError unless its fixes are simulated."""
    fixes, plan = scenario.fixes, scenario.flight
    if not isinstance(fixes, FixSource):
        raise TypeError(f"fixes.kind {fixes.kind!r}: the noise is not stated")
    return AlignmentTask(
        settings=scenario.alignment.settings,
        imu=scenario.imu,
        rate_hz=fixes.rate_hz * (1 - fixes.loss_probability),
        position_sd_m=fixes.position_sd_m,
        velocity_sd_mps=fixes.velocity_sd_mps,
        speed_mps=plan.speed_mps,
        heading=plan.start.heading_deg * DEG,
        latitude=plan.start.latitude_deg * DEG,
        altitude_m=plan.altitude_m,
    )


def with_profile(scenario: Scenario, profile: Profile) -> Scenario:
    """The scenario flying the profile in the place of its manoeuvre, and then back to its course."""
    banks = np.round(profile.bank / DEG / BANK_STEP_DEG) * BANK_STEP_DEG
    flown = BankProfile(
        times_s=tuple(np.round(profile.time, 6).tolist()),
        banks_deg=tuple(np.round(banks + 0.0, 6).tolist()),
    )
    tail_s = max(scenario.flight.tail_s, TAIL_S)
    changes = {
        "title": f"{scenario.title}: best manoeuvre",
        "flight.s_maneuver": flown.model_dump(mode="json"),
        "flight.tail_s": tail_s,
    }
    return replaced(scenario, changes, origin="best manoeuvre")


def grid_of(
    task: AlignmentTask,
    limits: ManeuverLimits,
    search: ManeuverSearch,
    steps: tuple[int, int, int] = (4, 8, 4),
    progress: Progress | None = None,
) -> tuple[GridPoint, ...]:
    """Bounds of the S families within the limits, the least cost first."""
    n = max(round(limits.duration_s / search.knot_s), 8)
    dt = limits.duration_s / n
    families, points = s_families(task, limits, dt, n, steps), []
    for (bank, period, phase, entry), banks in families.items():
        profile = Profile(banks, dt, task)
        level, heading = float(profile.level_arcsec[-1]), float(profile.heading_arcmin[-1])
        cost = profile.cost(search.heading_weight)
        points.append(GridPoint(bank, period, phase, entry, level, heading, cost))
        if progress:
            progress(len(points), len(families))
    return tuple(sorted(points, key=lambda point: point.cost))


def align_on(scenario: Scenario, flight: Flight, progress: Progress | None = None) -> Flown:
    """All runs of the scenario on its flight, and the bound along it."""
    window = alignment_window(scenario, flight)
    scorer, first = Scorer(window, scenario.alignment.filters), None
    for run in simulate_all(scenario, flight, scenario.runs, scenario.seed, progress):
        first = first or run
        scorer.add(run)
    assert first is not None
    fixes = [fixes_of(scenario, flight, 0, scenario.seed)[0]]
    bound, unstamped = (
        bound_of(scenario, window, fixes, what) for what in (Knowledge.STAMPED, Knowledge.DELAY_UNKNOWN)
    )
    vibration_mps = scenario.imu.vibration_mps
    return Flown(
        scenario,
        flight,
        window,
        bound,
        standard_deviations(window, bound, vibration_mps),
        standard_deviations(window, unstamped, vibration_mps)[-1],
        scorer.scores(),
        first,
    )
