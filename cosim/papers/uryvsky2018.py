from typing import Literal

from ...sins.settings import Settings
from .results import Progress, Results


class RepeatedRanging(Settings):
    kind: Literal["repeated_ranging"]


def study(settings: RepeatedRanging, draws: int, seed: int, progress: Progress | None = None) -> Results:
    return Results((), (), ())
