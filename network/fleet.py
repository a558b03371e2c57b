"""The fleet: nodes at random in a cylinder that travels with the own ship, weaving on paths of their own.

The cylinder's frame has its origin at the centre of the base and the axes of the local level there,
north, east and down. The own ship, node 0, flies its truth. Positions and velocities are in e.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..sins import attitude, earth
from ..sins.settings import Settings
from .truth import Truth

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]

OWN_SHIP = 0
"""The node that flies the truth and is to be aligned."""
SMOOTHING_S = 20.0
"""Standard deviation of the kernel that smooths the own ship's path into the centre's. Of a steady weave of
20 s period it leaves some 1e-7, of one of 60 s a tenth."""
_SAMPLE_S = 1.0
_PERIOD_SPREAD = 0.3


class FleetError(ValueError):
    """A path or a time that no fleet can be made for; one line."""


class FleetSettings(Settings):
    """How many nodes fly, how many of them know where they are, and where they are.

    Gao et al., Table 1: 30 or 50 nodes at random, "network size" 20 km by 5 km, which is taken for the
    radius and the height of a cylinder. The share of anchors and their errors are not in the paper.
    """

    nodes: int = Field(default=50, ge=2, le=1000)
    anchor_share: float = Field(default=0.2, ge=0, le=1)
    anchor_position_sd_m: float = Field(default=1.0, ge=0, le=1e4)
    """Standard deviation of each component (NED) of an anchor's error, which is constant over a run."""
    anchor_velocity_sd_mps: float = Field(default=0.01, ge=0, le=100)
    radius_m: float = Field(default=20_000.0, gt=0, le=1e6)
    height_m: float = Field(default=5_000.0, gt=0, le=1e5)
    weave_m: float = Field(default=400.0, ge=0, le=1e4)
    """Amplitude of each component of a node's own motion; less where the cylinder's wall is near."""
    weave_period_s: float = Field(default=120.0, ge=10, le=1e4)
    """Mean of the periods, which are uniform within 30 %. At 400 m the amplitude of each component's
    acceleration is 0.65 to 2.2 m/s^2."""

    @property
    def anchors(self) -> int:
        """Number of nodes that know their position."""
        return round(self.anchor_share * self.nodes)

    @model_validator(mode="after")
    def _some_anchors(self) -> Self:
        if not 1 <= self.anchors < self.nodes:
            raise ValueError(
                f"anchor_share = {self.anchor_share:g} makes {self.anchors} of {self.nodes} nodes anchors;"
                f" 1 to {self.nodes - 1} are allowed, as the own ship is none"
            )
        return self


@dataclass(frozen=True)
class Formation:
    """What is drawn of the nodes once a run. The home of a node is the mean of its path in the cylinder."""

    home: Array
    """(n, 3) m, uniform in the cylinder's frame: down is -height_m to 0."""
    anchor: Booleans
    """(n,); the own ship is none."""
    anchor_position_error: Array
    """(n, 3) believed less true position of anchors, NED at the centre, m; zero for other nodes."""
    anchor_velocity_error: Array
    """(n, 3) m/s."""
    amplitude: Array
    """(n, 3) m, of each component of the weave; zero for the own ship."""
    rate: Array
    """(n, 3) rad/s."""
    phase: Array
    """(n, 3) rad."""
    solver_key: Array
    """(n,) uniform in [0, 1): who computes whose fix."""
    slot_key: Array
    """(n,) uniform in [0, 1): the order of the slots."""

    @property
    def nodes(self) -> int:
        """Number of nodes, n."""
        return len(self.anchor)


