from typing import Literal

from ...sins.settings import Settings
from .results import Progress, Results


class MovingAnchor(Settings):
    kind: Literal["moving_anchor"]


def study(settings: MovingAnchor, draws: int, seed: int, progress: Progress | None = None) -> Results:
    return Results((), (), ())
