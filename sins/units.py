"""Units at the boundary: multiply by one to enter SI, divide by it to leave.

``bias = 0.02 * DEG_PER_HOUR`` is in rad/s; ``heading_error / ARCMIN`` is in arcmin.
"""

import math

from .earth import STANDARD_GRAVITY

DEG = math.pi / 180
"""rad"""
ARCMIN = DEG / 60
"""rad"""
ARCSEC = DEG / 3600
"""rad"""
HOUR = 3600.0
"""s"""
MILLISECOND = 1e-3
"""s"""
PPM = 1e-6
"""Dimensionless."""
G = STANDARD_GRAVITY
"""m/s^2"""
MICRO_G = 1e-6 * G
"""m/s^2"""
DEG_PER_HOUR = DEG / HOUR
"""rad/s"""
DEG_PER_SQRT_HOUR = DEG / math.sqrt(HOUR)
"""rad/s^(1/2): root PSD of an angular rate, angular random walk."""
MICRO_G_PER_SQRT_HZ = MICRO_G
"""m/s^(3/2): root PSD of a specific force, velocity random walk."""
DEG_PER_HOUR_PER_G = DEG_PER_HOUR / G
"""rad s/m: angular rate for specific force."""
