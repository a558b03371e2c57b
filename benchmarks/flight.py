"""The co-simulated flight against JSBSim alone, flown through the same motion."""

from collections.abc import Callable
from unittest.mock import patch

import numpy as np
from fleetalign.aircraft.airframe import load_airframe
from fleetalign.aircraft.guidance import Controls, Guidance
from fleetalign.aircraft.mission import GUIDANCE_RATE_HZ, FlightPlan
from fleetalign.aircraft.phases import mission_phases
from fleetalign.aircraft.simulator import SETTLING_S, _Model, fly
from fleetalign.sins import earth

from .harness import Harness, Row
from .material import Material

TARGET = 1.6


def rows(harness: Harness, material: Material) -> list[Row]:
    """Processor time of a whole flight, preparation included, and of the bare loop."""
    plan = material.scenario.flight
    bare = BareLoop(plan)
    times = harness.times("flight", {"ours": lambda: fly(plan), "bare": bare.fly}, rounds=3, warm_up=False)
    ratio = times["ours"].best / times["bare"].best
    return [
        Row(
            "Co-simulated flight, one core",
            f"{times['ours'].best:.2f} s (median {times['ours'].median:.2f})",
            f"bare JSBSim loop: {times['bare'].best:.2f} s (median {times['bare'].median:.2f})",
            f"{ratio:.2f} of its time",
            "at most 1.6",
            ratio <= TARGET,
            f"{plan.end_s:.0f} s of the {plan.airframe} at {plan.model_rate_hz} Hz with guidance, envelope"
            " monitor and navigation truth, against as many steps of the same model from the same start, fed"
            f" the recorded controls at {GUIDANCE_RATE_HZ} Hz, with nothing read. It ends"
            f" {bare.distance_to(material.flight.lla[-1]):.1g} m from where the flight ends: JSBSim does the"
            " same work in both.",
        )
    ]


class BareLoop:
    """The plan flown once, untimed, with its commands recorded; then JSBSim alone that is fed these."""

    def __init__(self, plan: FlightPlan) -> None:
        self._plan = plan
        self._airframe = load_airframe(plan.airframe)
        self._controls: list[Controls] = []
        self._end: tuple[float, float, float] | None = None
        update = Guidance.update

        def recording(guidance: Guidance, *arguments) -> Controls:
            self._controls.append(update(guidance, *arguments))
            return self._controls[-1]

        with patch.object(Guidance, "update", recording):
            flight = fly(plan)
        gears = {phase.name: phase.gear for phase in mission_phases(plan, self._airframe)}
        self._gear = {round(p.start_s * GUIDANCE_RATE_HZ): gears[p.name] for p in flight.phases}

    def fly(self) -> None:
        """Load, settle on the brakes, and run."""
        model = _Model(self._plan, self._airframe)
        run: Callable[[], bool] = model.fdm.run
        rate = self._plan.model_rate_hz
        model.set_brakes(1.0)
        for _ in range(round(SETTLING_S * rate)):
            run()
        model.set_brakes(0.0)
        for tick, controls in enumerate(self._controls):
            if tick in self._gear:
                model.set_gear(self._gear[tick])
            model.command(controls)
            for _ in range(rate // GUIDANCE_RATE_HZ):
                run()
        fdm = model.fdm
        self._end = (
            fdm["position/lat-geod-rad"],
            fdm["position/long-gc-rad"],
            fdm["position/geod-alt-ft"] * 0.3048,
        )

    def distance_to(self, lla: np.ndarray) -> float:
        """From where the last bare flight ended, m."""
        assert self._end is not None, "not flown yet"
        return float(np.linalg.norm(earth.displacement_n(np.array(self._end), lla)))
