"""A frame that neither turns nor accelerates, begun at a place of the earth; many of them at once."""

from dataclasses import dataclass

import numpy as np
from fleetalign.sins import attitude, earth
from fleetalign.sins.attitude import skew
from fleetalign.sins.earth import EARTH_RATE, GravityModel

Array = np.ndarray
W_IE = skew(np.array([0.0, 0.0, EARTH_RATE]))


def apply(C: Array, v: Array) -> Array:
    """Matrices (..., 3, 3) on vectors (..., 3)."""
    return (C @ v[..., None])[..., 0]


@dataclass(frozen=True)
class Frame:
    """The axes of n at a place, held against inertial space, and an origin in uniform motion from there."""

    C_e0: Array
    """(n, 3, 3) from these axes to those of the earth at the start."""
    r_0: Array
    """(n, 3) where the origin is at the start, in the axes of the earth, m."""
    v_0: Array
    """(n, 3) its velocity against inertial space, in its own axes, m/s."""

    @staticmethod
    def at(lla: Array, v_n: Array) -> "Frame":
        """From a place (n, 3) with a velocity (n, 3) relative to the earth."""
        C_e0, r_0 = earth.C_en(lla[:, 0], lla[:, 1]), earth.ecef_from_lla(lla)
        return Frame(C_e0, r_0, v_n + apply(C_e0.mT, apply(W_IE, r_0)))

    def from_earth(self, since: float) -> Array:
        """(n, 3, 3) direction cosines from the earth's axes after a time."""
        return self.C_e0.mT @ attitude.to_dcm(attitude.from_rotvec([0.0, 0.0, EARTH_RATE * since]))

    def entered(self, since: float, lla: Array, v_n: Array) -> tuple[Array, Array, Array]:
        """Velocity and position (n, 3) in the frame, and C_0n (n, 3, 3)."""
        C_0e, C_en = self.from_earth(since), earth.C_en(lla[:, 0], lla[:, 1])
        r = earth.ecef_from_lla(lla)
        v = apply(C_0e, apply(C_en, v_n) + apply(W_IE, r)) - self.v_0
        p = apply(C_0e, r) - apply(self.C_e0.mT, self.r_0) - self.v_0 * since
        return v, p, C_0e @ C_en

    def left(self, since: float, v: Array, p: Array) -> tuple[Array, Array, Array]:
        """The way back: ``lla`` and ``v_n`` (n, 3), and C_0n (n, 3, 3)."""
        C_0e = self.from_earth(since)
        r = apply(C_0e.mT, p + self.v_0 * since + apply(self.C_e0.mT, self.r_0))
        lla = earth.lla_from_ecef(r)
        C_en = earth.C_en(lla[:, 0], lla[:, 1])
        return lla, apply(C_en.mT, apply(C_0e.mT, v + self.v_0) - apply(W_IE, r)), C_0e @ C_en

    def gravitation(self, since: float, p: Array, model: GravityModel) -> Array:
        """(n, 3) m/s^2: gravity without the earth's turning."""
        lla, _, C_0n = self.left(since, np.zeros_like(p), p)
        north, down = earth.gravity(model, lla[:, 0], lla[:, 2])
        g_n = np.stack([north, np.zeros(len(lla)), down], axis=1)
        centripetal = apply(W_IE, apply(W_IE, earth.ecef_from_lla(lla)))
        return apply(C_0n, g_n) + apply(self.from_earth(since), centripetal)
