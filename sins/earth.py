"""WGS84 earth: radii of curvature, rates, gravity by named models, position conversions.

The formulas work on scalars and on arrays alike, and are callable from compiled code.

References
----------
.. [1] NIMA TR8350.2, "Department of Defense World Geodetic System 1984", 3rd ed.
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation
       Systems", 2nd ed., sections 2.3 and 2.4.
.. [3] H. Vermeille, "Direct transformation from geocentric coordinates to geodetic
       coordinates", Journal of Geodesy 76 (2002).
"""

from enum import IntEnum
from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike, NDArray

from .attitude import wrapped

Real = Any
"""A number or an array of numbers: the formulas that are compiled take and give either."""

EQUATORIAL_RADIUS = 6378137.0
"""Semi-major axis, m."""
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)
EARTH_RATE = 7.292115e-5
"""Rate of e relative to i, rad/s."""
GRAVITATIONAL_PARAMETER = 3.986004418e14
"""GM, m^3/s^2."""
J2 = 1.08262982e-3
"""Second zonal harmonic, as JSBSim has it."""
GRAVITY_EQUATOR = 9.7803253359
"""Normal gravity on the ellipsoid at the equator, m/s^2."""
SOMIGLIANA_K = 0.00193185265241
"""Somigliana's constant."""
GRAVITY_RATIO = 0.00344978650684
"""m = w^2 a^2 b / GM of the normal-gravity height formula."""
PLUMB_LINE_CURVATURE = -2 * 8.08e-9
"""North gravity at height, for height times sine times cosine of latitude, 1/s^2."""
STANDARD_GRAVITY = 9.80665
"""The unit g of accelerometer data sheets and load factors, m/s^2."""


class GravityModel(IntEnum):
    """Gravity models that a scenario can name (lower case)."""

    J2 = 0
    """Gravitation of a point mass and J2, plus the centrifugal term: what JSBSim flies in."""
    SOMIGLIANA = 1
    """Normal gravity of the ellipsoid with its height formula, and the curvature of the plumb line."""


@register_jitable
def radii_of_curvature(lat: Real) -> tuple[Real, Real]:
    """Meridian and transverse radius of curvature of the ellipsoid.

    Parameters: ``lat``, geodetic latitude, rad. Returns ``(R_N, R_E)``, m ([2]_ 2.105 and 2.106).
    """
    return radii_by_sine(np.sin(lat))


@register_jitable
def radii_by_sine(sin_lat: Real) -> tuple[Real, Real]:
    """`radii_of_curvature` for loops that have the sine of the latitude at hand."""
    x = 1 - ECCENTRICITY_SQUARED * sin_lat**2
    R_E = EQUATORIAL_RADIUS / np.sqrt(x)
    return R_E * (1 - ECCENTRICITY_SQUARED) / x, R_E


@register_jitable
def gravity_j2(sin_lat: Real, cos_lat: Real, height: Real) -> tuple[Real, Real]:
    """Gravity (gravitation and centrifugal) of the J2 earth, resolved in n.

    Parameters: sine and cosine of geodetic latitude; ``height``, m. Returns ``(g_north, g_down)``,
    m/s^2; the east component is zero.
    """
    R_E = radii_by_sine(sin_lat)[1]
    # In the meridian plane: distance from the axis, and along the axis.
    x = (R_E + height) * cos_lat
    z = (R_E * (1 - ECCENTRICITY_SQUARED) + height) * sin_lat
    r2_inverse = 1 / (x * x + z * z)
    central = -GRAVITATIONAL_PARAMETER * r2_inverse * np.sqrt(r2_inverse)
    oblate = 1.5 * J2 * EQUATORIAL_RADIUS**2 * r2_inverse
    s2 = 5 * z * z * r2_inverse
    g_x = central * x * (1 + oblate * (1 - s2)) + EARTH_RATE**2 * x
    g_z = central * z * (1 + oblate * (3 - s2))
    return -sin_lat * g_x + cos_lat * g_z, -cos_lat * g_x - sin_lat * g_z


@register_jitable
def gravity_somigliana(sin_lat: Real, cos_lat: Real, height: Real) -> tuple[Real, Real]:
    """Normal gravity on the ellipsoid (Somigliana) carried to height by a second-order formula.

    Parameters and returns as `gravity_j2`. Down: [1]_ 4-1 and 4-3; north, the curvature of the plumb
    line: [2]_ 2.140.
    """
    s2 = sin_lat**2
    surface = GRAVITY_EQUATOR * (1 + SOMIGLIANA_K * s2) / np.sqrt(1 - ECCENTRICITY_SQUARED * s2)
    ratio = height / EQUATORIAL_RADIUS
    down = surface * (1 - 2 * ratio * (1 + FLATTENING + GRAVITY_RATIO - 2 * FLATTENING * s2) + 3 * ratio**2)
    return PLUMB_LINE_CURVATURE * height * sin_lat * cos_lat, down


@register_jitable
def gravity_by_sine(model: int, sin_lat: Real, cos_lat: Real, height: Real) -> tuple[Real, Real]:
    """`gravity` for loops that have the sine and the cosine of the latitude at hand."""
    if model == 0:
        return gravity_j2(sin_lat, cos_lat, height)
    return gravity_somigliana(sin_lat, cos_lat, height)


