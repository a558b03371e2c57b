"""The mission's settings: take-off, climb, level flight, manoeuvre, and the air it is flown in."""

from enum import StrEnum
from itertools import pairwise
from math import atan, cos, degrees, lcm, pi
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from ..sins.earth import STANDARD_GRAVITY
from ..sins.settings import Settings
from .airframe import airframe_names, load_airframe
from .failures import EngineOut, Failure

GUIDANCE_RATE_HZ = 50
"""Rate of guidance, of the mission's phases and of the envelope monitor."""
FASTEST_MODEL_HZ = 3200
"""Highest rate of the flight model."""


class Start(Settings):
    """Where and how the aircraft stands before the brakes are released.

    Gao et al. (Table 1) give the initial attitude as (0, 0, 45) deg, the last of it a roll angle; no
    aircraft stands on a runway like that, so the 45 deg are taken for the heading.
    """

    longitude_deg: float = Field(default=120.0, ge=-180, le=180)
    latitude_deg: float = Field(default=30.0, ge=-80, le=80)
    altitude_m: float = Field(default=5.0, ge=-100, le=3000)
    """Of the centre of gravity at rest on the gear, over the ellipsoid; the runway is below it by the
    height of the gear."""
    heading_deg: float = Field(default=45.0, ge=-180, le=360)
    runway_length_m: float = Field(default=3500.0, ge=100, le=10000)
    """A take-off that is longer fails."""
    runway_width_m: float = Field(default=45.0, ge=10, le=200)
    """A take-off that leaves it to a side fails."""


class SManeuver(Settings):
    """A sinusoidal lateral acceleration ``a sin(2 pi t / period + phase)`` made by coordinated bank.

    Its amplitude is raised and lowered smoothly over ``entry_s`` at both ends, so that the bank starts and
    ends near zero whatever the phase.
    """

    kind: Literal["s"] = "s"
    duration_s: float = Field(default=40.0, ge=5, le=40)
    lateral_acceleration_mps2: float = Field(default=6.0, ge=0, le=25)
    """Peak; the bank is ``atan(a / g)``."""
    period_s: float = Field(default=20.0, ge=4, le=80)
    phase_deg: float = Field(default=0.0, ge=-360, le=360)
    entry_s: float = Field(default=2.0, ge=0.5, le=10)

    @property
    def bank_deg(self) -> float:
        """Peak bank."""
        return degrees(atan(self.lateral_acceleration_mps2 / STANDARD_GRAVITY))


class BankProfile(Settings):
    """A bank flown by the clock in the place of the S: straight lines between knots, from zero to zero."""

    kind: Literal["bank_profile"] = "bank_profile"
    times_s: tuple[float, ...] = Field(min_length=3, max_length=4001)
    """From the start of the manoeuvre; the first is 0, the last, its duration, at least 5 and at most 40."""
    banks_deg: tuple[float, ...]
    """Positive with the right wing down; the first and the last are 0."""

    @model_validator(mode="after")
    def _can_be_followed(self) -> "BankProfile":
        times, banks = self.times_s, self.banks_deg
        if len(times) != len(banks):
            raise ValueError(f"times_s has {len(times)} values and banks_deg has {len(banks)}")
        if times[0] != 0 or not 5 <= times[-1] <= 40:
            raise ValueError(f"times_s from {times[0]:g} to {times[-1]:g} s: from 0 to within [5, 40] s")
        for before, after in pairwise(times):
            if after - before < 0.01 - 1e-9:
                raise ValueError(f"times_s: {after:g} s after {before:g} s; knots are at least 0.01 s apart")
        if banks[0] != 0 or banks[-1] != 0:
            raise ValueError(f"banks_deg from {banks[0]:g} to {banks[-1]:g} deg: both ends must be 0 deg")
        if self.bank_deg > 85:
            raise ValueError(f"banks_deg reaches {self.bank_deg:g} deg: allowed is [-85, 85] deg")
        return self

    @property
    def duration_s(self) -> float:
        """Of the whole profile."""
        return self.times_s[-1]

    @property
    def bank_deg(self) -> float:
        """Peak bank, either side."""
        return max(map(abs, self.banks_deg))

    @property
    def roll_rate_deg_s(self) -> float:
        """Peak roll rate, either way."""
        knots = pairwise(zip(self.times_s, self.banks_deg, strict=True))
        return max(abs(after[1] - before[1]) / (after[0] - before[0]) for before, after in knots)


