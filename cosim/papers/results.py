"""What an experiment gives: tables of methods with intervals, claims with verdicts, and figures to draw."""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Progress = Callable[[float, float], None]


class Form(StrEnum):
    """Whose a method is."""

    PUBLISHED = "as published"
    MENDED = "as mended"
    BASELINE = "baseline"
    OURS = "best of ours"
    BOUND = "bound"


class Verdict(StrEnum):
    """What became of a claim."""

    REPRODUCED = "reproduced"
    PARTLY = "partly reproduced"
    NOT = "not reproduced"
    UNDECIDED = "undecided"
    """The interval holds both answers, or draws are too few for one."""


@dataclass(frozen=True)
class Value:
    """A measured figure with its 95 % confidence interval; NaN where nothing can be said."""

    value: float
    low: float = np.nan
    high: float = np.nan


@dataclass(frozen=True)
class Metric:
    """A column of a table."""

    key: str
    """Name with unit: the field of the JSON summary."""
    heading: str
    """As the table has it, unit included."""
    digits: int
    about: str
    """What it is, in a line."""
    brief: bool = True
    """Whether the terminal's table has it, in which there is room for some six."""


@dataclass(frozen=True)
class Row:
    """One method of a table."""

    method: str
    form: Form
    values: dict[str, Value]
    """By key of the metrics; those that do not apply are absent."""
    about: str = ""
    """Equations and module, in a line."""


@dataclass(frozen=True)
class Table:
    """Methods on the same draws."""

    name: str
    """Key of the JSON summary."""
    title: str
    metrics: tuple[Metric, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Claim:
    """A statement of the paper beside ours."""

    where: str
    """Section, figure or table of the paper."""
    statement: str
    rule: str
    """By which it is judged, said before the numbers are seen."""
    verdict: Verdict
    measured: str
    why: str
    """What makes the difference, or what the agreement rests on."""


@dataclass(frozen=True)
class Curve:
    """A line of a panel, or points without a line; with ``low`` and ``high`` a band around it."""

    label: str
    x: Array
    y: Array
    low: Array | None = None
    high: Array | None = None
    look: Literal["line", "dashed", "dotted", "points", "crosses", "stars"] = "line"
    color: str | None = None
    """``#RRGGBB``; by default each label has its own, the same in all panels of a figure."""


@dataclass(frozen=True)
class Panel:
    """Axes of a figure."""

    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    title: str = ""
    log_y: bool = False
    equal: bool = False
    """Whether a metre is as long on both axes: maps."""
    shaded: tuple[tuple[float, float], ...] = ()
    """Intervals of x that stand out: outages."""


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper, drawn again."""

    name: str
    """Key in the page, e.g. ``"figure_2"``."""
    caption: str
    panels: tuple[tuple[Panel, ...], ...]
    """Rows of panels."""
    height_in: float = 3.6


@dataclass(frozen=True)
class Results:
    """All that an experiment found."""

    tables: tuple[Table, ...]
    claims: tuple[Claim, ...]
    figures: tuple[PaperFigure, ...]
    notes: tuple[str, ...] = ()
    """Assumptions and departures that a reader of the tables must know, one sentence each."""
    estimates: dict[str, Array] = field(default_factory=dict)
    """Columns of `estimates.parquet`, all of one length; none for no file."""
    write_recording: Callable[[Path], None] | None = None
    """Writes a Rerun recording to the path it is given."""
