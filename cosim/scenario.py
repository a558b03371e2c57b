"""Scenario files: a schema, and mistakes told in one line each."""

import hashlib
import json
import math
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, PrivateAttr, ValidationError, field_validator, model_validator

from ..aircraft.mission import FlightPlan
from ..aircraft.phases import PHASE_NAMES
from ..align.bridging.outage import LEAST_OUTPUTS
from ..align.bridging.regression import Bridging
from ..align.filters import FILTERS
from ..align.methods import METHODS
from ..align.settings import FilterSettings
from ..network.ground import GroundSettings
from ..network.packet_faults import PacketFaults
from ..network.source import AnyFixSource, FixSource
from ..sins.earth import GravityModel
from ..sins.imu import ImuErrors
from ..sins.imu_faults import ImuFault
from ..sins.settings import Settings
from ..sins.text import printable
from .dotted import set_field
from .mistakes import told_mistakes
from .published import Paper
from .sizes import check_sizes
from .toml import read_named

SCENARIO_FOLDER = resources.files("fleetalign.scenarios")


class ScenarioError(ValueError):
    """A scenario that cannot be used; one line for each mistake."""


class CoarseAttitude(Settings):
    """Errors of the attitude that alignment starts from (Gao et al., Table 1)."""

    roll_error_deg: float = Field(default=1.0, ge=-30, le=30)
    pitch_error_deg: float = Field(default=1.0, ge=-30, le=30)
    heading_error_deg: float = Field(default=10.0, ge=-60, le=60)
    signs: Literal["random", "fixed"] = "random"
    """Whether each run draws the three signs."""
    unknown_heading: bool = False
    """Each run draws its heading from the whole circle, and errors of roll and pitch evenly up to those
    above."""


