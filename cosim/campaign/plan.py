"""Campaign files: a base scenario, axes along which its settings vary, and the runs at each point."""

import hashlib
import json
import math
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import metadata
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from ...network.tables import inside
from ...sins.settings import Settings
from ...sins.sources import sources_digest
from ...sins.text import printable, shortened
from ..mistakes import told_mistakes
from ..scenario import FilterNames, Scenario, ScenarioError, load_scenario, replaced, scenario_names
from ..toml import read_toml

MOST_POINTS = 100_000
MOST_SHARD_RUNS = 10_000
MOST_SHARDS = 200_000
_CODE = (
    *(f"{room}/**/*.py" for room in ("sins", "aircraft", "network", "align", "cosim")),
    "aircraft/**/*.toml",
)
"""Files that make a run what it is, and some others: which of them do is not told apart."""


class Values(Settings):
    """An axis of stated values."""

    kind: Literal["values"] = "values"
    values: Annotated[tuple[float | int | bool | str, ...], Field(min_length=1, max_length=10_000)]


class Range(Settings):
    """An axis from one end to the other: ``steps`` even values on a grid, or all of it for a hypercube."""

    kind: Literal["range"] = "range"
    low: float
    high: float
    steps: int = Field(default=5, ge=2, le=10_000)
    log: bool = False
    """Whether even means even ratios."""
    integer: bool = False
    """Whether values are whole numbers, as a field of these wants."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low = {self.low:g}: must be below high = {self.high:g}")
        if self.log and self.low <= 0:
            raise ValueError(f"low = {self.low:g}: must be above 0 where log = true")
        if self.integer and not (self.low.is_integer() and self.high.is_integer()):
            raise ValueError(f"low = {self.low:g}, high = {self.high:g}: must be whole where integer = true")
        return self

    def at(self, share: float) -> float | int:
        """The value at a share of the way, 0 to 1."""
        value = self._on_the_way_to(self.high, share)
        return round(value) if self.integer else value

    def drawn(self, share: float) -> float | int:
        """The value for a share that is drawn evenly. A whole number stands for all up to the next: rounded,
        the ends would have half of what others have."""
        if not self.integer:
            return self.at(share)
        return min(math.floor(self._on_the_way_to(self.high + 1, share)), int(self.high))

    def _on_the_way_to(self, high: float, share: float) -> float:
        if self.log:
            return self.low * (high / self.low) ** share
        return self.low + share * (high - self.low)


Axis = Annotated[Values | Range, Field(discriminator="kind")]


class CampaignFile(Settings):
    """Content of a campaign's TOML file."""

    title: str
    scenario: str
    """Bundled name, or a TOML file beside this one."""
    runs: int = Field(default=100, ge=1, le=1_000_000)
    """At each point."""
    seed: int = Field(default=1, ge=0, le=2**63 - 1)
    """Of all points: the runs of one id have the same sensors and noise at each."""
    filters: FilterNames = ()
    """The scenario's, if none."""
    shard_runs: int = Field(default=25, ge=1, le=MOST_SHARD_RUNS)
    """Runs that are done, and kept, together."""
    design: Literal["grid", "latin_hypercube"] = "grid"
    points: int = Field(default=50, ge=1, le=MOST_POINTS)
    """Of a Latin hypercube."""
    axes: Annotated[dict[str, Axis], Field(max_length=20)] = Field(default={})
    """By the dotted name of a scenario's field."""

    @model_validator(mode="after")
    def _small_enough(self) -> Self:
        if self.design == "grid":
            sizes = [len(a.values) if isinstance(a, Values) else a.steps for a in self.axes.values()]
            points = int(np.prod(sizes, dtype=object)) if sizes else 1
            if points > MOST_POINTS:
                raise ValueError(f"the grid has {points} points: allowed are {MOST_POINTS}")
        else:
            points = self.points
        shards = points * -(-self.runs // self.shard_runs)
        if shards > MOST_SHARDS:
            raise ValueError(
                f"runs = {self.runs} at {points} points, shard_runs = {self.shard_runs}: {shards} shards;"
                f" allowed are {MOST_SHARDS}"
            )
        return self

    @field_validator("axes")
    @classmethod
    def _no_files(cls, axes: dict[str, Axis]) -> dict[str, Axis]:
        for name in axes:
            if not all(name.split(".")):
                raise ValueError(f"{shortened(printable(name))!r}: no field's dotted name")
            if name in ("runs", "seed", "title", "variants"):
                raise ValueError(f"{name}: no axis, but the same at all points")
            if name.rpartition(".")[2] == "file":
                raise ValueError(f"{name}: a file is no axis; make a campaign of each")
        return axes


@cache
def versions() -> dict[str, str]:
    """Of this process's Python, and of the programs by which the last bits of a run may differ; fleetalign's
    with the first digits of a digest of its code."""
    programs = ("jsbsim", "numba", "numpy", "scipy")
    found = {"python": platform.python_version()} | {name: metadata.version(name) for name in programs}
    return {"fleetalign": f"{metadata.version('fleetalign')}+{sources_digest(*_CODE)[:16]}"} | found


@dataclass(frozen=True)
class Shard:
    """Some runs of one point."""

    point: int
    first_run: int
    runs: int

    @property
    def name(self) -> str:
        """Of its file, sorted as the runs are."""
        return f"p{self.point:06d}_r{self.first_run:07d}.parquet"


@dataclass(frozen=True)
class Campaign:
    """A campaign that can be run: all of its points are scenarios."""

    settings: CampaignFile
    base: Scenario
    coordinates: tuple[dict[str, Any], ...]
    """Of each point, the value of each axis."""

    def scenario(self, point: int) -> Scenario:
        """The scenario at a point, kept at hand for the point's next shards. Raises `ScenarioError`."""
        if point not in self._at_hand:
            self._at_hand.clear()
            self._at_hand[point] = self._scenario(point)
        return self._at_hand[point]

    @cached_property
    def _at_hand(self) -> dict[int, Scenario]:
        return {}

    def _scenario(self, point: int) -> Scenario:
        changes: dict[str, Any] = {"variants": {}, "seed": self.settings.seed}
        if self.settings.filters:
            changes["alignment.filters"] = list(self.settings.filters)
        return replaced(self.base, changes | self.coordinates[point], origin=f"point {point}")

    @property
    def shards(self) -> list[Shard]:
        """All of them, in order."""
        runs, size = self.settings.runs, self.settings.shard_runs
        return [
            Shard(point, first, min(size, runs - first))
            for point in range(len(self.coordinates))
            for first in range(0, runs, size)
        ]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that its results depend on, the programs' versions among it."""
        content: dict[str, Any] = {"base": self.base.digest, "coordinates": self.coordinates}
        content["versions"] = versions()
        content |= self.settings.model_dump(mode="json", exclude={"title"})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def load_campaign(path: Path, progress: Callable[[float, float], None] | None = None) -> Campaign:
    """The campaign of a TOML file. Raises `ScenarioError`, one line for each mistake.

    ``progress`` is called with the points that are checked and all: each takes about a millisecond.
    """
    told = printable(str(path))
    try:
        content = read_toml(path, told)
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    for axis in content.get("axes", {}).values() if isinstance(content.get("axes"), dict) else ():
        # What an axis is shows in its fields; a file need not say it.
        if isinstance(axis, dict) and "kind" not in axis:
            axis["kind"] = "values" if "values" in axis else "range"
    try:
        settings = CampaignFile.model_validate(content)
    except ValidationError as error:
        raise ScenarioError(told_mistakes(told, error, CampaignFile, "campaign")) from error
    base = _base(path, settings.scenario)
    campaign = Campaign(settings, base, tuple(_points(settings)))
    count = len(campaign.coordinates)
    telling = _telling(settings, campaign.coordinates)
    for checked, point in enumerate(dict.fromkeys((*telling, *range(count)))):
        if progress:
            progress(checked, count)
        try:
            campaign.scenario(point)
        except ScenarioError as error:
            where = ", ".join(f"{name} = {value}" for name, value in campaign.coordinates[point].items())
            first = str(error).splitlines()[0].removeprefix(f"point {point}: ")
            at = f"axes: at {shortened(printable(where), 200)}: " if where else ""
            raise ScenarioError(f"{told}: {at}{first}") from error
    return campaign


def _base(path: Path, name: str) -> Scenario:
    """The scenario beside the campaign's file, or the bundled one, of that name."""
    try:
        beside = inside(path.parent, name)
        bundled = not beside.is_file() and name in scenario_names()
        if not (bundled or beside.is_file()):
            meant = f"; {name}.toml is" if inside(path.parent, f"{name}.toml").is_file() else ""
            raise ValueError(
                f"neither a bundled scenario ({', '.join(scenario_names())}) nor a file beside it{meant}"
            )
    except ValueError as error:
        told = f"{printable(str(path))}: scenario = {shortened(repr(name))}: {error}"
        raise ScenarioError(told) from error
    return load_scenario(name if bundled else str(beside))[1]


def _points(settings: CampaignFile) -> list[dict[str, Any]]:
    names, axes = list(settings.axes), list(settings.axes.values())
    if settings.design == "grid" or not names:
        grids = [
            list(axis.values)
            if isinstance(axis, Values)
            # Neighbours that round to the same number are one.
            else list(dict.fromkeys(axis.at(i / (axis.steps - 1)) for i in range(axis.steps)))
            for axis in axes
        ]
        return [dict(zip(names, values, strict=True)) for values in product(*grids)]
    # Drawn from the seed alone, so that the same file is the same campaign.
    from scipy.stats import qmc  # takes half a second to import

    cube = qmc.LatinHypercube(d=len(names), rng=np.random.default_rng(settings.seed)).random(settings.points)
    return [
        {name: _on(axis, float(share)) for name, axis, share in zip(names, axes, row, strict=True)}
        for row in cube
    ]


def _telling(settings: CampaignFile, coordinates: Sequence[dict[str, Any]]) -> list[int]:
    """Points at which a mistake shows soonest: the first and the last, both ends of each range, and the first
    point of each value, on a grid the one beside the first values of the other axes."""
    ends, first = list[int](), dict[tuple[str, type, Any], int]()
    for name, axis in settings.axes.items():
        values = [point[name] for point in coordinates]
        if isinstance(axis, Range):
            ends += values.index(min(values)), values.index(max(values))
        for number, value in enumerate(values):
            first.setdefault((name, type(value), value), number)  # the type, too: true is not 1
    return [0, len(coordinates) - 1, *ends, *first.values()]


def _on(axis: Values | Range, share: float) -> Any:
    """The value at a share of an axis; stated values have equal shares, and so have whole numbers."""
    if isinstance(axis, Range):
        return axis.drawn(share)
    return axis.values[min(int(share * len(axis.values)), len(axis.values) - 1)]
