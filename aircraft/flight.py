"""The flight: true motion and the ideal IMU increments that belong to it."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sins import attitude, earth
from ..sins.earth import GravityModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Phase:
    """A named part of the flight, s from brake release."""

    name: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Flight:
    """Truth at a uniform rate, time along the first axis; frames and units as in `sins`.

    The increments are ideal: ``dtheta_b`` is the integral of ``w_ib_b`` and ``dv_b`` that of the specific
    force in the moving body frame, over the interval that ends at ``time``. Row 0 is the state at the start;
    its increments are zero.
    """

    time: Array
    """(n,) s from brake release, uniform."""
    lla: Array
    """(n, 3) rad, rad, m."""
    v_n: Array
    """(n, 3) m/s relative to the earth."""
    q_nb: Array
    """(n, 4)."""
    dtheta_b: Array
    """(n, 3) rad."""
    dv_b: Array
    """(n, 3) m/s."""
    phases: tuple[Phase, ...]
    airframe: str
    gravity: GravityModel = field(default=GravityModel.J2)
    """The gravity the aircraft flew in: a navigator with another one drifts."""

    @property
    def dt(self) -> float:
        """The sampling interval, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    def phase(self, name: str) -> Phase:
        """The phase of that name. Raises KeyError."""
        for phase in self.phases:
            if phase.name == name:
                return phase
        raise KeyError(f"no phase {name!r} in this flight: {', '.join(p.name for p in self.phases)}")

    def window(self, start_s: float, end_s: float) -> "Flight":
        """The rows with ``start_s <= time <= end_s``; ``time`` and the phases keep their epoch.

        Row 0's increments are set to zero: they belong to the interval before the window. Asked for again,
        it is the same window, with what it has computed for `at`: many runs share one.
        Raises ValueError unless two rows or more are inside.
        """
        if (start_s, end_s) not in self._windows:
            self._windows[start_s, end_s] = self._cut(start_s, end_s)
        return self._windows[start_s, end_s]

    @cached_property
    def _windows(self) -> dict[tuple[float, float], "Flight"]:
        return {}

    def _cut(self, start_s: float, end_s: float) -> "Flight":
        slack = 1e-6 * self.dt
        first, last = np.searchsorted(self.time, [start_s - slack, end_s + slack])
        if last - first < 2:
            raise ValueError(
                f"window {start_s} to {end_s} s: fewer than two rows of a flight of"
                f" {self.time[0]:.2f} to {self.time[-1]:.2f} s"
            )
        rows = slice(first, last)
        dtheta_b, dv_b = self.dtheta_b[rows].copy(), self.dv_b[rows].copy()
        dtheta_b[0] = dv_b[0] = 0.0
        return replace(
            self,
            time=self.time[rows],
            lla=self.lla[rows],
            v_n=self.v_n[rows],
            q_nb=self.q_nb[rows],
            dtheta_b=dtheta_b,
            dv_b=dv_b,
        )

    def at(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Position, velocity and attitude ``(lla, v_n, q_nb)`` at any times of the flight, s.

        Position by cubic Hermite interpolation with the velocities, velocity by cubic Hermite interpolation
        with central differences, attitude along the rotation vector from row to row. Longitude is in
        [-pi, pi). ``t`` may have any shape, which leads the shapes of the results. Asked for the same times
        again, as many runs do, it knows them. Raises ValueError outside the flight.
        """
        t = np.asarray(t, float)
        asked = t.shape, t.tobytes()
        known = self._known.get(asked)
        if known is None:
            known = self._interpolated(t)
            self._known.clear()
            self._known[asked] = known
        lla, v_n, q_nb = known
        return lla.copy(), v_n.copy(), q_nb.copy()

    @cached_property
    def _known(self) -> dict[tuple[tuple[int, ...], bytes], tuple[Array, Array, Array]]:
        """Where the flight was at the times that were asked for last."""
        return {}

    def _interpolated(self, t: Array) -> tuple[Array, Array, Array]:
        slack = 1e-6 * self.dt
        if t.size and not (t.min() >= self.time[0] - slack and t.max() <= self.time[-1] + slack):
            raise ValueError(f"time outside the flight of {self.time[0]:.3f} to {self.time[-1]:.3f} s")
        row = np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2)
        x = ((t - self.time[row]) / self.dt)[..., None]
        lla = _hermite(x, self.dt, self._unwrapped_lla, self._lla_rate, row)
        lla[..., 1] = attitude.wrapped(lla[..., 1])
        v_n = _hermite(x, self.dt, self.v_n, self._v_n_rate, row)
        turn = attitude.to_rotvec(attitude.multiply(attitude.conjugate(self.q_nb[row]), self.q_nb[row + 1]))
        return lla, v_n, attitude.multiply(self.q_nb[row], attitude.from_rotvec(x * turn))

    @cached_property
    def _unwrapped_lla(self) -> Array:
        """``lla`` with a longitude that does not jump at the antimeridian."""
        lat, lon, height = self.lla.T
        return np.stack([lat, np.unwrap(lon), height], axis=-1)

    @cached_property
    def _lla_rate(self) -> Array:
        lat, _, height = self.lla.T
        R_N, R_E = earth.radii_of_curvature(lat)
        north, east, down = self.v_n.T
        return np.stack([north / (R_N + height), east / ((R_E + height) * np.cos(lat)), -down], axis=-1)

    @cached_property
    def _v_n_rate(self) -> Array:
        return np.gradient(self.v_n, self.dt, axis=0)

    @property
    def load_factor(self) -> Array:
        """(n,) g: specific force upwards in the body, mean over the interval that ends at ``time``."""
        nz = -self.dv_b[:, 2] / (self.dt * earth.STANDARD_GRAVITY)
        nz[0] = nz[1]
        return nz

    @property
    def bank(self) -> Array:
        """(n,) rad, positive with the right wing down."""
        return attitude.to_euler(self.q_nb)[:, 0]

    @property
    def summary(self) -> dict[str, float | str]:
        """What a report says of the flight: times in s, the level phase's mean altitude and speed.

        ``altitude_reached_s`` is the first time within 1 m of the level altitude. The speed is relative to
        the earth. Raises KeyError for a window that does not hold the level phase and the S-manoeuvre.
        """
        level, s = self.phase("level"), self.phase("s_maneuver")
        held, turning = self.window(level.start_s, level.end_s), self.window(s.start_s, s.end_s)
        altitude = float(np.mean(held.lla[:, 2]))
        reached = int(np.argmax(np.abs(self.lla[:, 2] - altitude) < 1.0))
        return {
            "airframe": self.airframe,
            "liftoff_s": self.phase("takeoff").end_s,
            "altitude_reached_s": float(self.time[reached]),
            "altitude_m": altitude,
            "speed_mps": float(np.mean(np.linalg.norm(held.v_n, axis=1))),
            "s_start_s": s.start_s,
            "s_duration_s": s.end_s - s.start_s,
            "s_altitude_deviation_m": float(np.max(np.abs(turning.lla[:, 2] - altitude))),
        }


def _hermite(x: Array, dt: float, y: Array, rate: Array, row: NDArray[np.intp]) -> Array:
    """Cubic through ``y[row]`` and ``y[row + 1]`` with the given rates, at the fraction ``x`` between."""
    rise = y[row + 1] - y[row]
    bend0, bend1 = dt * rate[row] - rise, dt * rate[row + 1] - rise
    return y[row] + x * rise + x * (1 - x) * ((1 - x) * bend0 - x * bend1)
