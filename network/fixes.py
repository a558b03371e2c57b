"""Position and velocity fixes, as a receiver gets them from the network."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sins.units import DEG
from .tables import check_range, check_rows, read_columns, write_columns

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

_ROW_SHAPES = {
    "t_valid": (),
    "t_stamp": (),
    "t_arrival": (),
    "lla": (3,),
    "v_n": (3,),
    "cov": (6, 6),
    "source": (),
    "sequence": (),
    "authentic": (),
}
_TYPES = {"source": np.int64, "sequence": np.int64, "authentic": np.bool_}


class FixesError(ValueError):
    """Arrays that do not make up fixes."""


@dataclass(frozen=True)
class Fixes:
    """One row for each packet that is received. All times are seconds of the simulation clock.

    A fix may hold what is not a number (a receiver must cope with that); the times may not.
    Raises `FixesError` for wrong shapes or types and for times that are not finite.
    """

    t_valid: Array
    """Time at which position and velocity were true, (k,)."""
    t_stamp: Array
    """Time of validity that the receiver is told, (k,): ``t_valid`` and the error of the sender's clock."""
    t_arrival: Array
    """Time of arrival, (k,)."""
    lla: Array
    """Geodetic latitude and longitude, rad, and height, m, (k, 3)."""
    v_n: Array
    """Velocity, NED, m/s, (k, 3)."""
    cov: Array
    """Covariance of position (NED, m) and velocity (NED, m/s) errors, (k, 6, 6)."""
    source: Integers
    """Node that made the fix, (k,)."""
    sequence: Integers
    """Number that the node gave the packet, (k,): a duplicate repeats source and sequence."""
    authentic: Booleans = field(default_factory=lambda: np.ones(0, np.bool_))
    """Whether the receiver takes the packet for its source's, and for fresh, (k,); by default it does."""

    def __post_init__(self) -> None:
        k = len(self)
        if not len(self.authentic):
            object.__setattr__(self, "authentic", np.ones(k, np.bool_))
        for name, row_shape in _ROW_SHAPES.items():
            value = getattr(self, name)
            dtype = _TYPES.get(name, np.float64)
            if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != (k, *row_shape):
                got = (
                    f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
                )
                raise FixesError(f"{name} must be {np.dtype(dtype)} {(k, *row_shape)}; got {got}")
        for name in ("t_valid", "t_stamp", "t_arrival"):
            if not np.isfinite(getattr(self, name)).all():
                raise FixesError(f"{name} must be finite throughout")

    def __len__(self) -> int:
        return len(self.t_valid)

    def __getitem__(self, rows: slice | Integers | NDArray[np.bool_]) -> "Fixes":
        """The chosen rows: a slice, a mask or an array of indices."""
        return Fixes(*(getattr(self, field.name)[rows] for field in fields(self)))

    def sorted_by_arrival(self) -> "Fixes":
        """The same packets in order of arrival; those that arrive together keep their order."""
        if (np.diff(self.t_arrival) >= 0).all():
            return self
        return self[np.argsort(self.t_arrival, kind="stable")]


def concatenate(parts: Iterable[Fixes]) -> Fixes:
    """All packets of several receptions, in order of arrival."""
    parts = list(parts)
    columns = (np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Fixes))
    return Fixes(*columns).sorted_by_arrival()


_AXES = ("north", "east", "down", "v_north", "v_east", "v_down")
_TIMES = ("t_valid_s", "t_stamp_s", "t_arrival_s")
_POSITION = ("lat_deg", "lon_deg", "height_m")
_POSITION_UNITS = np.array([DEG, DEG, 1.0])
_VELOCITY = ("v_north_mps", "v_east_mps", "v_down_mps")
_SD = ("sd_north_m", "sd_east_m", "sd_down_m", "sd_v_north_mps", "sd_v_east_mps", "sd_v_down_mps")
_NUMBERS = ("source", "sequence")
_UPPER = tuple(zip(*np.triu_indices(6, 1), strict=True))
_CORRELATIONS = {f"corr_{_AXES[i]}_{_AXES[j]}": (i, j) for i, j in _UPPER}

