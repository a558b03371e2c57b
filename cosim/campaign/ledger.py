"""What is done of a campaign, in a folder: one Parquet file a shard, there whole or not at all."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ..files import whole_file
from ..scenario import ScenarioError
from .plan import Campaign, Shard
from .shard import SCHEMA

_PLAN = "campaign.json"


class Ledger:
    """The finished shards of one campaign.

    Parameters
    ----------
    folder : made if need be; ``campaign.json`` says whose shards are in it.
    resume : whether shards that are there already count. Without, a folder with shards is refused.

    Raises `ScenarioError` for a folder of another campaign, or one with shards and no ``resume``; OSError.
    """

    def __init__(self, folder: Path, campaign: Campaign, resume: bool) -> None:
        self.folder, self._shards = folder, folder / "shards"
        plan = folder / _PLAN
        if plan.is_file():
            kept = read_plan(folder)
            if kept.get("digest") != campaign.digest:
                raise ScenarioError(
                    f"{folder}: holds another campaign, {kept.get('title')!r}; take another --out"
                )
        self._shards.mkdir(parents=True, exist_ok=True)
        for partial in self._shards.glob("*.partial"):
            partial.unlink()
        found = {path.name for path in self._shards.glob("*.parquet")}
        if found and not resume:
            raise ScenarioError(f"{folder}: has {len(found)} finished shards; go on with --resume")
        if not plan.is_file():
            content = {
                "title": campaign.settings.title,
                "digest": campaign.digest,
                "settings": campaign.settings.model_dump(mode="json"),
                "base": campaign.base.model_dump(mode="json"),
                "coordinates": list(campaign.coordinates),
            }
            _write(plan, json.dumps(content, indent=2).encode())
        self.done = {shard for shard in campaign.shards if shard.name in found and self._sound(shard)}
        """Shards that need not be done again."""

    def _sound(self, shard: Shard) -> bool:
        """Whether a shard's file has all its runs; one that has not, say after a disk failed, is dropped."""
        path = self._shards / shard.name
        try:
            rows = pq.read_table(path, columns=["point", "run"])
        except (OSError, pa.ArrowInvalid):
            path.unlink()
            return False
        runs = set(rows["run"].to_pylist())
        whole = set(range(shard.first_run, shard.first_run + shard.runs))
        if runs != whole or set(rows["point"].to_pylist()) != {shard.point}:
            path.unlink()
            return False
        return True

    def add(self, shard: Shard, content: bytes) -> None:
        """Keep a shard; after this returns, no crash takes it away. Raises OSError, and keeps nothing."""
        _write(self._shards / shard.name, content)
        self.done.add(shard)


def read_plan(folder: Path) -> dict[str, Any]:
    """Content of a campaign's folder's plan. Raises `ScenarioError`."""
    try:
        content = json.loads((folder / _PLAN).read_text("utf-8"))
    except OSError as error:
        raise ScenarioError(f"{folder}: no campaign is kept there") from error
    except ValueError as error:
        raise ScenarioError(f"{folder / _PLAN}: damaged: {error}") from error
    return content


def read_points(folder: Path) -> Iterator[tuple[int, pa.Table]]:  # pyright: ignore[reportUnknownParameterType]
    """The rows of each point that has any, in order; one point at a time, whatever the campaign's size."""
    by_point: dict[int, list[Path]] = {}
    for path in sorted((folder / "shards").glob("*.parquet")):
        by_point.setdefault(int(path.name[1:7]), []).append(path)
    for point, paths in by_point.items():
        yield point, pa.concat_tables([pq.read_table(path, schema=SCHEMA) for path in paths])


def _write(path: Path, content: bytes) -> None:
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    # The name is in the folder, and the folder too has to reach the disk.
    handle = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
