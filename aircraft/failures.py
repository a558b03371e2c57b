"""What may fail in flight: an engine, or a control that no longer moves.

A control is the command that reaches the flight control system, on JSBSim's scale: its models have no
actuators that could be held. Dampers behind it, as the F-16 has them, go on moving the surface.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..sins.settings import Settings
from .guidance import Controls


class EngineOut(Settings):
    """An engine gets no more fuel."""

    kind: Literal["engine_out"]
    time_s: float = Field(ge=0, le=5000)
    """From brake release."""
    engine: int = Field(default=1, ge=1, le=4)
    """Counted from 1, left to right."""

    @property
    def told(self) -> str:
        """What failed, for a message."""
        return f"engine {self.engine} went out"


class StuckControl(Settings):
    """A control stays where it is, or goes to a position and stays there."""

    kind: Literal["stuck"]
    time_s: float = Field(ge=0, le=5000)
    """From brake release."""
    control: Literal["elevator", "aileron", "rudder", "throttle"]
    position: float | None = Field(default=None, ge=-1, le=1)
    """Of full deflection: the elevator's is positive for nose down, the aileron's for right wing down; the
    throttle's is from 0 to 1."""

    @model_validator(mode="after")
    def _throttle_is_positive(self) -> "StuckControl":
        if self.control == "throttle" and self.position is not None and self.position < 0:
            raise ValueError(f"position = {self.position:g}: a throttle's is from 0 to 1")
        return self

    @property
    def told(self) -> str:
        """What failed, for a message."""
        return f"the {self.control} stuck"


Failure = Annotated[EngineOut | StuckControl, Field(discriminator="kind")]
"""Any of the failures, chosen by ``kind``."""


class Jammed:
    """Controls as they come out where some of them are stuck."""

    def __init__(self, failures: tuple[Failure, ...]) -> None:
        self._to_come = [failure for failure in failures if isinstance(failure, StuckControl)]
        self._held: dict[str, float] = {}

    def __call__(self, t: float, controls: Controls) -> Controls:
        """``controls`` at ``t``, s from brake release, changed in place."""
        for failure in [f for f in self._to_come if f.time_s <= t]:
            self._to_come.remove(failure)
            position = getattr(controls, failure.control) if failure.position is None else failure.position
            self._held.setdefault(failure.control, position)
        for control, position in self._held.items():
            setattr(controls, control, position)
        return controls
