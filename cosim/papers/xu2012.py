from typing import Literal

from ...sins.settings import Settings
from .results import Progress, Results


class InsWsn(Settings):
    kind: Literal["ins_wsn"]


def study(settings: InsWsn, draws: int, seed: int, progress: Progress | None = None) -> Results:
    return Results((), (), ())
