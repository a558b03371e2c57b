"""What is done of a campaign, in a folder: one Parquet file a shard, there whole or not at all."""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError, model_validator

from ...align.methods import METHODS
from ...sins.settings import Settings
from ...sins.text import printable, shortened
from ..files import whole_file
from ..mistakes import told_mistakes
from ..scenario import Scenario, ScenarioError
from ..scenario_file import with_data_in
from ..toml import check_content
from .lock import locked
from .plan import MOST_SHARD_RUNS, Campaign, CampaignFile, Shard
from .shard import SCHEMA, is_whole

POINTS = "points"
"""Folder of the worst runs' scenarios, and of the data that these name."""
_PLAN = "campaign.json"
_SHARDS = "shards"
_MOST_BYTES = 200_000_000
"""Of a plan with as many points as there may be, or of a shard with as many rows."""
_HISTORIES = "history_time_s", "level_history_arcsec", "heading_history_arcmin"


class Ledger:
    """The finished shards of one campaign.

    Parameters
    ----------
    folder : made if need be; ``campaign.json`` says whose shards are in it.
    resume : whether shards that are there already count. Without, a folder with shards is refused.

    While it is open, a context that ends with `close`, no other process works in the folder (`lock`). Raises
    `ScenarioError` for a folder in which one does, one of another campaign, or one with shards and no
    ``resume``; OSError.
    """

    def __init__(self, folder: Path, campaign: Campaign, resume: bool) -> None:
        self.folder, self._shards = folder, folder / _SHARDS
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = locked(folder)
        try:
            self.done = self._opened(campaign, resume)
        except BaseException:
            self.close()
            raise

    def _opened(self, campaign: Campaign, resume: bool) -> set[Shard]:
        """The shards that need not be done again."""
        plan = self.folder / _PLAN
        _refuse_links(self.folder)
        if plan.is_file():
            kept = read_plan(self.folder)
            if kept.get("digest") != campaign.digest:
                raise ScenarioError(
                    f"{self.folder}: holds another campaign, or one of other versions or code,"
                    f" {kept.get('title')!r}; take another --out"
                )
        self._shards.mkdir(parents=True, exist_ok=True)
        for partial in self._shards.glob("*.partial"):
            partial.unlink()
        found = {path.name for path in self._shards.glob("*.parquet")}
        if found and not resume:
            raise ScenarioError(f"{self.folder}: has {len(found)} finished shards; go on with --resume")
        if not plan.is_file():
            if found:
                raise ScenarioError(f"{self.folder}: has {len(found)} shards and no {_PLAN} that says whose")
            base = campaign.base.model_dump(mode="json") | {"variants": {}}
            (self.folder / POINTS).mkdir(exist_ok=True)
            with_data_in(self.folder / POINTS, base)
            content = {
                "title": campaign.settings.title,
                "digest": campaign.digest,
                "settings": campaign.settings.model_dump(mode="json"),
                "base": base,
                "coordinates": list(campaign.coordinates),
            }
            content["content_sha256"] = content_digest(content)
            _write(plan, json.dumps(content, indent=2).encode())
        return {shard for shard in campaign.shards if shard.name in found and self._sound(shard)}

    def close(self) -> None:
        """Let others work in the folder."""
        self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _sound(self, shard: Shard) -> bool:
        """Whether a shard's file has all its runs; one that has not, say after a disk failed, is dropped."""
        path = self._shards / shard.name
        try:
            rows = _rows(path, shard.point)
        except ScenarioError:
            path.unlink()
            return False
        runs = set(rows["run"].to_pylist())
        whole = set(range(shard.first_run, shard.first_run + shard.runs))
        if runs != whole:
            path.unlink()
            return False
        return True

    def add(self, shard: Shard, content: bytes) -> None:
        """Keep a shard; after this returns, no crash takes it away. Raises OSError, and keeps nothing."""
        _write(self._shards / shard.name, content)
        self.done.add(shard)


class _Plan(Settings):
    """Content of a plan; its data are beside the points' scenarios."""

    title: str
    digest: str
    settings: CampaignFile
    base: Scenario
    coordinates: tuple[dict[str, float | int | bool | str], ...]
    content_sha256: str

    @model_validator(mode="after")
    def _points_on_the_axes(self) -> Self:
        for number, point in enumerate(self.coordinates):
            if point.keys() != self.settings.axes.keys():
                raise ValueError(f"coordinates[{number}]: must have a value of each of settings.axes")
        return self


