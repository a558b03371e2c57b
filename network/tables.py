"""Columns of numbers in CSV and Parquet files, checked as they are read."""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from pyarrow import csv, parquet
from pydantic import AfterValidator, ValidationInfo

from ..sins.text import printable, shortened

Array = NDArray[np.float64]

MOST_ROWS = 50_000_000
"""Of a table that is read."""


def inside(folder: Path, file: str | Path) -> Path:
    """The absolute path of a file that another file, which stands in ``folder``, names relative to it.

    Raises ValueError for an absolute name, and for what is outside the folder once ``..`` and links are
    followed, or is there and is no file.
    """
    if Path(file).is_absolute():
        raise ValueError("an absolute path: must be relative to the file that names it")
    try:
        path = Path(folder, file).resolve()
        contained, is_none = path.is_relative_to(folder.resolve()), path.exists() and not path.is_file()
    except (OSError, RuntimeError) as error:
        raise ValueError("cannot be read: no such path") from error
    if not contained:
        raise ValueError("outside the folder of the file that names it")
    if is_none:
        raise ValueError("is no file")
    return path


def _checked(file: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get("folder")
    return file if folder is None else inside(Path(folder), file)


DataFile = Annotated[Path, AfterValidator(_checked)]
"""A file that settings name.

With ``folder`` in the validation's context it must be `inside` that, and becomes an absolute path. Without,
the path is the caller's own, and free.
"""


class TableError(ValueError):
    """A file that cannot be read as numbers. The message is one line; what it says is kept beside it.

    ``column``, ``row`` (1 is the first row of data), ``value`` and ``allowed`` are None where they do
    not apply.
    """

    def __init__(
        self,
        file: Path,
        problem: str,
        column: str | None = None,
        row: int | None = None,
        value: object = None,
        allowed: str | None = None,
    ) -> None:
        self.file, self.column, self.row, self.value, self.allowed = file, column, row, value, allowed
        places = ("column", column and shortened(printable(column))), ("row", row)
        place = "".join(f", {name} {where}" for name, where in places if where)
        super().__init__(f"{printable(str(file))}{place}: {problem}")


def read_columns(
    file: Path,
    required: Iterable[str],
    optional: Iterable[str] = (),
    *,
    refuse_others: bool = False,
    may_lack: Collection[str] = (),
) -> dict[str, Array]:
    """The named columns of a CSV or Parquet file, float64, each (k,), without absent optional ones.

    Raises `TableError` for a file that cannot be read, a missing, repeated or (``refuse_others``) unknown
    column, and for a cell that is not a finite number; in the columns ``may_lack`` an empty cell or one
    that is no number as such (NaN, infinity) is NaN.
    """
    required, optional = list(required), list(optional)
    table = _read_table(file)
    names = table.column_names
    for name, count in Counter(names).items():
        if count > 1:
            raise TableError(file, "stands there more than once", name)
    missing = [name for name in required if name not in names]
    if missing:
        raise TableError(file, f"no column {_listed(missing)}; it has {_listed(names)}")
    unknown = [name for name in names if name not in required + optional]
    if unknown and refuse_others:
        raise TableError(file, f"unknown column {_listed(unknown)}")
    present = [name for name in required + optional if name in names]
    return {name: _numbers(file, name, table, name in may_lack) for name in present}


def write_columns(columns: Mapping[str, ArrayLike], file: Path) -> None:
    """Write columns to a CSV or Parquet file, by the file's suffix; raises `TableError` for another."""
    table = pa.table({name: np.asarray(values) for name, values in columns.items()})
    match file.suffix.lower():
        case ".csv":
            csv.write_csv(table, file)
        case ".parquet":
            parquet.write_table(table, file)
        case _:
            raise TableError(file, "must end in .csv or .parquet")


def check_rows(file: Path, column: str, values: Array, good: NDArray[np.bool_], allowed: str) -> None:
    """Raise `TableError` for the first row that is not good."""
    if not good.all():
        row = int(np.argmin(good))
        value = float(values[row])
        raise TableError(file, f"{value:.10g} is not allowed ({allowed})", column, row + 1, value, allowed)


def check_range(file: Path, column: str, values: Array, low: float, high: float) -> None:
    """Raise `TableError` for the first value outside ``low`` to ``high`` (both allowed)."""
    check_rows(file, column, values, (values >= low) & (values <= high), f"{low:.10g} to {high:.10g}")


def _read_table(file: Path) -> pa.Table:  # pyright: ignore[reportUnknownParameterType]
    try:
        match file.suffix.lower():
            case ".csv":
                return csv.read_csv(file)
            case ".parquet":
                with parquet.ParquetFile(file) as columns:
                    # A few bytes can stand for more rows than fit into the memory.
                    if columns.metadata.num_rows > MOST_ROWS:
                        raise TableError(file, f"{columns.metadata.num_rows} rows: allowed are {MOST_ROWS}")
                    table = columns.read()
            case _:
                raise TableError(file, "must end in .csv or .parquet")
        "".join(table.column_names)  # decoded here, where they may prove to be no UTF-8
        return table
    except FileNotFoundError as error:
        raise TableError(file, "no such file") from error
    except UnicodeDecodeError as error:
        raise TableError(file, "names of columns that are not UTF-8 text") from error
    except (OSError, pa.ArrowException) as error:
        raise TableError(file, shortened(printable(" ".join(str(error).split())), 200)) from error


def _numbers(file: Path, column: str, table: pa.Table, may_lack: bool) -> Array:  # pyright: ignore[reportUnknownParameterType]
    cells = table.column(column)
    kind = cells.type
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_null(kind)):
        # One odd cell makes its whole column text: find it for the message.
        for row, cell in enumerate(_texts(file, column, cells), start=1):
            if not (_is_finite_number(cell) or (may_lack and cell in (None, ""))):
                raise _not_finite(file, column, row, cell)
        raise TableError(file, f"holds {shortened(printable(str(kind)))}, not numbers", column)
    values = cells.cast(pa.float64(), safe=False).to_numpy()
    finite = np.isfinite(values)
    if may_lack:
        return np.where(finite, values, np.nan)
    bad = np.flatnonzero(~finite)
    if bad.size:
        raise _not_finite(file, column, int(bad[0]) + 1, cells[int(bad[0])].as_py())
    return values


def _texts(file: Path, column: str, cells: pa.ChunkedArray) -> list[Any]:  # pyright: ignore[reportUnknownParameterType]
    """The cells of a column of texts or bytes, none of another."""
    kind = cells.type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_binary(kind)):
        return []
    try:
        return cells.to_pylist()
    except UnicodeDecodeError as error:
        raise TableError(file, "text that is not UTF-8", column) from error


def _listed(names: list[str]) -> str:
    return shortened(printable(", ".join(names)), 400)


def _is_finite_number(cell: object) -> bool:
    try:
        return math.isfinite(float(cell))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False


def _not_finite(file: Path, column: str, row: int, cell: object) -> TableError:
    shown = "an empty cell" if cell is None else shortened(repr(cell))
    return TableError(file, f"{shown} is not a finite number", column, row, cell, "a finite number")
