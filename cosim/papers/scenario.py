"""Scenarios of the companion papers: which experiment, with what parameters, over how many draws."""

from typing import Annotated, Any

from pydantic import Field, ValidationError

from ...sins.settings import Settings
from ..mistakes import told_mistakes
from ..scenario import ScenarioError
from . import uryvsky2018, wan2008, xu2012, xu2019
from .results import Progress, Results

AnyExperiment = Annotated[
    uryvsky2018.RepeatedRanging | xu2012.InsWsn | xu2019.MovingAnchor | wan2008.Refinement,
    Field(discriminator="kind"),
]


class PaperScenario(Settings):
    """A companion paper's experiment."""

    title: str
    source: str
    draws: int = Field(default=200, ge=1, le=1_000_000)
    seed: int = Field(default=1, ge=0, le=2**63 - 1)
    experiment: AnyExperiment


_STUDIES = {
    uryvsky2018.RepeatedRanging: uryvsky2018.study,
    xu2012.InsWsn: xu2012.study,
    xu2019.MovingAnchor: xu2019.study,
    wan2008.Refinement: wan2008.study,
}
ON_THE_RUN = (xu2012.InsWsn,)
"""Experiments of the command `run`; the others are of `localize`."""


def validated(origin: str, content: dict[str, Any]) -> PaperScenario:
    """The scenario of a file's content. Raises `ScenarioError`, one line for each mistake."""
    try:
        return PaperScenario.model_validate(content)
    except ValidationError as error:
        raise ScenarioError(told_mistakes(origin, error, PaperScenario, "scenario")) from error


def run_experiment(scenario: PaperScenario, progress: Progress | None = None) -> Results:
    """Run it. The same scenario gives the same results, whatever the cores.

    Raises `network.localization.problem.LocalizationError` for networks that cannot be located at all.
    """
    experiment = scenario.experiment
    return _STUDIES[type(experiment)](experiment, scenario.draws, scenario.seed, progress)
