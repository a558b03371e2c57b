"""What the columns of a recording mean: the map, a small TOML file. All of it has a default.

Without a map the columns are those of the project's own files: increments as in `flight.parquet`, fixes as
`network.fixes.read_fixes` takes them.
"""

import math
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, field_validator, model_validator

from ..align.filters import FILTERS
from ..align.methods import METHODS
from ..align.settings import FilterSettings
from ..sins import attitude
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from ..sins.settings import Settings
from ..sins.units import ARCSEC, DEG, DEG_PER_HOUR, HOUR, MILLISECOND, G
from .command_line import InputError
from .mistakes import told_mistakes
from .toml import read_toml

Array = NDArray[np.float64]
Column = Annotated[str, Field(max_length=200, pattern=r"^[^\n\t]+$")]
Three = tuple[Column, Column, Column]

TimeUnit = Literal["s", "ms", "us", "ns"]
AngleUnit = Literal["rad", "deg"]
TIME_UNITS = {"s": 1.0, "ms": MILLISECOND, "us": 1e-6, "ns": 1e-9}
ANGLE_UNITS = {"rad": 1.0, "deg": DEG}
SPEED_UNITS = {"m/s": 1.0, "km/h": 1000 / HOUR, "kn": 1852 / HOUR}
TURNED_UNITS = {"rad": 1.0, "deg": DEG, "arcsec": ARCSEC}
RATE_UNITS = {"rad/s": 1.0, "deg/s": DEG, "deg/h": DEG_PER_HOUR}
GAINED_UNITS = {"m/s": 1.0, "g*s": G}
FORCE_UNITS = {"m/s^2": 1.0, "g": G}

TO_FRD = {
    "FRD": np.eye(3),
    "RFU": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "FLU": np.diag([1.0, -1, -1]),
}
TO_NED = {"NED": np.eye(3), "ENU": TO_FRD["RFU"]}
"""What turns components along other axes into those of the conventions."""


class ReplayError(InputError):
    """A recording, or a map of one, that cannot be used; one line for each mistake."""


class ImuColumns(Settings):
    """The columns of the IMU's file."""

    kind: Literal["increments", "rates", "samples"] = "increments"
    """``increments`` over the interval that ends at the row's time; ``rates``, their mean over that interval;
    ``samples``, the rate and the specific force at that time, taken for straight lines between the rows."""
    axes: Literal["FRD", "RFU", "FLU"] = "FRD"
    """Order and sense of the three columns: forward, right, left, up, down."""
    time: Column = "time_s"
    time_unit: TimeUnit = "s"
    gyro: Three = ("dtheta_x_rad", "dtheta_y_rad", "dtheta_z_rad")
    gyro_unit: Literal["rad", "deg", "arcsec", "rad/s", "deg/s", "deg/h"] = "rad"
    accel: Three = ("dv_x_mps", "dv_y_mps", "dv_z_mps")
    accel_unit: Literal["m/s", "g*s", "m/s^2", "g"] = "m/s"

    @property
    def gyro_units(self) -> dict[str, float]:
        """Units that a gyro's column may have, in rad or rad/s."""
        return TURNED_UNITS if self.kind == "increments" else RATE_UNITS

    @property
    def accel_units(self) -> dict[str, float]:
        """Units that an accelerometer's column may have, in m/s or m/s^2."""
        return GAINED_UNITS if self.kind == "increments" else FORCE_UNITS

    @model_validator(mode="after")
    def _units_of_the_kind(self) -> Self:
        for name, units in (("gyro_unit", self.gyro_units), ("accel_unit", self.accel_units)):
            if getattr(self, name) not in units:
                allowed = ", ".join(units)
                raise ValueError(f"{name} = {getattr(self, name)!r}: allowed with {self.kind} is {allowed}")
        return self


class FixColumns(Settings):
    """The columns of the file of fixes. Standard deviations are columns, or one number for all rows."""

    axes: Literal["NED", "ENU"] = "NED"
    """Order and sense of velocities and standard deviations; heights count upwards in either case."""
    time: Column = "time_s"
    """When position and velocity were true, as the sender has it: the stamp."""
    arrival: Column | None = None
    """When the fix was at hand; at its stamp if not given."""
    time_unit: TimeUnit = "s"
    latitude: Column = "lat_deg"
    longitude: Column = "lon_deg"
    angle_unit: AngleUnit = "deg"
    height: Column = "height_m"
    velocity: Three = ("v_north_mps", "v_east_mps", "v_down_mps")
    velocity_unit: Literal["m/s", "km/h", "kn"] = "m/s"
    position_sd: Three | None = None
    position_sd_m: float | None = Field(default=None, ge=1e-4, le=1e5)
    velocity_sd: Three | None = None
    velocity_sd_mps: float | None = Field(default=None, ge=1e-5, le=1e3)
    source: Column | None = None
    sequence: Column | None = None
    """Numbers of the sender and of its packets; by them repeated and overtaken packets are known."""

    @model_validator(mode="after")
    def _one_standard_deviation_each(self) -> Self:
        for columns, number in (("position_sd", "position_sd_m"), ("velocity_sd", "velocity_sd_mps")):
            if (getattr(self, columns) is None) == (getattr(self, number) is None):
                raise ValueError(f"one of {columns} (three columns) and {number} (a number) must be given")
        return self


