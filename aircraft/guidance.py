"""Guidance laws: from altitude, speed, heading or bank wanted to control surfaces and throttle.

Cascades in plain floats, run at a rate below the flight model's:

- altitude error -> climb rate (slewed) -> vertical acceleration -> pitch rate -> elevator (PI),
- heading error -> bank (slewed) -> roll rate -> aileron (PI),
- speed error -> throttle (PI, slewed).

References
----------
.. [1] B. L. Stevens, F. L. Lewis, E. N. Johnson, "Aircraft Control and Simulation", 3rd ed., chapter 4.
"""

from dataclasses import dataclass
from math import atan, copysign, cos, pi, radians, sin, sqrt

from ..sins.earth import STANDARD_GRAVITY as G
from .airframe import Airframe

VERTICAL_ACCELERATION = 1.5
"""Slew of the climb rate asked for, m/s^2."""
LEVEL_OFF = 1.0
"""Vertical acceleration planned for levelling off, m/s^2; below the slew, so that the rate can follow."""
INTEGRAL_LIMIT = 0.8
"""Largest part of a surface or of the throttle that an integrator may hold."""
MAX_BANK_SHARE = 0.9
"""Part of the airframe's bank limit that guidance uses."""
MIN_SPEED = 30.0
"""Floor of the airspeed, m/s, in the laws that divide by it."""


@dataclass(slots=True)
class Sensed:
    """What guidance and the envelope monitor read from the flight model; SI and radians, frames as in `sins`.

    ``airspeed`` is the speed relative to the air that moves with the steady wind (turbulence left out), so
    that gusts do not work the throttle.
    """

    altitude: float
    height: float
    """Of the centre of gravity over the runway's elevation, m."""
    climb_rate: float
    airspeed: float
    roll: float
    pitch: float
    heading: float
    p: float
    q: float
    r: float
    alpha: float
    load_factor: float
    dynamic_pressure: float
    on_wheels: bool
    distance: float
    """From the start of the take-off roll, m."""
    off_centre: float = 0.0
    """To the right of the runway's centre line, m."""


@dataclass(slots=True)
class Target:
    """What a mission phase wants. Without ``altitude`` the pitch is held; without both the elevator rests.

    Without ``bank`` the heading is held. ``bank_rate`` is fed forward, rad/s; ``forward`` has guidance feed
    the surfaces forward as well that the roll rate and the lift of the turn take, as quick turns need.
    """

    speed: float
    heading: float
    altitude: float | None = None
    pitch: float | None = None
    bank: float | None = None
    bank_rate: float = 0.0
    forward: bool = False
    on_runway: bool = False


@dataclass(slots=True)
class Controls:
    """Normalised commands as JSBSim takes them: surfaces -1 to 1, throttle 0 to 1."""

    elevator: float
    aileron: float
    rudder: float
    steer: float
    throttle: float


def clipped(x: float, limit: float) -> float:
    """``x`` brought into [-limit, limit]."""
    return limit if x > limit else -limit if x < -limit else x


