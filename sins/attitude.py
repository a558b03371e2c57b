"""Attitude: Hamilton quaternions (scalar first), rotation vectors, direction cosines, Euler angles.

Every function takes arrays with the components along the last axis and any leading axes.

References
----------
.. [1] P. G. Savage, "Strapdown Analytics", 2nd ed., section 3.2.
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation
       Systems", 2nd ed., section 2.2.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Quaternion product ``p q``, shape (..., 4): rotates by ``q`` first, then by ``p``."""
    pw, px, py, pz = np.moveaxis(np.asarray(p, float), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q, float), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> Array:
    """The inverse of a unit quaternion, shape (..., 4)."""
    return np.asarray(q, float) * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Rotate vectors: for ``q_nb`` and ``v`` in b the components in n, shape (..., 3)."""
    q, v = np.asarray(q, float), np.asarray(v, float)
    t = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * t + np.cross(q[..., 1:], t)


def from_rotvec(rotvec: ArrayLike) -> Array:
    """Unit quaternion, shape (..., 4), of a rotation vector, rad, shape (..., 3)."""
    rotvec = np.asarray(rotvec, float)
    half = 0.5 * np.linalg.norm(rotvec, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * rotvec], axis=-1)


def to_rotvec(q: ArrayLike) -> Array:
    """Rotation vector, rad, at most pi long, shape (..., 3), of a unit quaternion, shape (..., 4)."""
    q = np.asarray(q, float)
    q = np.where(q[..., :1] < 0, -q, q)
    sin_half = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sin_half, q[..., :1])
    scale = np.where(sin_half > 1e-8, angle / np.where(sin_half > 1e-8, sin_half, 1.0), 2.0)
    return scale * q[..., 1:]


def to_dcm(q: ArrayLike) -> Array:
    """Direction cosines, shape (..., 3, 3), of a unit quaternion: ``q_nb`` gives ``C_nb`` ([1]_ 3.2.4.2)."""
    w, x, y, z = np.moveaxis(np.asarray(q, float), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_dcm(C: ArrayLike) -> Array:
    """Unit quaternion with non-negative scalar part, shape (..., 4), of direction cosines, shape (..., 3, 3).

    The largest of the four components is found first (Shepperd), so that no division is small.
    """
    C = np.asarray(C, float)
    xx, yy, zz = C[..., 0, 0], C[..., 1, 1], C[..., 2, 2]
    squares = np.stack([xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy], axis=-1) + 1
    a, b, c = C[..., 2, 1] - C[..., 1, 2], C[..., 0, 2] - C[..., 2, 0], C[..., 1, 0] - C[..., 0, 1]
    d, e, f = C[..., 1, 0] + C[..., 0, 1], C[..., 0, 2] + C[..., 2, 0], C[..., 2, 1] + C[..., 1, 2]
    candidates = np.stack(
        [
            np.stack([squares[..., 0], a, b, c], axis=-1),
            np.stack([a, squares[..., 1], d, e], axis=-1),
            np.stack([b, d, squares[..., 2], f], axis=-1),
            np.stack([c, e, f, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(squares, axis=-1)
    q = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def from_euler(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Array:
    """``q_nb``, shape (..., 4), from roll, pitch and heading, rad (heading first, then pitch, then roll)."""
    roll, pitch, heading = np.broadcast_arrays(
        np.asarray(roll, float), np.asarray(pitch, float), np.asarray(heading, float)
    )
    cr, sr = np.cos(roll / 2), np.sin(roll / 2)
    cp, sp = np.cos(pitch / 2), np.sin(pitch / 2)
    ch, sh = np.cos(heading / 2), np.sin(heading / 2)
    return np.stack(
        [
            cr * cp * ch + sr * sp * sh,
            sr * cp * ch - cr * sp * sh,
            cr * sp * ch + sr * cp * sh,
            cr * cp * sh - sr * sp * ch,
        ],
        axis=-1,
    )


def to_euler(q: ArrayLike) -> Array:
    """Roll, pitch, heading, rad, shape (..., 3), of ``q_nb``; roll and heading in (-pi, pi] ([2]_ 2.23)."""
    w, x, y, z = np.moveaxis(np.asarray(q, float), -1, 0)
    roll = np.arctan2(2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    heading = np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
    return np.stack([roll, pitch, heading], axis=-1)


def skew(v: ArrayLike) -> Array:
    """The matrix ``[v x]``, shape (..., 3, 3), for which ``[v x] u`` is the cross product."""
    x, y, z = np.moveaxis(np.asarray(v, float), -1, 0)
    o = np.zeros_like(x)
    return np.stack(
        [np.stack([o, -z, y], axis=-1), np.stack([z, o, -x], axis=-1), np.stack([-y, x, o], axis=-1)], axis=-2
    )


def wrapped(angle: ArrayLike) -> Array:
    """The same angle in [-pi, pi), rad; to the last bit where it lies there already, NaN if infinite."""
    angle = np.asarray(angle, float)
    with np.errstate(invalid="ignore"):
        turned = angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
    return np.where(np.abs(angle) < np.pi, angle, turned)


def misalignment(q_nb: ArrayLike, q_nb_true: ArrayLike) -> Array:
    """Rotation vector from the true n to the computed n, rad, shape (..., 3): the error state ``phi``."""
    return to_rotvec(multiply(np.asarray(q_nb_true, float), conjugate(q_nb)))


def corrected(q_nb: ArrayLike, phi: ArrayLike) -> Array:
    """The attitude freed of a misalignment ``phi``, rad, shape (..., 3)."""
    return multiply(from_rotvec(phi), q_nb)


def attitude_error(q_nb: ArrayLike, q_nb_true: ArrayLike) -> Array:
    """Roll, pitch and heading error, computed minus true, rad, wrapped, shape (..., 3)."""
    return wrapped(to_euler(q_nb) - to_euler(q_nb_true))


def attitude_error_matrix(q_nb: ArrayLike) -> Array:
    """T, shape (..., 3, 3), of ``[roll, pitch, heading] error = T phi`` to first order, at attitude ``q_nb``.

    Singular at a pitch of 90 deg, where roll and heading are not defined.
    """
    _, pitch, heading = np.moveaxis(to_euler(q_nb), -1, 0)
    sin_h, cos_h, o, one = np.sin(heading), np.cos(heading), np.zeros_like(pitch), np.ones_like(pitch)
    rows = [
        [cos_h / np.cos(pitch), sin_h / np.cos(pitch), o],
        [-sin_h, cos_h, o],
        [cos_h * np.tan(pitch), sin_h * np.tan(pitch), one],
    ]
    # The computed n is turned by phi, so the body is turned by -phi as seen from it.
    return -np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
