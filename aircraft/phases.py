"""The phases of the mission, each with what it wants of guidance and the condition that ends it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import atan, cos, exp, inf, pi, radians, sin
from typing import get_args

import numpy as np

from ..sins.earth import STANDARD_GRAVITY as G
from .airframe import Airframe
from .guidance import Sensed, Target, clipped
from .mission import GUIDANCE_RATE_HZ, BankProfile, FlightPlan, SManeuver

GEAR_UP_HEIGHT = 10.0
"""Of the wheels over the runway, m."""
CAPTURE_ALTITUDE = 30.0
"""The climb ends so far below the altitude wanted, m."""
SETTLED = 0.5, 0.25, 0.1
"""Level flight has settled when the means of the errors of altitude, speed and climb rate are below these;
m, m/s, m/s."""
MEAN_TIME = 10.0
"""Time constant of those means, s."""
CENTRING = 0.01
"""Heading back to the runway's centre line that wind has carried the aircraft off, rad per m."""
MOST_CENTRING = radians(5.0)
RATE_SPAN = 0.1
"""To either side of now, s, over which a bank profile's roll rate is taken: at a knot it would jump, and the
aileron with it, which shakes the load factor by 1 g."""


@dataclass
class Takeoff:
    """Roll from rest with full throttle and rotation, until no wheel is on the ground."""

    plan: FlightPlan
    airframe: Airframe
    name = "takeoff"
    limit_s = 90.0
    gear = 1.0

    def target(self, t: float, s: Sensed) -> Target:
        heading = radians(self.plan.start.heading_deg)
        rotate = s.airspeed >= self.airframe.rotation_speed_mps
        pitch = radians(self.airframe.rotation_pitch_deg) if rotate else None
        if not self.plan.air.is_calm:
            heading -= clipped(CENTRING * s.off_centre, MOST_CENTRING)
        return Target(self.plan.speed_mps, heading, pitch=pitch, bank=0.0, on_runway=True)

    def finished(self, t: float, s: Sensed) -> bool:
        return not s.on_wheels


@dataclass
class InitialClimb:
    """The pitch of the rotation is held, gear down, until clear of the ground."""

    plan: FlightPlan
    airframe: Airframe
    name = "initial_climb"
    limit_s = 30.0
    gear = 1.0

    def target(self, t: float, s: Sensed) -> Target:
        heading, pitch = radians(self.plan.start.heading_deg), radians(self.airframe.rotation_pitch_deg)
        return Target(self.plan.speed_mps, heading, pitch=pitch, bank=0.0, on_runway=s.on_wheels)

    def finished(self, t: float, s: Sensed) -> bool:
        return s.height > self.airframe.gear_height_m + GEAR_UP_HEIGHT


@dataclass
class _LevelTarget:
    """Altitude, speed and heading of the plan."""

    plan: FlightPlan
    gear = 0.0

    @cached_property
    def level(self) -> Target:
        plan = self.plan
        return Target(plan.speed_mps, radians(plan.start.heading_deg), altitude=plan.altitude_m)

    def target(self, t: float, s: Sensed) -> Target:
        return self.level


@dataclass
class Climb(_LevelTarget):
    """Gear up; climb and accelerate, until the altitude is near."""

    name = "climb"
    limit_s = 300.0

    def finished(self, t: float, s: Sensed) -> bool:
        return s.altitude > self.plan.altitude_m - CAPTURE_ALTITUDE


@dataclass
class Capture(_LevelTarget):
    """Altitude and speed settle, until the mean errors are small."""

    name = "capture"
    limit_s = 300.0
    means: tuple[float, ...] = (-CAPTURE_ALTITUDE, CAPTURE_ALTITUDE, CAPTURE_ALTITUDE)
    """Of the errors of altitude, speed and climb rate; at first far from settled."""

    def finished(self, t: float, s: Sensed) -> bool:
        keep = exp(-1 / (GUIDANCE_RATE_HZ * MEAN_TIME))
        errors = s.altitude - self.plan.altitude_m, s.airspeed - self.plan.speed_mps, s.climb_rate
        self.means = tuple(
            keep * mean + (1 - keep) * error for mean, error in zip(self.means, errors, strict=True)
        )
        return all(abs(mean) < limit for mean, limit in zip(self.means, SETTLED, strict=True))


@dataclass
class Level(_LevelTarget):
    """Settled level flight, until the S-manoeuvre is due."""

    name = "level"
    limit_s = inf

    def finished(self, t: float, s: Sensed) -> bool:
        return t >= self.plan.s_start_s


@dataclass
class SManeuverPhase(_LevelTarget):
    """The S, or the bank profile in its place, at constant altitude and speed, for its duration."""

    name = "s_maneuver"
    limit_s = inf

    def target(self, t: float, s: Sensed) -> Target:
        plan, maneuver, since = self.plan, self.plan.s_maneuver, t - self.plan.s_start_s
        forward = isinstance(maneuver, BankProfile)
        before, after = (-RATE_SPAN, RATE_SPAN) if forward else (0.0, 0.02)
        bank = maneuver_bank(maneuver, since)
        rise = maneuver_bank(maneuver, since + after) - maneuver_bank(maneuver, since + before)
        return Target(
            plan.speed_mps,
            s.heading,
            altitude=plan.altitude_m,
            bank=bank,
            bank_rate=rise / (after - before),
            forward=forward,
        )

    def finished(self, t: float, s: Sensed) -> bool:
        return t >= self.plan.s_start_s + self.plan.s_maneuver.duration_s


@dataclass
class Tail(_LevelTarget):
    """Level flight again, back on the first heading, until the plan's end."""

    name = "tail"
    limit_s = inf

    def finished(self, t: float, s: Sensed) -> bool:
        return t >= self.plan.end_s


MissionPhase = Takeoff | InitialClimb | Climb | Capture | Level | SManeuverPhase | Tail
PHASE_NAMES = tuple(phase.name for phase in get_args(MissionPhase))
"""In the order in which they are flown."""


def s_bank(maneuver: SManeuver, t: float) -> float:
    """Bank wanted ``t`` s after the start of the manoeuvre, rad."""
    edge = min(max(min(t, maneuver.duration_s - t) / maneuver.entry_s, 0.0), 1.0)
    window = 0.5 - 0.5 * cos(pi * edge)
    phase = 2 * pi * t / maneuver.period_s + radians(maneuver.phase_deg)
    return atan(window * maneuver.lateral_acceleration_mps2 * sin(phase) / G)


def maneuver_bank(maneuver: SManeuver | BankProfile, t: float) -> float:
    """Bank wanted ``t`` s after the start of whichever manoeuvre, rad."""
    if isinstance(maneuver, SManeuver):
        return s_bank(maneuver, t)
    return radians(float(np.interp(t, maneuver.times_s, maneuver.banks_deg)))


def mission_phases(plan: FlightPlan, airframe: Airframe) -> Iterator[MissionPhase]:
    """The phases in their order, new for each flight."""
    yield Takeoff(plan, airframe)
    yield InitialClimb(plan, airframe)
    yield Climb(plan)
    yield Capture(plan)
    yield Level(plan)
    yield SManeuverPhase(plan)
    yield Tail(plan)
