"""The flight of a vehicle's antenna, which is what fixes are of."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..aircraft.flight import Flight
from ..sins import attitude, earth


def at_antenna(flight: Flight, lever_arm_b: ArrayLike) -> Flight:
    """The same flight with position and velocity of a point at ``lever_arm_b``, shape (3,) m, from the IMU.

    Its velocity is that of the IMU and the rate of change of ``C_nb l``, by central differences of the rows.
    """
    arm = np.asarray(lever_arm_b, float)
    if not arm.any():
        return flight
    arm_n = attitude.rotate(flight.q_nb, np.broadcast_to(arm, (len(flight.time), 3)))
    return replace(
        flight,
        lla=earth.displaced(flight.lla, arm_n),
        v_n=flight.v_n + np.gradient(arm_n, flight.dt, axis=0, edge_order=2),
    )