class Guidance:
    """The laws' state: integrators and slewed commands. One instance a flight."""

    def __init__(self, airframe: Airframe, dt: float) -> None:
        """``dt``: s between two calls of `update`."""
        self.gains = airframe.gains
        self.dt = dt
        self.max_bank = MAX_BANK_SHARE * radians(airframe.limits.bank_deg)
        self.max_roll_rate = radians(airframe.limits.roll_rate_deg_s)
        self.max_pitch_rate = radians(airframe.limits.pitch_rate_deg_s)
        self.max_climb_rate = airframe.limits.climb_rate_mps
        self.climb_rate: float | None = None
        self.bank = 0.0
        self.elevator_integral = 0.0
        self.aileron_integral = 0.0
        self.steer_integral = 0.0
        self.throttle_integral = 0.0
        self.throttle = 0.0

    def update(self, s: Sensed, target: Target) -> Controls:
        """Controls for the next ``dt``."""
        surface_scale = self.gains.reference_dynamic_pressure_pa / max(s.dynamic_pressure, 500.0)
        rudder, steer = self._yaw(s, target)
        return Controls(
            self._elevator(s, target, surface_scale),
            self._aileron(s, target, surface_scale),
            rudder,
            steer,
            self._throttle(s, target),
        )

    def _elevator(self, s: Sensed, target: Target, scale: float) -> float:
        gains = self.gains
        if target.altitude is not None:
            speed, cos_roll = max(s.airspeed, MIN_SPEED), max(cos(s.roll), 0.2)
            acceleration = self._vertical_acceleration(s, target.altitude)
            # The flight path's own pitch rate, the one of the turn, and what it takes to change the lift.
            rate = acceleration / (speed * cos_roll) + G / speed * sin(s.roll) * sin(s.roll) / cos_roll
            load_factor = (acceleration / G + cos(s.pitch)) / cos_roll
            rate += gains.load_factor_rad_s_g * (load_factor - s.load_factor)
        elif target.pitch is not None:
            rate = gains.pitch_per_s * (target.pitch - s.pitch)
        else:
            return 0.0
        error = clipped(rate, self.max_pitch_rate) - s.q
        self.elevator_integral = clipped(
            self.elevator_integral + gains.pitch_rate_integral * error * self.dt, INTEGRAL_LIMIT
        )
        # JSBSim's elevator is negative for nose up.
        elevator = gains.pitch_rate_s * error + self.elevator_integral
        if target.forward:
            elevator += gains.elevator_forward_per_g * (1 / max(cos(s.roll), 0.2) - 1)
        return -clipped(scale * elevator, 1.0)

    def _vertical_acceleration(self, s: Sensed, altitude: float) -> float:
        if self.climb_rate is None:
            self.climb_rate = s.climb_rate
        wanted = self._climb_rate_wanted(altitude - s.altitude)
        change = clipped(wanted - self.climb_rate, VERTICAL_ACCELERATION * self.dt)
        self.climb_rate += change
        return change / self.dt + self.gains.climb_rate_per_s * (self.climb_rate - s.climb_rate)

    def _climb_rate_wanted(self, error: float) -> float:
        """Linear in a small altitude error; of a large one what `LEVEL_OFF` stops in time."""
        gain, distance = self.gains.altitude_per_s, abs(error)
        rate = gain * distance
        if rate > LEVEL_OFF / gain:
            rate = sqrt(2 * LEVEL_OFF * distance - (LEVEL_OFF / gain) ** 2)
        return copysign(min(rate, self.max_climb_rate), error)

    def _aileron(self, s: Sensed, target: Target, scale: float) -> float:
        gains = self.gains
        bank = target.bank
        if bank is None:
            error = (target.heading - s.heading + pi) % (2 * pi) - pi
            turn_rate = 0.0 if target.on_runway else gains.heading_per_s * error
            bank = atan(turn_rate * s.airspeed / G)
        bank = clipped(bank, self.max_bank)
        self.bank += clipped(bank - self.bank, self.max_roll_rate * self.dt)
        rate = gains.bank_per_s * (self.bank - s.roll) + target.bank_rate
        error = clipped(rate, self.max_roll_rate) - s.p
        if not target.on_runway:
            self.aileron_integral = clipped(
                self.aileron_integral + gains.roll_rate_integral * error * self.dt, INTEGRAL_LIMIT
            )
        aileron = gains.roll_rate_s * error + self.aileron_integral
        if target.forward:
            aileron += gains.aileron_forward_s * target.bank_rate
        return clipped(scale * aileron, 1.0)

    def _yaw(self, s: Sensed, target: Target) -> tuple[float, float]:
        """Rudder and nose wheel."""
        gains = self.gains
        if target.on_runway:
            error = (target.heading - s.heading + pi) % (2 * pi) - pi
            self.steer_integral = clipped(
                self.steer_integral + gains.runway_steer_integral_per_s * error * self.dt, INTEGRAL_LIMIT
            )
            steer = gains.runway_steer * error - gains.runway_steer_rate_s * s.r + self.steer_integral
            return clipped(-steer, 1.0), clipped(steer, 1.0)
        turn_rate = G / max(s.airspeed, MIN_SPEED) * sin(s.roll)
        if target.forward:
            return gains.rudder_forward_s * turn_rate, 0.0
        return clipped(gains.turn_rudder_s * turn_rate, 1.0), 0.0

    def _throttle(self, s: Sensed, target: Target) -> float:
        gains = self.gains
        error = target.speed - s.airspeed
        wanted = gains.throttle_s_per_m * error + self.throttle_integral
        if 0.0 < wanted < 1.0:
            # Frozen while saturated, so that the climb does not wind it up.
            self.throttle_integral += gains.throttle_integral_per_m * error * self.dt
        wanted = min(max(wanted, 0.0), 1.0)
        self.throttle += clipped(wanted - self.throttle, gains.throttle_slew_per_s * self.dt)
        return self.throttle