class Recorded(Settings):
    """How the two files are laid out, and what in their time base is mended rather than refused."""

    imu: ImuColumns = ImuColumns()
    fixes: FixColumns | None = None
    """None: the columns of `network.fixes.read_fixes`."""
    gap_limit_s: float = Field(default=1.0, ge=0, le=60)
    """Longest stretch without samples that is bridged."""
    backward_limit_s: float = Field(default=0.1, ge=0, le=10)
    """Rows that come so much too late are put in their place; a clock that goes back further is refused."""


class InitialAttitude(Settings):
    """Attitude at the first row of the IMU, or at ``time_s``: what is before is not used."""

    roll_deg: float = Field(ge=-180, le=180)
    pitch_deg: float = Field(ge=-90, le=90)
    heading_deg: float = Field(ge=-360, le=360)
    level_sd_deg: float | None = Field(default=None, gt=0, le=30)
    heading_sd_deg: float | None = Field(default=None, gt=0, le=60)
    """Standard deviations; if not given, those of ``alignment.settings``."""
    convention: Literal["FRD/NED", "RFU/ENU", "FLU/ENU"] | None = None
    """Axes that the angles stand for, zero where body and navigation axes coincide. FRD/NED: heading from
    north over east, pitch nose up; RFU/ENU: from north over west, nose up; FLU/ENU: from east over north,
    nose down. If not given, that of the two files' axes, or FRD/NED if they mix."""
    time_s: float | None = Field(default=None, ge=-1e12, le=1e12)


class ReplayAlignment(Settings):
    """By which filters to align, and what they are told."""

    filters: tuple[str, ...] = tuple(FILTERS)
    gravity: Literal["somigliana", "j2"] = "somigliana"
    settings: FilterSettings = FilterSettings()

    @field_validator("filters")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if name not in METHODS:
                raise ValueError(f"no filter {name!r}; known: {', '.join(METHODS)}")
        if not names:
            raise ValueError(f"at least one of: {', '.join(METHODS)}")
        return tuple(dict.fromkeys(names))


class ReplayMap(Settings):
    """All that a replay depends on besides the two files."""

    title: str = "Replay of a recording"
    recorded: Recorded = Recorded()
    initial: InitialAttitude | None = None
    """Not needed where ``alignment.settings.coarse_stage`` finds it."""
    imu: ImuErrors = ImuErrors()
    """Error budget that the filters are told."""
    alignment: ReplayAlignment = ReplayAlignment()

    @property
    def convention(self) -> str:
        """The convention of the initial attitude."""
        fixes = self.recorded.fixes.axes if self.recorded.fixes else "NED"
        of_the_files = f"{self.recorded.imu.axes}/{fixes}"
        stated = self.initial.convention if self.initial else None
        return stated or (of_the_files if of_the_files in _CONVENTIONS else "FRD/NED")

    @property
    def euler(self) -> Array | None:
        """Initial roll, pitch and heading, rad, in the sense of `sins.attitude`, if there are any."""
        if self.initial is None:
            return None
        zero_deg, heading_sign, pitch_sign = _CONVENTIONS[self.convention]
        roll, pitch = self.initial.roll_deg, pitch_sign * self.initial.pitch_deg
        heading = zero_deg + heading_sign * self.initial.heading_deg
        return attitude.wrapped(np.array([roll, pitch, heading]) * DEG)

    @property
    def settings(self) -> FilterSettings:
        """Filter settings, with the standard deviations of the initial attitude."""
        stated = self.initial.model_dump(include={"level_sd_deg", "heading_sd_deg"}) if self.initial else {}
        return self.alignment.settings.model_copy(update={k: v for k, v in stated.items() if v is not None})

    @property
    def gravity_model(self) -> GravityModel:
        """Model to navigate with."""
        return GravityModel[self.alignment.gravity.upper()]


_CONVENTIONS = {"FRD/NED": (0.0, 1, 1), "RFU/ENU": (0.0, -1, 1), "FLU/ENU": (90.0, -1, -1)}
"""Heading, deg, at which a convention's yaw is zero; the sense of its yaw, and of its pitch."""


def load_map(path: Path | None, initial: str | None, filters: list[str] | None) -> ReplayMap:
    """The map of a file, with the options of the command line in the place of its own. Raises `ReplayError`.

    ``initial``: ``roll,pitch,heading`` or ``roll,pitch,heading,level_sd,heading_sd``, deg.
    """
    try:
        content = read_toml(path) if path else {}
        read = ReplayMap.model_validate(content)
    except ValidationError as error:
        raise ReplayError(told_mistakes(str(path), error, ReplayMap)) from error
    except ValueError as error:
        raise ReplayError(str(error)) from error
    if filters:
        content["alignment"] = {**content.get("alignment", {}), "filters": filters}
    if initial is not None:
        content["initial"] = content.get("initial", {}) | _angles(initial)
    try:
        read = ReplayMap.model_validate(content)
    except ValidationError as error:
        raise ReplayError(told_mistakes("option", error, ReplayMap)) from error
    if read.initial is None and read.alignment.settings.coarse_stage == "none":
        raise ReplayError(
            "--initial: missing: roll,pitch,heading in deg, or a table [initial] in the map, "
            'or alignment.settings.coarse_stage = "in_motion"'
        )
    return read


def _angles(option: str) -> dict[str, float]:
    names = ("roll_deg", "pitch_deg", "heading_deg", "level_sd_deg", "heading_sd_deg")
    try:
        numbers = [float(part) for part in option.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 5) or not all(map(math.isfinite, numbers)):
        raise ReplayError(f"--initial {option}: allowed is roll,pitch,heading[,level_sd,heading_sd] in deg")
    return dict(zip(names, numbers, strict=False))