def draw_formation(settings: FleetSettings, rng: Generator) -> Formation:
    """Homes, anchors, weaves and keys of all nodes.

    Node i draws from the i-th child of ``rng``, so that a further node leaves all these draws as they were.
    Anchors are the nodes, other than the own ship, with the least of their keys: a further node may make
    one more anchor, or take an anchor's place.
    """
    n = settings.nodes
    children = rng.spawn(n)
    uniform = np.array([child.random(12) for child in children])
    normal = np.array([child.standard_normal(6) for child in children])
    # Never reordered: a new draw joins after these, so that old ones stay.
    area, azimuth, depth, anchor_key, solver_key, slot_key = uniform[:, :6].T
    phase = 2 * np.pi * uniform[:, 6:9]
    stretch = 1 + _PERIOD_SPREAD * (2 * uniform[:, 9:12] - 1)

    radius = settings.radius_m * np.sqrt(area)
    angle = 2 * np.pi * azimuth
    home = np.stack([radius * np.cos(angle), radius * np.sin(angle), -settings.height_m * depth], axis=-1)

    anchor = np.zeros(n, bool)
    anchor[1 + np.argsort(anchor_key[1:], kind="stable")[: settings.anchors]] = True
    sd = np.repeat([settings.anchor_position_sd_m, settings.anchor_velocity_sd_mps], 3)
    error = np.where(anchor[:, None], sd * normal, 0.0)

    # North and east reach their ends together at worst.
    wall = (settings.radius_m - radius) / np.sqrt(2)
    floor = np.minimum(-home[:, 2], settings.height_m + home[:, 2])
    amplitude = np.minimum(settings.weave_m, np.stack([wall, wall, floor], axis=-1))
    amplitude[OWN_SHIP] = 0.0
    return Formation(
        home=home,
        anchor=anchor,
        anchor_position_error=error[:, :3],
        anchor_velocity_error=error[:, 3:],
        amplitude=amplitude,
        rate=2 * np.pi / (settings.weave_period_s * stretch),
        phase=phase,
        solver_key=solver_key,
        slot_key=slot_key,
    )


class CentrePath:
    """The own ship's path without its manoeuvres, from ``start_s`` to ``end_s``: what the centre follows.

    ``time`` (m,) s, about 1 s apart; ``lla`` (m, 3) of the own ship's path smoothed by a Gaussian kernel of
    `SMOOTHING_S`, brought down to the cylinder's base. Beyond either end the path is taken to go on as
    before, its deviation from constant velocity mirrored: the centre has the own ship's velocity there, and
    begins at rest where the own ship does.

    ``base_height_m`` defaults to the least height of the own ship in that time, so that it flies inside
    the cylinder until it has climbed by the cylinder's height. Serves any number of runs.

    Raises `FleetError` for an interval of no length.
    """

    def __init__(
        self, truth: Truth, start_s: float, end_s: float, base_height_m: float | None = None
    ) -> None:
        from scipy.ndimage import gaussian_filter1d  # what many runs do not need is imported where it is

        if not start_s < end_s:
            raise FleetError(f"fleet from {start_s:g} s to {end_s:g} s: the end must be after the start")
        self.truth = truth
        self.time: Array = np.linspace(start_s, end_s, max(4, round((end_s - start_s) / _SAMPLE_S) + 1))
        step = float(self.time[1] - self.time[0])
        lla, v_n, _ = truth.at(self.time)
        r_e = earth.ecef_from_lla(lla)
        v_e = _rotated(earth.C_en(lla[:, 0], lla[:, 1]), v_n)

        smoothing = SMOOTHING_S / step
        beyond = np.arange(1, int(np.ceil(5 * smoothing)) + 1)
        mirrored = np.minimum(beyond, len(r_e) - 1)
        line = step * (beyond + mirrored)[:, None]
        before, after = r_e[mirrored] - line * v_e[0], r_e[-1 - mirrored] + line * v_e[-1]
        path = np.concatenate([before[::-1], r_e, after])
        smooth = gaussian_filter1d(path, smoothing, axis=0, truncate=5.0)[len(beyond) : -len(beyond)]
        self.lla: Array = earth.lla_from_ecef(smooth)
        self.lla[:, 2] = lla[:, 2].min() if base_height_m is None else base_height_m


