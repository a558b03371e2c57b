"""The mechanisation against its readable step."""

import numpy as np
from fleetalign.sins.mechanization import NavigationState, mechanize, step

from .harness import Harness, Row
from .material import Material, Record, resampled

TARGET = 5e6
"""Samples per second and core."""


def rows(harness: Harness, material: Material) -> list[Row]:
    """Samples per second and core."""
    size = harness.size
    record = resampled(material.flight, size.samples)
    gravity = material.flight.gravity

    def ours() -> NavigationState:
        return mechanize(record.time, record.dtheta_b, record.dv_b, record.initial, gravity)

    times = harness.times(
        "mechanisation", {"ours": ours, "numpy": lambda: _stepwise(record, size.oracle_samples, gravity)}
    )
    rate = size.samples / times["ours"].best
    oracle_rate = size.oracle_samples / times["numpy"].best
    return [
        Row(
            "Mechanisation, one core",
            times["ours"].rate(size.samples),
            f"numpy step by step: {times['numpy'].rate(size.oracle_samples)}",
            f"{rate / oracle_rate:.0f} times",
            "5 M/s",
            rate >= TARGET,
            "`sins.mechanization.mechanize` over the whole flight of the scenario, resampled to"
            f" {size.samples:,} samples, against `step`, its readable twin, over {size.oracle_samples:,}.",
        )
    ]


def _stepwise(record: Record, samples: int, gravity) -> NavigationState:
    state, zero = record.initial, np.zeros(3)
    for k in range(1, samples):
        previous = (record.dtheta_b[k - 1], record.dv_b[k - 1]) if k > 1 else (zero, zero)
        dt = record.time[k] - record.time[k - 1]
        state = step(state, record.dtheta_b[k], record.dv_b[k], *previous, dt, gravity)
    return state