def _known(names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if name not in METHODS:
            raise ValueError(f"no filter {name!r}; known: {', '.join(METHODS)}")
    return tuple(dict.fromkeys(names))


FilterNames = Annotated[tuple[str, ...], AfterValidator(_known)]
"""Filters by their names, each once."""


class AlignmentSettings(Settings):
    """When to align, from what, and by which filters."""

    start: str | float = "s_maneuver"
    """Name of the phase at whose start alignment begins, or seconds from brake release."""
    duration_s: float = Field(default=40.0, ge=1, le=3600)
    coarse: CoarseAttitude = CoarseAttitude()
    gravity: Literal["flight", "j2", "somigliana"] = "flight"
    """Gravity model of the navigator; ``flight`` is the one that the aircraft flew in."""
    filters: FilterNames = tuple(FILTERS)
    bridging: Bridging = "coast"
    """What is put out for position and velocity in `outages`: the filter's own prediction, or that of an INS
    whose error a model has learnt from the record before."""
    settings: FilterSettings = FilterSettings()

    @field_validator("start", mode="before")
    @classmethod
    def _in_the_mission(cls, start: Any) -> str | float:
        if isinstance(start, str) and start in PHASE_NAMES:
            return start
        if isinstance(start, int | float) and not isinstance(start, bool) and 0 <= start < math.inf:
            return float(start)
        raise ValueError(f"neither seconds from brake release nor a phase: {', '.join(PHASE_NAMES)}")

    @field_validator("filters")
    @classmethod
    def _any(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if not names:
            raise ValueError(f"at least one of: {', '.join(METHODS)}")
        return names

    @model_validator(mode="after")
    def _heading_is_found_or_told(self) -> "AlignmentSettings":
        if self.coarse.unknown_heading and self.settings.coarse_stage == "none":
            raise ValueError(
                'coarse.unknown_heading = true: needs settings.coarse_stage = "in_motion": no filter starts'
                " from any heading"
            )
        return self

    def gravity_model(self, flown: GravityModel) -> GravityModel:
        """The navigator's gravity model, given the one that was flown in."""
        return flown if self.gravity == "flight" else GravityModel[self.gravity.upper()]


class Outage(Settings):
    """A time in which no valid fix is made."""

    start_s: float = Field(ge=0, le=3600)
    """From the start of the alignment."""
    duration_s: float = Field(ge=0.01, le=3600)

    @property
    def end_s(self) -> float:
        """From the start of the alignment."""
        return self.start_s + self.duration_s


class Faults(Settings):
    """What breaks during the alignment, beside outages. Times count from its start."""

    imu: tuple[ImuFault, ...] = Field(default=(), max_length=100)
    packets: PacketFaults = PacketFaults()


class Scenario(Settings):
    """All that a co-simulation depends on."""

    title: str
    source: str = ""
    runs: int = Field(default=100, ge=1, le=100_000)
    seed: int = Field(default=1, ge=0, le=2**63 - 1)
    flight: FlightPlan = FlightPlan()
    imu: ImuErrors = ImuErrors()
    fixes: AnyFixSource = FixSource()
    alignment: AlignmentSettings = AlignmentSettings()
    outages: tuple[Outage, ...] = Field(default=(), max_length=100)
    """Times without fixes, whatever their source."""
    faults: Faults = Faults()
    ground: GroundSettings | None = None
    """Nodes on the ground that `localize` locates by the aircraft."""
    variants: dict[str, dict[str, Any]] = Field(default={}, max_length=100)
    """Other values for some fields, by their dotted names, under a name for each set."""
    paper: Paper | None = None

    _folder: Path | None = PrivateAttr(None)
    """What the files that it names must be in, if it comes from a file."""

    def model_post_init(self, context: Any) -> None:
        """Keep the folder, for variants and other changes."""
        self._folder = (context or {}).get("folder")

    @model_validator(mode="after")
    def _alignment_inside_the_flight(self) -> "Scenario":
        # Earlier phases end when the aircraft is ready; only these starts are known before it flies.
        plan, alignment = self.flight, self.alignment
        s_end_s = plan.s_start_s + plan.s_maneuver.duration_s
        start_s = {"s_maneuver": plan.s_start_s, "tail": s_end_s}.get(str(alignment.start), alignment.start)
        if not isinstance(start_s, str) and start_s + alignment.duration_s > plan.end_s:
            raise ValueError(
                f"alignment from {start_s:g} s for {alignment.duration_s:g} s does not end before the flight,"
                f" at {plan.end_s:g} s"
            )
        return self

    @model_validator(mode="after")
    def _outages_fit(self) -> "Scenario":
        window_s, before = self.alignment.duration_s, 0.0
        least_s = LEAST_OUTPUTS / self.alignment.settings.output_rate_hz
        for number, outage in enumerate(self.outages):
            told = f"outages[{number}] from {outage.start_s:g} s for {outage.duration_s:g} s"
            if outage.end_s > window_s:
                raise ValueError(f"{told}: must end with the alignment, at {window_s:g} s, or before")
            if outage.start_s < before:
                raise ValueError(f"{told}: must not begin before the end of the one before it, {before:g} s")
            if self.alignment.bridging != "coast" and outage.start_s - before < least_s:
                raise ValueError(
                    f"{told}: bridging = {self.alignment.bridging!r} learns from {least_s:g} s or more"
                    f" before it; there are {outage.start_s - before:g} s"
                )
            before = outage.end_s
        return self

    @model_validator(mode="after")
    def _faults_fit(self) -> "Scenario":
        window_s = self.alignment.duration_s
        for number, fault in enumerate(self.faults.imu):
            told = f"faults.imu[{number}] from {fault.start_s:g} s for {fault.duration_s:g} s"
            if fault.end_s > window_s:
                raise ValueError(f"{told}: must end with the alignment, at {window_s:g} s, or before")
        if self.fixes.kind == "network":
            self.fixes.faults.check_begins(window_s)
        return self

    @model_validator(mode="after")
    def _ground_inside_the_flight(self) -> "Scenario":
        if self.ground and self.ground.end_s > self.flight.end_s:
            raise ValueError(
                f"ground.start_s = {self.ground.start_s:g} s: with duration_s = {self.ground.duration_s:g} s"
                f" does not end before the flight, at {self.flight.end_s:g} s"
            )
        return self

    @model_validator(mode="after")
    def _fits_into_memory(self) -> "Scenario":
        check_sizes(self.alignment.duration_s, self.alignment.settings.output_rate_hz, self.fixes)
        return self

    @model_validator(mode="after")
    def _variants_are_scenarios(self) -> "Scenario":
        for name in self.variants:
            self.variant(name)
        return self

    def variant(self, name: str) -> "Scenario":
        """One of the variants, which has none itself. Raises `ScenarioError`, KeyError."""
        return replaced(self, {**self.variants[name], "variants": {}}, origin=f"variant {name!r}")

    @property
    def digest(self) -> str:
        """SHA-256 of the whole content, defaults included; a file that it names counts by what it holds."""
        content = self.model_dump(mode="json")
        for table in data_tables(content):
            table["file"] = hashlib.sha256(Path(table["file"]).read_bytes()).hexdigest()
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def data_tables(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The tables in a scenario's content that name a ``file``."""
    fixes = content.get("fixes", {})
    return [table for table in (fixes, fixes.get("delay", {})) if "file" in table]


def scenario_names() -> list[str]:
    """Names of the bundled scenarios."""
    return sorted(f.name.removesuffix(".toml") for f in SCENARIO_FOLDER.iterdir() if f.name.endswith(".toml"))


ReadScenario = tuple[str, dict[str, Any], Path | None]


def read_scenario(name_or_path: str) -> ReadScenario:
    """Name of a bundled scenario or of a TOML file, what it says, unchecked, and the folder that the file
    stands in.

    Raises `ScenarioError` for what cannot be read as TOML.
    """
    try:
        path, content = read_named(name_or_path, "scenario", Path(str(SCENARIO_FOLDER)), scenario_names())
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    return path.stem, content, None if name_or_path in scenario_names() else path.parent


def load_scenario(name_or_path: str, read: ReadScenario | None = None) -> tuple[str, Scenario]:
    """Name and content of a bundled scenario or of a TOML file; files it names are in its folder.

    ``read`` : what `read_scenario` has made of it, if that was called before.

    Raises `ScenarioError`, with one line for each mistake: file, field, value, unit, what is allowed.
    """
    name, content, folder = read or read_scenario(name_or_path)
    if is_paper(content):
        raise ScenarioError(f"{name_or_path}: experiment: a paper's own, which flies nothing")
    return name, _validated(printable(name_or_path), content, {"folder": folder})


def is_paper(content: dict[str, Any]) -> bool:
    """Whether a scenario is the experiment of a companion paper (`papers.scenario`)."""
    return "experiment" in content


def replaced(scenario: Scenario, changes: dict[str, Any], origin: str = "change") -> Scenario:
    """The scenario with other values for fields given by their dotted names, e.g. ``"imu.vibration_mps"``
    or ``"outages.0.start_s"``.

    Raises `ScenarioError` like `load_scenario`; ``origin`` stands in the place of the file.
    """
    content = scenario.model_dump(mode="json")
    if scenario._folder:
        # As the file had them: what is changed is held to the same rule as what it said.
        for table in data_tables(content):
            table["file"] = str(Path(table["file"]).relative_to(scenario._folder.resolve()))
    for name, value in changes.items():
        try:
            set_field(content, name, value)
        except ValueError as error:
            raise ScenarioError(f"{origin}: {error}") from error
    return _validated(origin, content, {"folder": scenario._folder})


def _validated(file: str, content: dict[str, Any], context: dict[str, Any]) -> Scenario:
    try:
        return Scenario.model_validate(content, context=context)
    except ValidationError as error:
        raise ScenarioError(told_mistakes(file, error, Scenario, "scenario")) from error
