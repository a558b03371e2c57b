"""Airframes that can fly the mission: limits and gains, one TOML file an airframe."""

import tomllib
from importlib import resources

from pydantic import Field

from ..sins.settings import Settings


class Limits(Settings):
    """The envelope inside which an airframe is flown; a flight that leaves it ends with a `FlightError`."""

    bank_deg: float = Field(gt=0, le=85)
    """Largest bank, either side."""
    roll_rate_deg_s: float = Field(gt=0, le=360)
    """Largest roll rate that guidance asks for."""
    pitch_rate_deg_s: float = Field(gt=0, le=60)
    """Largest pitch rate that guidance asks for."""
    load_factor_min_g: float = Field(ge=-4, le=0.5)
    load_factor_max_g: float = Field(ge=1.5, le=9)
    alpha_min_deg: float = Field(ge=-20, le=0)
    alpha_max_deg: float = Field(gt=0, le=40)
    """Angle of attack beyond which the airframe counts as stalled."""
    climb_rate_mps: float = Field(gt=0, le=150)
    """Largest climb rate that guidance asks for."""


class Gains(Settings):
    """Gains of the guidance laws (`guidance.Guidance`). Surfaces are JSBSim's normalised commands, -1 to 1.

    Surface gains hold at ``reference_dynamic_pressure_pa`` and are scaled by its ratio to the actual one.
    """

    altitude_per_s: float = Field(gt=0, le=2)
    """Climb rate asked for per altitude error."""
    climb_rate_per_s: float = Field(gt=0, le=5)
    """Vertical acceleration asked for per climb-rate error."""
    load_factor_rad_s_g: float = Field(ge=0, le=1)
    """Pitch rate asked for per load-factor error, rad/s per g."""
    pitch_per_s: float = Field(gt=0, le=5)
    """Pitch rate asked for per pitch error, at rotation."""
    pitch_rate_s: float = Field(gt=0, le=50)
    """Elevator per pitch-rate error in rad/s."""
    pitch_rate_integral: float = Field(ge=0, le=100)
    """Elevator rate per pitch-rate error in rad/s."""
    heading_per_s: float = Field(gt=0, le=1)
    """Turn rate asked for per heading error."""
    bank_per_s: float = Field(gt=0, le=10)
    """Roll rate asked for per bank error."""
    roll_rate_s: float = Field(gt=0, le=20)
    """Aileron per roll-rate error in rad/s."""
    roll_rate_integral: float = Field(ge=0, le=50)
    """Aileron rate per roll-rate error in rad/s."""
    aileron_forward_s: float = Field(default=0.0, ge=0, le=20)
    """Aileron per roll rate asked for, rad/s, that a bank profile feeds forward."""
    elevator_forward_per_g: float = Field(default=0.0, ge=0, le=2)
    """Elevator per load factor above 1 of the turn, g, that a bank profile feeds forward."""
    rudder_forward_s: float = Field(default=0.0, ge=-200, le=200)
    """As `turn_rudder_s`, in a bank profile. It may take a damper without washout back whole, with a command
    beyond what pedals can give: the surface keeps its own limits."""
    turn_rudder_s: float = Field(ge=-50, le=50)
    """Rudder per turn rate ``g sin(bank) / V``, rad/s: it works against a yaw damper without washout."""
    runway_steer: float = Field(ge=-20, le=20)
    """Nose wheel and rudder per heading error, rad, on the runway."""
    runway_steer_integral_per_s: float = Field(ge=0, le=20)
    """Nose wheel and rudder rate per heading error, rad, on the runway: it holds against a crosswind."""
    runway_steer_rate_s: float = Field(ge=-20, le=20)
    """Nose wheel and rudder per yaw rate, rad/s, on the runway."""
    throttle_s_per_m: float = Field(gt=0, le=1)
    """Throttle per speed error in m/s."""
    throttle_integral_per_m: float = Field(ge=0, le=0.1)
    """Throttle rate per speed error in m/s."""
    throttle_slew_per_s: float = Field(gt=0, le=2)
    """Fastest throttle movement."""
    reference_dynamic_pressure_pa: float = Field(gt=0, le=1e5)


class Airframe(Settings):
    """One airframe of JSBSim's library, with what it takes to fly it."""

    name: str
    """Name as reports write it."""
    model: str
    """Name of the JSBSim aircraft model."""
    gear_height_m: float = Field(gt=0, le=10)
    """Height of the centre of gravity over the runway, at rest on the gear."""
    engines: int = Field(ge=1, le=4)
    rotation_speed_mps: float = Field(gt=0, le=150)
    """Airspeed at which the nose is lifted."""
    rotation_pitch_deg: float = Field(gt=0, le=20)
    """Pitch that is held from rotation until the wheels are clear."""
    limits: Limits
    gains: Gains


def _files():
    return resources.files(__name__.rpartition(".")[0]).joinpath("airframes")


def airframe_names() -> list[str]:
    """Names of the airframes that can be flown, sorted, lower case."""
    return sorted(f.name.removesuffix(".toml") for f in _files().iterdir() if f.name.endswith(".toml"))


def load_airframe(name: str) -> Airframe:
    """The airframe of that name, in whatever case. Raises ValueError for an unknown name."""
    if name.lower() not in airframe_names():
        raise ValueError(f"unknown airframe {name!r}: one of {', '.join(airframe_names())}")
    text = _files().joinpath(f"{name.lower()}.toml").read_text(encoding="utf-8")
    return Airframe.model_validate(tomllib.loads(text))