def _kind(maneuver: Any) -> Any:
    return maneuver.get("kind", "s") if isinstance(maneuver, dict) else getattr(maneuver, "kind", None)


Maneuver = Annotated[
    Annotated[SManeuver, Tag("s")] | Annotated[BankProfile, Tag("bank_profile")],
    Discriminator(_kind),
]
"""What is flown for the alignment, chosen by ``kind``; ``"s"`` need not be said."""


class Turbulence(StrEnum):
    """JSBSim's turbulence models."""

    NONE = "none"
    MILSPEC = "milspec"
    TUSTIN = "tustin"


Gusting = Annotated[float, Field(ge=-30, le=30)]


class Gust(Settings):
    """A discrete gust (MIL-F-8785C): ``(1 - cos) / 2`` up, held, and down again."""

    start_s: float = Field(ge=0, le=5000)
    """From brake release."""
    rise_s: float = Field(default=0.5, ge=0.1, le=60)
    """Of the way up, and of the way down."""
    hold_s: float = Field(default=0.0, ge=0, le=600)
    north_mps: Gusting = 0.0
    """Velocity of the air at its height, as that of the steady wind."""
    east_mps: Gusting = 0.0
    down_mps: Gusting = 0.0

    def share(self, t: float) -> float:
        """Of its height at ``t``, s from brake release."""
        since = t - self.start_s
        edge = min(since, 2 * self.rise_s + self.hold_s - since) / self.rise_s
        return 0.5 - 0.5 * cos(pi * min(max(edge, 0.0), 1.0))


class Air(Settings):
    """Steady wind, gusts and turbulence."""

    wind_north_mps: float = Field(default=0.0, ge=-25, le=25)
    """Velocity of the air, so a wind *from* the south is positive."""
    wind_east_mps: float = Field(default=0.0, ge=-25, le=25)
    wind_down_mps: float = Field(default=0.0, ge=-5, le=5)
    gusts: tuple[Gust, ...] = Field(default=(), max_length=100)
    turbulence: Turbulence = Turbulence.NONE
    """From the take-off roll on."""
    turbulence_wind_mps: float = Field(default=7.62, ge=0, le=25)
    """Wind speed 20 ft above the ground, which sets the turbulence below 2000 ft (MIL-F-8785C)."""
    turbulence_severity: int = Field(default=3, ge=1, le=7)
    """Row of MIL-F-8785C's exceedance table, which sets the turbulence above 2000 ft: 3 light, 4 moderate,
    6 severe."""

    @property
    def is_calm(self) -> bool:
        """Whether it does not move."""
        wind = self.wind_north_mps, self.wind_east_mps, self.wind_down_mps
        return not (any(wind) or self.gusts) and self.turbulence is Turbulence.NONE

    def gust_n(self, t: float) -> tuple[float, float, float]:
        """Sum of the gusts at ``t``, NED, m/s."""
        north = east = down = 0.0
        for gust in self.gusts:
            share = gust.share(t)
            north += share * gust.north_mps
            east += share * gust.east_mps
            down += share * gust.down_mps
        return north, east, down