@register_jitable
def gravity(model: int, lat: Real, height: Real) -> tuple[Real, Real]:
    """Gravity of a named model.

    Parameters: ``model``, a `GravityModel`; ``lat``, geodetic, rad; ``height``, m.
    Returns ``(g_north, g_down)``, m/s^2.
    """
    return gravity_by_sine(model, np.sin(lat), np.cos(lat), height)


@register_jitable
def earth_rate_n(lat: Real) -> tuple[Real, Real, Real]:
    """Earth rate resolved in n, ``(north, east, down)``, rad/s; ``lat`` in rad ([2]_ 2.123)."""
    return EARTH_RATE * np.cos(lat), 0.0 * lat, -EARTH_RATE * np.sin(lat)


@register_jitable
def transport_rate_n(lat: Real, height: Real, v_north: Real, v_east: Real) -> tuple[Real, Real, Real]:
    """Rate of n relative to e resolved in n, ``(north, east, down)``, rad/s ([2]_ 5.44).

    Parameters: ``lat``, rad; ``height``, m; ``v_north`` and ``v_east``, m/s relative to the earth.
    """
    R_N, R_E = radii_of_curvature(lat)
    east_rate = v_east / (R_E + height)
    return east_rate, -v_north / (R_N + height), -east_rate * np.tan(lat)


def ecef_from_lla(lla: ArrayLike) -> NDArray[np.float64]:
    """Position in e, m, shape (..., 3), from ``lla`` (rad, rad, m), shape (..., 3) ([2]_ 2.112)."""
    lat, lon, height = np.moveaxis(np.asarray(lla, float), -1, 0)
    R_E = radii_of_curvature(lat)[1]
    axial = (R_E + height) * np.cos(lat)
    polar = (R_E * (1 - ECCENTRICITY_SQUARED) + height) * np.sin(lat)
    return np.stack([axial * np.cos(lon), axial * np.sin(lon), polar], axis=-1)


def lla_from_ecef(r_e: ArrayLike) -> NDArray[np.float64]:
    """Geodetic ``lla`` (rad, rad, m), shape (..., 3), from a position in e, m, shape (..., 3).

    Vermeille's closed form [3]_: exact to rounding outside 43 km of the earth's centre.
    """
    x, y, z = np.moveaxis(np.asarray(r_e, float), -1, 0)
    a, e2 = EQUATORIAL_RADIUS, ECCENTRICITY_SQUARED
    axial = np.hypot(x, y)
    p = (axial / a) ** 2
    q = (1 - e2) * (z / a) ** 2
    r = (p + q - e2**2) / 6
    s = e2**2 * p * q / (4 * r**3)
    t = np.cbrt(1 + s + np.sqrt(s * (2 + s)))
    u = r * (1 + t + 1 / t)
    v = np.sqrt(u**2 + e2**2 * q)
    w = e2 * (u + v - q) / (2 * v)
    k = np.sqrt(u + v + w**2) - w
    d = k * axial / (k + e2)
    hypotenuse = np.hypot(d, z)
    return np.stack(
        [2 * np.arctan2(z, d + hypotenuse), np.arctan2(y, x), (k + e2 - 1) / k * hypotenuse], axis=-1
    )


def C_en(lat: ArrayLike, lon: ArrayLike) -> NDArray[np.float64]:
    """Direction cosines from n to e, shape (..., 3, 3), at geodetic ``lat``, ``lon``, rad."""
    lat, lon = np.broadcast_arrays(np.asarray(lat, float), np.asarray(lon, float))
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lat)], axis=-1)
    down = np.stack([-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat], axis=-1)
    return np.stack([north, east, down], axis=-1)


def displacement_n(lla: ArrayLike, lla_reference: ArrayLike) -> NDArray[np.float64]:
    """Small displacement from ``lla_reference`` to ``lla``, NED, m, shape (..., 3).

    First order in the separation: 1 km apart it is right to some 0.1 m. The antimeridian may lie between.
    """
    lla, reference = np.asarray(lla, float), np.asarray(lla_reference, float)
    R_N, R_E = radii_of_curvature(reference[..., 0])
    d = lla - reference
    height = reference[..., 2]
    return np.stack(
        [
            d[..., 0] * (R_N + height),
            wrapped(d[..., 1]) * (R_E + height) * np.cos(reference[..., 0]),
            -d[..., 2],
        ],
        axis=-1,
    )


def displaced(lla: ArrayLike, displacement: ArrayLike) -> NDArray[np.float64]:
    """The position ``displacement`` (NED, m) away from ``lla``: the inverse of `displacement_n`.

    Its longitude is in [-pi, pi).
    """
    lla, d = np.asarray(lla, float), np.asarray(displacement, float)
    R_N, R_E = radii_of_curvature(lla[..., 0])
    height = lla[..., 2]
    step = [d[..., 0] / (R_N + height), d[..., 1] / ((R_E + height) * np.cos(lla[..., 0])), -d[..., 2]]
    moved = lla + np.stack(step, axis=-1)
    moved[..., 1] = wrapped(moved[..., 1])
    return moved
