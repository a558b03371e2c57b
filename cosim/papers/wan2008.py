from typing import Literal

from ...sins.settings import Settings
from .results import Progress, Results


class Refinement(Settings):
    kind: Literal["refinement"]


def study(settings: Refinement, draws: int, seed: int, progress: Progress | None = None) -> Results:
    return Results((), (), ())