class Fleet:
    """The paths of all nodes over a `CentrePath`'s time.

    The centre keeps the own ship's smoothed path at the own ship's home north and east; the own ship's home
    down is not used, as its height is the truth's. All other nodes stay inside the cylinder. The own ship
    leaves its home by what the smoothing takes from its path: in the flight of Gao et al. by 1.6 km in the
    take-off run and 0.2 km in the S-manoeuvre, and may leave the cylinder with it. The flat base is above
    the earth's curved surface by d^2 / 2 R, 31 m at 20 km from the centre.
    """

    def __init__(self, formation: Formation, path: CentrePath) -> None:
        from scipy.interpolate import CubicSpline

        self.formation = formation
        self._path = path
        home = np.tile(formation.home[OWN_SHIP] * [1.0, 1.0, 0.0], (len(path.time), 1))
        self._centre = CubicSpline(path.time, earth.ecef_from_lla(earth.displaced(path.lla, -home)))

    def centre(self, t: Array) -> Array:
        """``lla`` (k, 3) of the centre of the cylinder's base at times ``t`` (k,), s."""
        return earth.lla_from_ecef(self._centre(self._inside(t)))

    def at(self, t: Array) -> tuple[Array, Array]:
        """Position ``x_e`` and velocity ``v_e`` relative to the earth, (k, n, 3) m and m/s, at ``t`` (k,), s.

        Raises `FleetError` for times outside the path's.
        """
        t = self._inside(t)
        f = self.formation
        centre_e, centre_v_e = self._centre(t), self._centre(t, 1)
        lat, lon, height = earth.lla_from_ecef(centre_e).T
        C_en = earth.C_en(lat, lon)
        C_ne = C_en.transpose(0, 2, 1)
        centre_v_n = _rotated(C_ne, centre_v_e)
        rate_n = earth.transport_rate_n(lat, height, centre_v_n[:, 0], centre_v_n[:, 1])
        turning = attitude.skew(np.stack(rate_n, axis=-1))

        angle = t[:, None, None] * f.rate + f.phase
        offset = f.home + f.amplitude * np.sin(angle)
        v_offset = f.amplitude * f.rate * np.cos(angle) + offset @ turning.transpose(0, 2, 1)
        x_e = centre_e[:, None] + offset @ C_ne
        v_e = centre_v_e[:, None] + v_offset @ C_ne

        lla, v_n, _ = self._path.truth.at(t)
        x_e[:, OWN_SHIP] = earth.ecef_from_lla(lla)
        v_e[:, OWN_SHIP] = _rotated(earth.C_en(lla[:, 0], lla[:, 1]), v_n)
        return x_e, v_e

    def believed(self, t: Array, x_e: Array, v_e: Array) -> tuple[Array, Array]:
        """What anchors take for their position and velocity where `at` gives ``x_e`` and ``v_e``.

        Shapes are those of `at`; the rows of nodes that are no anchors are the truth's.
        """
        lla = self.centre(t)
        C_ne = earth.C_en(lla[:, 0], lla[:, 1]).transpose(0, 2, 1)
        f = self.formation
        return x_e + f.anchor_position_error @ C_ne, v_e + f.anchor_velocity_error @ C_ne

    def _inside(self, t: Array) -> Array:
        t = np.asarray(t, float)
        start_s, end_s = self._path.time[[0, -1]]
        # Times made by adding up steps miss the ends by rounding.
        if t.size and not (t.min() >= start_s - 1e-6 and t.max() <= end_s + 1e-6):
            raise FleetError(f"time outside the fleet's {start_s:.3f} to {end_s:.3f} s")
        return t


def _rotated(C: Array, v: Array) -> Array:
    """Row by row ``C v``: (k, 3, 3) and (k, 3) to (k, 3)."""
    return np.einsum("kij,kj->ki", C, v)
