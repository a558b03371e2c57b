"""The axis of time of the report's figures, with what happens on it."""

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes

from ..aircraft.flight import Flight
from .palette import LIGHT_GREY
from .scenery import told

Outages = Sequence[tuple[float, float]]


class Clock(NamedTuple):
    """The axis of time: what it counts from, and the phases of the flight that begin on it."""

    label: str
    offset: float
    """s, to be added to the time since the start of the alignment."""
    phases: tuple[tuple[float, str], ...]
    """When they begin, s on this axis, and their names."""
    outages: tuple[tuple[float, float], ...] = ()
    """Begin and end, s on this axis."""

    def shade(self, ax: Axes) -> None:
        """Outages of the fixes."""
        for number, (begin, end) in enumerate(self.outages):
            label = "no fixes" if number == 0 else None
            ax.axvspan(begin, end, color=LIGHT_GREY, alpha=0.35, linewidth=0, label=label)


def clock_of(flight: Flight, window: Flight, outages: Outages = ()) -> Clock:
    """Since lift-off where the alignment begins before level flight, else since its own start."""
    start = float(window.time[0])
    from_lift_off = start < flight.phase("level").start_s
    zero = flight.phase("takeoff").end_s if from_lift_off else start
    least = 0.12 * float(window.time[-1] - start)  # or there is no room for its name
    begun = [p for p in flight.phases if start < p.start_s < window.time[-1] - least]
    return Clock(
        "time since lift-off, s" if from_lift_off else "time from the start of the alignment, s",
        start - zero,
        tuple((phase.start_s - zero, told(phase.name)) for phase in begun),
        tuple((begin - zero, end - zero) for begin, end in outages),
    )