class FlightPlan(Settings):
    """Everything that determines a flight: the same plan gives the same flight, bit for bit.

    Take-off from rest, climb to ``altitude_m``, level flight at ``speed_mps`` until ``s_start_s``, the
    S-manoeuvre or a bank profile, and level flight on the first heading for ``tail_s``. Gao et al., section
    5.1: 1015 m, 200 m/s, an alignment of at most 40 s; 500 s of localisation come before it. Times are
    seconds from brake release.
    """

    airframe: str = "f16"
    start: Start = Start()
    altitude_m: float = Field(default=1015.0, ge=200, le=5000)
    speed_mps: float = Field(default=200.0, ge=120, le=280)
    """Airspeed, relative to the air that moves with the steady wind."""
    s_start_s: float = Field(default=500.0, ge=60, le=3600)
    """Level flight must have settled by then."""
    s_maneuver: Maneuver = SManeuver()
    """An S, or a bank profile in its place."""
    tail_s: float = Field(default=5.0, ge=0, le=600)
    air: Air = Air()
    failures: tuple[Failure, ...] = Field(default=(), max_length=10)
    """A flight that they end is a `FlightError`."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """Of the turbulence."""
    imu_rate_hz: int = Field(default=100, ge=50, le=800)
    """Rate of the flight's rows."""
    fdm_rate_hz: int = Field(default=0, ge=0, le=FASTEST_MODEL_HZ)
    """Rate of the flight model; a multiple of the IMU's and of 50 Hz. 0: the least of these from 500 Hz.

    In turbulence gusts shake the body within a step: from 800 Hz, with an IMU above 100 Hz from 1200 Hz, or
    a perfect IMU no longer returns to the truth within 0.1 arcsec; 0.4 where it is severe. An IMU below
    100 Hz does not in turbulence at any rate of the model: its own samples are too few for the coning."""

    @field_validator("airframe")
    @classmethod
    def _known_airframe(cls, name: str) -> str:
        if name.lower() not in airframe_names():
            raise ValueError(f"unknown airframe; known: {', '.join(airframe_names())}")
        return name.lower()

    @model_validator(mode="after")
    def _rates_divide(self) -> "FlightPlan":
        rate, least = self.model_rate_hz, self._least_rate_hz
        if rate > FASTEST_MODEL_HZ:
            raise ValueError(
                f"imu_rate_hz {self.imu_rate_hz}: the flight model's rate, a multiple of it and of guidance's"
                f" {GUIDANCE_RATE_HZ} Hz, would be {rate} Hz; allowed are {least} to {FASTEST_MODEL_HZ} Hz"
            )
        if rate % self.imu_rate_hz or rate % GUIDANCE_RATE_HZ or rate < least:
            raise ValueError(
                f"fdm_rate_hz {rate}: {least} to {FASTEST_MODEL_HZ} Hz in this air, and a multiple of"
                f" imu_rate_hz {self.imu_rate_hz} and of guidance's {GUIDANCE_RATE_HZ}"
            )
        return self

    @model_validator(mode="after")
    def _engines_exist(self) -> "FlightPlan":
        engines = load_airframe(self.airframe).engines
        for number, failure in enumerate(self.failures):
            if isinstance(failure, EngineOut) and failure.engine > engines:
                raise ValueError(
                    f"failures[{number}].engine = {failure.engine}: the {self.airframe} has {engines}"
                )
        return self

    @model_validator(mode="after")
    def _failures_in_flight(self) -> "FlightPlan":
        for number, failure in enumerate(self.failures):
            if failure.time_s >= self.end_s:
                raise ValueError(
                    f"failures[{number}].time_s = {failure.time_s:g} s: the flight ends before, at"
                    f" {self.end_s:g} s"
                )
        return self

    @property
    def model_rate_hz(self) -> int:
        """Rate at which the flight model runs."""
        if self.fdm_rate_hz:
            return self.fdm_rate_hz
        common = lcm(self.imu_rate_hz, GUIDANCE_RATE_HZ)
        least = self._least_rate_hz if self.is_rough else 500
        return -(-least // common) * common

    @property
    def is_rough(self) -> bool:
        """Whether the air is turbulent."""
        return self.air.turbulence is not Turbulence.NONE

    @property
    def _least_rate_hz(self) -> int:
        """That a plan may state."""
        if not self.is_rough:
            return 100
        return 800 if self.imu_rate_hz <= 100 else 1200

    @property
    def end_s(self) -> float:
        """Time at which the flight ends."""
        return self.s_start_s + self.s_maneuver.duration_s + self.tail_s
