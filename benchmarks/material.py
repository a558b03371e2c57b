"""What the benchmarks work on: a scenario, its flight, one run's record and fixes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from fleetalign.aircraft.cache import cached_flight
from fleetalign.aircraft.flight import Flight
from fleetalign.cosim.run import Run, alignment_window, simulate
from fleetalign.cosim.scenario import Scenario, load_scenario, replaced
from fleetalign.sins.mechanization import NavigationState

from .harness import Size

SEED = 7


@dataclass(frozen=True)
class Material:
    """The bundled scenario (or a small variant of it), flown, and its first run."""

    scenario: Scenario
    flight: Flight
    window: Flight
    run: Run

    @property
    def measured(self) -> tuple[Any, ...]:
        """Arguments of `AlignmentInput.checked` for the run."""
        run, scenario = self.run, self.scenario
        return (
            run.imu.time,
            run.imu.dtheta_b,
            run.imu.dv_b,
            run.q_nb_coarse,
            run.fixes,
            scenario.alignment.settings,
            scenario.imu,
            scenario.alignment.gravity_model(self.window.gravity),
        )


@dataclass(frozen=True)
class Record:
    """Increments as `mechanize` takes them, with the state at the start and the truth at the end."""

    time: np.ndarray
    dtheta_b: np.ndarray
    dv_b: np.ndarray
    initial: NavigationState
    final: NavigationState


def prepare(size: Size) -> Material:
    """Fly the scenario, or read its flight from the cache, and draw run 0."""
    scenario = replaced(load_scenario("stated_fixes")[1], dict(size.changes))
    flight, _ = cached_flight(scenario.flight)
    window = alignment_window(scenario, flight)
    return Material(scenario, flight, window, simulate(scenario, window, 0, SEED))


def resampled(flight: Flight, samples: int) -> Record:
    """The whole flight at another rate: its summed increments, interpolated, so that it ends where it did."""
    time = np.linspace(flight.time[0], flight.time[-1], samples)
    increments = []
    for original in (flight.dtheta_b, flight.dv_b):
        total = np.cumsum(original, axis=0)
        column = [np.interp(time, flight.time, total[:, i]) for i in range(3)]
        increments.append(np.diff(np.stack(column, axis=1), axis=0, prepend=np.zeros((1, 3))))
    dtheta_b, dv_b = increments
    initial, final = (NavigationState(flight.lla[k], flight.v_n[k], flight.q_nb[k]) for k in (0, -1))
    return Record(time, dtheta_b, dv_b, initial, final)