def content_digest(content: dict[str, Any]) -> str:
    """SHA-256 of all that a plan says but that itself."""
    said = {key: value for key, value in content.items() if key != "content_sha256"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def read_plan(folder: Path) -> dict[str, Any]:
    """Content of a campaign's folder's plan. Raises `ScenarioError`."""
    _refuse_links(folder)
    path = folder / _PLAN
    told = printable(str(path))
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise ScenarioError(f"{printable(str(folder))}: no campaign is kept there") from error
    try:
        if len(text) > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES} bytes")
        content = json.loads(text)
        if not isinstance(content, dict):
            raise ValueError("no table")
        check_content(content)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{told}: damaged: {shortened(printable(str(error)), 200)}") from error
    try:
        plan = _Plan.model_validate(content, context={"folder": folder / POINTS})
    except ValidationError as error:
        raise ScenarioError(told_mistakes(told, error, _Plan, "plan")) from error
    if plan.content_sha256 != content_digest(content):
        raise ScenarioError(f"{told}: not as it was written: its content is not that of its content_sha256")
    return content | {"settings": plan.settings.model_dump(mode="json")}


def _refuse_links(folder: Path) -> None:
    """What a campaign's folder links to is not its own, to be read or written over."""
    for name in (_PLAN, _SHARDS, POINTS):
        if (folder / name).is_symlink():
            raise ScenarioError(f"{printable(str(folder / name))}: a link: must be the folder's own")


def kept_base(folder: Path, plan: dict[str, Any]) -> Scenario:
    """The base scenario of a plan that was read, on the folder's own copies of its data."""
    return Scenario.model_validate(plan["base"], context={"folder": folder / POINTS})


def read_points(folder: Path) -> Iterator[tuple[int, pa.Table]]:  # pyright: ignore[reportUnknownParameterType]
    """Each shard's point and rows, in order of points and runs; one shard at a time, whatever their number.

    Raises `ScenarioError` for a file that is no whole shard.
    """
    paths = sorted((folder / _SHARDS).glob("*.parquet"))
    for point, path in zip(list(map(_point, paths)), paths, strict=True):
        yield point, _rows(path, point)


def _point(path: Path) -> int:
    found = re.fullmatch(r"p([0-9]{6})_r[0-9]{7}\.parquet", path.name)
    if not found:
        raise _damaged(path, "not the name of a shard")
    return int(found[1])


def _rows(path: Path, point: int) -> pa.Table:  # pyright: ignore[reportUnknownParameterType]
    try:
        if path.is_symlink():
            raise _damaged(path, "a link")
        if path.stat().st_size > _MOST_BYTES:
            raise _damaged(path, f"more than {_MOST_BYTES} bytes")
        content = path.read_bytes()
        if not is_whole(content):
            raise _damaged(path, "not what was written")
        kept = pq.ParquetFile(pa.BufferReader(content))
        if not kept.schema_arrow.equals(SCHEMA):
            raise _damaged(path, "other columns than a shard's")
        if kept.metadata.num_rows > MOST_SHARD_RUNS * len(METHODS):
            raise _damaged(path, "more rows than a shard's")
        table = kept.read()
        table.validate(full=True)
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise _damaged(path, " ".join(str(error).split())) from error
    if table["point"].unique().to_pylist() != [point]:
        raise _damaged(path, f"rows of another point than {point}")
    if table["run"].null_count or not set(table["filter"].to_pylist()) <= METHODS.keys():
        raise _damaged(path, "a row without its run, or of no filter")
    lists = [table[name].combine_chunks() for name in _HISTORIES]
    lengths = {n for column in lists for n in column.value_lengths().drop_null().to_pylist()}
    if len(lengths) > 1:
        raise _damaged(path, "histories of several lengths")
    return table


def _damaged(path: Path, why: str) -> ScenarioError:
    told = f"{printable(str(path))}: damaged: {shortened(printable(why), 200)}"
    return ScenarioError(f"{told}; fleetalign campaign ... --resume does it again")


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
