"""What happens in the experiment of Xu et al. 2012: the track, the INS's errors and all noises.

Everything is linear in the errors: state [position (2), velocity (2), accelerometer bias in b (2)], x and y.

    p(k+1) = p + (T + d(k)) v,   v(k+1) = v + (T + d(k)) C_nb b + w,   b(k+1) = b + w_b

with d the stochastic error of the sampling period (2.2).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import make_interp_spline

from ..run import generator
from .results import Array
from .xu2012_settings import InsWsn

P, V, BIAS = slice(0, 2), slice(2, 4), slice(4, 6)
SEEN = slice(0, 4)
"""What WSN and tables see: position and velocity."""


@dataclass(frozen=True)
class World:
    """Time (n,), truth (n, 2), and the models of error."""

    settings: InsWsn

    @cached_property
    def time(self) -> Array:
        """(n,) s, one row a sampling period."""
        return np.arange(self.settings.stretches[-1].stop) * self.settings.period_s

    @cached_property
    def course(self) -> tuple[Array, Array]:
        """True position (n, 2), m, and velocity (n, 2), m/s: a smooth curve, at constant speed."""
        points = np.array(self.settings.waypoints_m)
        chord = np.append(0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        curve = make_interp_spline(chord, points, k=min(3, len(points) - 1))
        fine = np.linspace(0, chord[-1], 20_000)
        run = np.append(0, np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)))
        at = np.interp(self.time / self.time[-1] * run[-1], run, fine)
        along = curve(at, 1)
        speed = run[-1] / self.time[-1]
        return curve(at), speed * along / np.linalg.norm(along, axis=1)[:, None]

    @cached_property
    def C_nb(self) -> Array:
        """(n, 2, 2) from body to navigation axes; the body points where it goes."""
        v = self.course[1] / np.linalg.norm(self.course[1], axis=1)[:, None]
        return np.stack([v, np.stack([-v[:, 1], v[:, 0]], axis=1)], axis=2)

    @cached_property
    def rates(self) -> Array:
        """(n, 6, 6) what errors grow by, a second."""
        matrix = np.zeros((len(self.time), 6, 6))
        matrix[:, P, V] = np.eye(2)
        matrix[:, V, BIAS] = self.C_nb
        return matrix

    @cached_property
    def A(self) -> Array:
        """(n, 6, 6) transition with the ideal period."""
        return np.eye(6) + self.settings.period_s * self.rates

    @cached_property
    def A_s(self) -> Array:
        """(n, 6, 6) what one standard deviation of the period's error adds."""
        return self.settings.period_error_sd_s * self.rates

    @cached_property
    def Q(self) -> Array:
        """(6,) variances of process noise, a period."""
        s = self.settings
        walks = np.array([0.0, s.velocity_walk_mps_sqrt_s, s.accel_bias_walk_mps2_sqrt_s])
        return np.repeat(walks**2 * s.period_s, 2)

    @cached_property
    def first_guess(self) -> Array:
        """(4,) variances a period if the biases were white, their drift over half the time included."""
        s = self.settings
        drift = s.accel_bias_walk_mps2_sqrt_s**2 * self.time[-1] / 2
        velocity = self.Q[2] + s.period_s**2 * (s.accel_bias_mps2**2 + drift)
        return np.array([0.0, 0.0, velocity, velocity])

    @cached_property
    def R(self) -> Array:
        """(4, 4) of a WSN fix."""
        s = self.settings
        return np.diag(np.repeat([s.position_sd_m, s.velocity_sd_mps], 2) ** 2)

    @cached_property
    def initial_variance(self) -> Array:
        """(6,) of the INS, which starts from a WSN fix."""
        return np.append(np.diag(self.R), [self.settings.accel_bias_mps2**2] * 2)

    @cached_property
    def fixed(self) -> Array:
        """(n,) whether there is a WSN fix: in the training areas."""
        seen = np.zeros(len(self.time), bool)
        for area in self.settings.stretches[::2]:
            seen[area] = True
        return seen

    @cached_property
    def returns(self) -> set[int]:
        """Epochs of the first fix after an outage."""
        return {area.start for area in self.settings.stretches[2::2]}


@dataclass(frozen=True)
class Draws:
    """Noises of k draws."""

    start: Array
    """(k, 6) error of the INS at the start."""
    period: Array
    """(k, n) error of the sampling period over its standard deviation."""
    process: Array
    """(k, n, 6)."""
    fix: Array
    """(k, n, 4)."""

    @classmethod
    def of(cls, world: World, draws: int, seed: int) -> "Draws":
        """A draw depends on seed and number alone."""
        n = len(world.time)

        def normal(name: str, *shape: int) -> Array:
            return np.stack([generator(seed, i, name).standard_normal(shape) for i in range(draws)])

        return cls(
            normal("start", 6) * np.sqrt(world.initial_variance),
            normal("period", n),
            normal("process", n, 6) * np.sqrt(world.Q),
            normal("wsn", n, 4) * np.sqrt(np.diag(world.R)),
        )


def propagated(world: World, draws: Draws, e: Array, k: int) -> Array:
    """Errors (draws, 6) one epoch after epoch k."""
    return e @ world.A[k].T + draws.period[:, [k]] * (e @ world.A_s[k].T) + draws.process[:, k]


def ins_output(world: World, free: Array) -> Array:
    """(..., n, 4) position and velocity that an INS with these errors shows."""
    return np.concatenate(world.course, axis=1) + free[..., SEEN]