# The whole numbers that a float64 column holds exactly end at 2^53.
_RANGES = (
    dict.fromkeys(_TIMES, (-1e9, 1e9))
    | {"lat_deg": (-90.0, 90.0), "lon_deg": (-180.0, 360.0), "height_m": (-1e4, 1e6)}
    | dict.fromkeys(_VELOCITY, (-1e4, 1e4))
    | dict.fromkeys(_SD, (1e-6, 1e6))
    | dict.fromkeys(_NUMBERS, (0.0, 2.0**53))
    | {"authentic": (0.0, 1.0)}
    | dict.fromkeys(_CORRELATIONS, (-1.0, 1.0))
)


def read_fixes(file: str | Path) -> Fixes:
    """Fixes from a CSV or Parquet file, in order of arrival.

    Columns: ``t_valid_s, t_stamp_s, t_arrival_s, lat_deg, lon_deg, height_m, v_north_mps, v_east_mps,
    v_down_mps``; standard deviations ``sd_north_m, sd_east_m, sd_down_m, sd_v_north_mps, sd_v_east_mps,
    sd_v_down_mps``; ``source, sequence``; and, where errors are correlated, correlation coefficients
    ``corr_north_east`` ... ``corr_v_east_v_down`` (those absent are zero); ``authentic``, 0 for packets whose
    tag the receiver refused (1 if absent).

    Raises `TableError`, one line with file, column, row, value and allowed range.
    """
    file = Path(file)
    required = (*_TIMES, *_POSITION, *_VELOCITY, *_SD, *_NUMBERS)
    columns = read_columns(file, required, (*_CORRELATIONS, "authentic"), refuse_others=True)
    for name, values in columns.items():
        check_range(file, name, values, *_RANGES[name])
    for name in _NUMBERS:
        check_rows(file, name, columns[name], columns[name] % 1 == 0, "a whole number")
    t_valid, t_stamp, t_arrival = (columns[name] for name in _TIMES)
    check_rows(file, "t_arrival_s", t_arrival, t_arrival >= t_valid, "t_valid_s or later")

    correlation = np.tile(np.eye(6), (len(t_valid), 1, 1))
    for name, (i, j) in _CORRELATIONS.items():
        if name in columns:
            correlation[:, i, j] = correlation[:, j, i] = columns[name]
    least = np.linalg.eigvalsh(correlation)[:, 0].astype(np.float64)
    check_rows(file, "corr_*", least, least > -1e-9, "least eigenvalue of the correlations 0 or more")
    sd = np.stack([columns[name] for name in _SD], axis=-1)
    return Fixes(
        t_valid=t_valid,
        t_stamp=t_stamp,
        t_arrival=t_arrival,
        lla=np.stack([columns[name] for name in _POSITION], axis=-1) * _POSITION_UNITS,
        v_n=np.stack([columns[name] for name in _VELOCITY], axis=-1),
        cov=correlation * sd[:, :, None] * sd[:, None, :],
        source=columns["source"].astype(np.int64),
        sequence=columns["sequence"].astype(np.int64),
        authentic=columns.get("authentic", np.ones(len(t_valid))) > 0,
    ).sorted_by_arrival()


def write_fixes(fixes: Fixes, file: str | Path) -> None:
    """Write fixes to a CSV or Parquet file, with the columns of `read_fixes`.

    Raises `TableError` for another kind of file.
    """
    sd = np.sqrt(np.diagonal(fixes.cov, axis1=1, axis2=2))
    columns: dict[str, ArrayLike] = dict(
        zip(_TIMES, (fixes.t_valid, fixes.t_stamp, fixes.t_arrival), strict=True)
    )
    columns |= dict(zip(_POSITION, (fixes.lla / _POSITION_UNITS).T, strict=True))
    columns |= dict(zip(_VELOCITY, fixes.v_n.T, strict=True))
    columns |= dict(zip(_SD, sd.T, strict=True))
    for name, (i, j) in _CORRELATIONS.items():
        if fixes.cov[:, i, j].any():
            columns[name] = np.clip(fixes.cov[:, i, j] / (sd[:, i] * sd[:, j]), -1, 1)
    if not fixes.authentic.all():
        columns["authentic"] = fixes.authentic.astype(np.float64)
    write_columns(columns | {"source": fixes.source, "sequence": fixes.sequence}, Path(file))
