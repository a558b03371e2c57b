"""Faults of an inertial measurement unit: what its increments and its clock are while it is broken.

Each fault is a table ``{ kind = "...", ... }`` of a scenario. None of them draws anything: a fault does the
same in every run. The first row of a record has no interval, and is left as it is.
"""

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .earth import STANDARD_GRAVITY
from .imu import DrawnImuErrors, Imu
from .settings import Settings
from .units import DEG

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]


class _Fault(Settings):
    start_s: float = Field(ge=0, le=3600)
    """From the start of the alignment."""
    duration_s: float = Field(default=0.5, ge=0.001, le=3600)

    @property
    def end_s(self) -> float:
        """From the start of the alignment."""
        return self.start_s + self.duration_s

    def rows(self, since_start: Array) -> Rows:
        """Which rows, (n,), it befalls: those of its begin, and before its end."""
        slack = 1e-6
        inside = (since_start > self.start_s - slack) & (since_start < self.end_s - slack)
        inside[0] = False
        return inside


class _AxisFault(_Fault):
    sensor: Literal["gyro", "accel", "both"] = "both"
    axis: Literal["x", "y", "z", "all"] = "all"

    def columns(self, sensor: str) -> slice:
        """Columns of that sensor's increments that it befalls."""
        if self.sensor not in (sensor, "both"):
            return slice(0, 0)
        first = "xyz".find(self.axis)
        return slice(0, 3) if first < 0 else slice(first, first + 1)


class NotFiniteFault(_AxisFault):
    """NaN, or an infinity, in the place of a number."""

    kind: Literal["nan", "infinity"]

    def broken(self, increments: Array, rows: Rows, sensor: str, dt: float) -> None:
        """Change the increments (n, 3) of one sensor in place; ``dt`` s."""
        increments[rows, self.columns(sensor)] = np.nan if self.kind == "nan" else np.inf


class StuckFault(_AxisFault):
    """An axis repeats the last value that it had before."""

    kind: Literal["stuck"]

    def broken(self, increments: Array, rows: Rows, sensor: str, dt: float) -> None:
        """Change the increments (n, 3) of one sensor in place; ``dt`` s."""
        if rows.any():
            columns = self.columns(sensor)
            increments[rows, columns] = increments[int(np.argmax(rows)) - 1, columns]


class SaturatedFault(_AxisFault):
    """An axis measures no more than a full scale, either way, less than it should."""

    kind: Literal["saturated"]
    full_scale_deg_s: float = Field(default=5.0, gt=0, le=5000)
    """Of the gyros."""
    full_scale_g: float = Field(default=1.1, gt=0, le=500)
    """Of the accelerometers."""

    def broken(self, increments: Array, rows: Rows, sensor: str, dt: float) -> None:
        """Change the increments (n, 3) of one sensor in place; ``dt`` s."""
        most = dt * (
            self.full_scale_deg_s * DEG if sensor == "gyro" else self.full_scale_g * STANDARD_GRAVITY
        )
        columns = self.columns(sensor)
        increments[rows, columns] = np.clip(increments[rows, columns], -most, most)


class DroppedFault(_Fault):
    """No sample arrives."""

    kind: Literal["dropped"]


class ClockBackFault(_Fault):
    """The unit's clock goes back by a step, and is right again after the fault's duration."""

    kind: Literal["clock_back"]
    step_s: float = Field(default=1.0, ge=0.001, le=3600)


ImuFault = Annotated[
    NotFiniteFault | StuckFault | SaturatedFault | DroppedFault | ClockBackFault, Field(discriminator="kind")
]
"""Any of the faults, chosen by ``kind``."""


def faulty(imu: Imu, faults: tuple[ImuFault, ...]) -> Imu:
    """The increments as a broken unit gives them: fewer rows where samples are dropped, and a time that need
    not increase where its clock goes back. What was drawn of its errors stays, for the rows that there are.
    """
    if not faults:
        return imu
    since_start = imu.time - imu.time[0]
    dt = float(since_start[-1]) / (len(since_start) - 1)
    time, dtheta_b, dv_b = imu.time.copy(), imu.dtheta_b.copy(), imu.dv_b.copy()
    there = np.ones(len(time), bool)
    for fault in faults:
        rows = fault.rows(since_start)
        if isinstance(fault, DroppedFault):
            there &= ~rows
        elif isinstance(fault, ClockBackFault):
            time[rows] -= fault.step_s
        else:
            fault.broken(dtheta_b, rows, "gyro", dt)
            fault.broken(dv_b, rows, "accel", dt)
    return Imu(time[there], dtheta_b[there], dv_b[there], _drawn(imu.errors, there))


def _drawn(errors: DrawnImuErrors, there: Rows) -> DrawnImuErrors:
    histories = {
        name: value[there]
        for name in ("gyro_bias_variation", "accel_bias_variation", "vibration")
        if (value := getattr(errors, name)) is not None
    }
    return replace(errors, **histories)
