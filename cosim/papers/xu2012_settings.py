"""Parameters of the experiment of Xu et al. 2012."""

from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from ...align.bridging.regression import LEAST_ROWS
from ...sins.settings import Settings

Metres = Annotated[float, Field(ge=-1e5, le=1e5)]
Seconds = Annotated[float, Field(ge=0, le=3600)]


class InsWsn(Settings):
    """A blind node walks through training areas with a WSN, and through outages without."""

    kind: Literal["ins_wsn"]
    waypoints_m: tuple[tuple[Metres, Metres], ...] = Field(
        default=((650.0, 0.0), (500.0, 30.0), (380.0, 150.0), (290.0, 320.0), (130.0, 400.0)),
        min_length=2,
        max_length=50,
    )
    """The track goes through them on a smooth curve, at constant speed."""
    training_area_s: tuple[Seconds, Seconds] = (100.0, 100.0)
    """Time in each training area; after each comes an outage."""
    outage_s: tuple[Seconds, Seconds] = (50.0, 50.0)
    period_s: float = Field(default=1.0, ge=0.01, le=10)
    """Ideal sampling period, of fixes too."""
    period_error_sd_s: float = Field(default=0.05, ge=0, le=1)
    position_sd_m: float = Field(default=0.2, ge=1e-3, le=100)
    """Of a WSN fix, x and y alike."""
    velocity_sd_mps: float = Field(default=0.1, ge=1e-4, le=100)
    accel_bias_mps2: float = Field(default=0.01, ge=0, le=10)
    """Standard deviation of the constant bias of each accelerometer, in body axes."""
    accel_bias_walk_mps2_sqrt_s: float = Field(default=1e-4, ge=0, le=1)
    velocity_walk_mps_sqrt_s: float = Field(default=0.005, ge=1e-6, le=10)
    mistuned: tuple[Annotated[float, Field(ge=1e-8, le=1e8)], ...] = Field(default=(1e-2, 1e-4), max_length=4)
    """Process noise that mismatched filters are told, over that of the matched ones."""
    gamma_slack: float = Field(default=1.2, ge=1.001, le=100)
    """How much more than the least gamma the mended filter may have, for less variance."""

    @field_validator("training_area_s", "outage_s", mode="before")
    @classmethod
    def _one_for_each(cls, times: Any, info: ValidationInfo) -> Any:
        if isinstance(times, list | tuple) and len(times) != 2:
            what = "training area" if info.field_name == "training_area_s" else "outage"
            least = f"{2 * LEAST_ROWS} periods" if what == "training area" else "one period"
            given = f"an empty {what}" if not times else f"{len(times)} of them"
            raise ValueError(f"{given}; allowed are two times, of {what}s 1 and 2, each of {least} or more")
        return times

    @model_validator(mode="after")
    def _something_to_learn_from(self) -> "InsWsn":
        least = 2 * LEAST_ROWS
        for number, (area, outage) in enumerate(zip(self.training_area_s, self.outage_s, strict=True), 1):
            held = self._periods(area)
            if held < least:
                what = "is empty" if held == 0 else f"holds {held} points"
                raise ValueError(
                    f"training_area_s = {area:g} s in area {number}: {what};"
                    f" allowed is {least} periods of {self.period_s:g} s or more"
                )
            if self._periods(outage) < 1:
                raise ValueError(
                    f"outage_s = {outage:g} s in outage {number}: allowed is a period of"
                    f" {self.period_s:g} s or more"
                )
        if self.stretches[-1].stop > 20_000:
            raise ValueError(f"period_s = {self.period_s:g} s: allowed is 20000 periods in all")
        return self

    @model_validator(mode="after")
    def _goes_on(self) -> "InsWsn":
        for one, other in pairwise(self.waypoints_m):
            if one == other:
                raise ValueError(f"waypoints_m: ({one[0]:g}, {one[1]:g}) m twice in a row; allowed once")
        return self

    def _periods(self, time_s: float) -> int:
        return round(time_s / self.period_s)

    @property
    def stretches(self) -> tuple[slice, ...]:
        """Epochs of training area 1, outage 1, training area 2, outage 2."""
        lengths = [
            self._periods(t) for pair in zip(self.training_area_s, self.outage_s, strict=True) for t in pair
        ]
        ends = np.cumsum(lengths)
        return tuple(slice(int(end - length), int(end)) for end, length in zip(ends, lengths, strict=True))
