"""The envelope monitor: ends a flight that leaves what its airframe and plan allow."""

from math import cos, degrees, isfinite, pi, radians

from .airframe import Airframe
from .guidance import MAX_BANK_SHARE, Sensed
from .mission import BankProfile, FlightPlan, SManeuver
from .phases import MissionPhase

ALTITUDE_BUST_M = 50.0
"""Departure from the altitude wanted that ends a flight in level flight and in the S."""
LEAST_LEVEL_S = 1.0
"""Settled level flight before the S-manoeuvre, s: what is reported of level flight needs some."""
RUNWAY_HEADING_DEG = 20.0
"""Departure from the runway's heading that ends a take-off."""


GUST_LOAD_G = 1.0
"""What turbulence may add beyond an airframe's limits, which are that much inside of its design."""
BOUNCE_S = 2.0
"""After lift-off the wheels may touch the runway again for so long."""


class FlightError(RuntimeError):
    """A plan that cannot be flown: phase and time (s from brake release) of the failure, and the reason."""

    def __init__(self, phase: str, time_s: float, reason: str) -> None:
        super().__init__(f"flight failed in phase {phase} at {time_s:.2f} s: {reason}")
        self.phase = phase
        self.time_s = time_s
        self.reason = reason


def _beyond_guidance(maneuver: SManeuver | BankProfile, airframe: Airframe) -> str | None:
    """Why guidance may not fly the manoeuvre with this airframe, or None."""
    limits, allows = airframe.limits, f"guidance allows the {airframe.name}"
    allowed = MAX_BANK_SHARE * limits.bank_deg
    if maneuver.bank_deg > allowed:
        needs = (
            f"{maneuver.lateral_acceleration_mps2:g} m/s^2 needs"
            if isinstance(maneuver, SManeuver)
            else "the bank profile needs"
        )
        return f"{needs} {maneuver.bank_deg:.1f} deg of bank, {allows} {allowed:.1f} deg"
    if isinstance(maneuver, SManeuver):
        return None
    rate, load_factor = maneuver.roll_rate_deg_s, 1 / cos(radians(maneuver.bank_deg))
    if rate > limits.roll_rate_deg_s + 1e-6:
        most = limits.roll_rate_deg_s
        return f"the bank profile needs a roll rate of {rate:.1f} deg/s, {allows} {most:.1f} deg/s"
    if load_factor > limits.load_factor_max_g:
        return f"the bank profile needs {load_factor:.1f} g, {allows} {limits.load_factor_max_g:g} g"
    return None


class Envelope:
    """Watches one flight."""

    def __init__(self, plan: FlightPlan, airframe: Airframe) -> None:
        """Raises FlightError for a manoeuvre steeper or quicker than guidance may bank this airframe."""
        self.plan = plan
        self.limits = airframe.limits
        self.heading = radians(plan.start.heading_deg)
        reason = _beyond_guidance(plan.s_maneuver, airframe)
        if reason:
            raise FlightError("s_maneuver", plan.s_start_s, reason)

    def check(self, phase: MissionPhase, t: float, elapsed: float, s: Sensed) -> None:
        """Raises FlightError when the state at ``t``, ``elapsed`` s into the phase, is outside."""
        reason = self._fault(phase, t, elapsed, s)
        if reason:
            failed = [
                f"{failure.told} at {failure.time_s:g} s"
                for failure in self.plan.failures
                if failure.time_s <= t
            ]
            raise FlightError(phase.name, t, "; ".join([reason, *failed]))

    def _fault(self, phase: MissionPhase, t: float, elapsed: float, s: Sensed) -> str | None:
        if not isfinite(s.altitude + s.airspeed + s.roll + s.pitch + s.heading + s.p + s.q + s.r + s.alpha):
            return "the state is no longer finite"
        if elapsed > phase.limit_s:
            return f"not finished within {phase.limit_s:g} s"
        if phase.name == "takeoff":
            return self._runway_fault(s)
        if phase.name == "initial_climb":
            return self._runway_fault(s) or self._airborne_fault(s, may_touch=elapsed < BOUNCE_S)
        if t >= self.plan.s_start_s - LEAST_LEVEL_S and phase.name in ("climb", "capture"):
            return (
                f"level flight at {self.plan.altitude_m:g} m and {self.plan.speed_mps:g} m/s has not settled"
                f" when the S-manoeuvre is due (now {s.altitude:.1f} m, {s.airspeed:.1f} m/s)"
            )
        reason = self._airborne_fault(s, may_touch=False)
        if reason:
            return reason
        error = s.altitude - self.plan.altitude_m
        if error > ALTITUDE_BUST_M or (phase.name != "climb" and error < -ALTITUDE_BUST_M):
            return (
                f"altitude {s.altitude:.1f} m, more than {ALTITUDE_BUST_M:g} m off {self.plan.altitude_m:g} m"
            )
        return None

    def _airborne_fault(self, s: Sensed, may_touch: bool) -> str | None:
        limits = self.limits
        if s.height < 0.0 or (s.on_wheels and not may_touch):
            return "ground contact in flight"
        alpha = degrees(s.alpha)
        if not limits.alpha_min_deg <= alpha <= limits.alpha_max_deg:
            return (
                f"stall: angle of attack {alpha:.1f} deg outside {limits.alpha_min_deg:g} to"
                f" {limits.alpha_max_deg:g} deg"
            )
        margin = GUST_LOAD_G if self.plan.is_rough else 0.0
        least, most = limits.load_factor_min_g - margin, limits.load_factor_max_g + margin
        if not least <= s.load_factor <= most:
            return f"load factor {s.load_factor:.2f} g outside {least:g} to {most:g} g"
        if abs(degrees(s.roll)) > limits.bank_deg:
            return f"bank {degrees(s.roll):.1f} deg beyond {limits.bank_deg:g} deg"
        return None

    def _runway_fault(self, s: Sensed) -> str | None:
        runway, width = self.plan.start.runway_length_m, self.plan.start.runway_width_m
        if s.distance > runway:
            return f"runway of {runway:g} m overrun at {s.airspeed:.1f} m/s"
        if s.on_wheels and abs(s.off_centre) > 0.5 * width:
            return f"left the runway of {width:g} m to a side at {s.airspeed:.1f} m/s"
        if abs(degrees((s.heading - self.heading + pi) % (2 * pi) - pi)) > RUNWAY_HEADING_DEG:
            return f"left the runway's heading by more than {RUNWAY_HEADING_DEG:g} deg"
        return None
