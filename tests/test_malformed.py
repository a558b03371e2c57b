"""Malformed input: whatever a file holds, it is used, or refused in a line, soon, and leaves nothing."""

import contextlib
import copy
import functools
import io
import json
import random
import shutil
import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer
from fleetalign.cosim import cli
from fleetalign.cosim.campaign.ledger import Ledger, content_digest
from fleetalign.cosim.campaign.plan import load_campaign
from fleetalign.cosim.campaign.shard import encoded, sealed
from fleetalign.cosim.scenario import SCENARIO_FOLDER, scenario_names
from fleetalign.network.fixes import Fixes, write_fixes
from fleetalign.network.tables import write_columns
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

MUTATIONS = settings(
    max_examples=500,
    derandomize=True,
    database=None,
    deadline=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
FEWER = settings(MUTATIONS, max_examples=150)
LONGEST_S = 1.0
WORDS_OF_LIBRARIES = (
    "Traceback",
    "Input should",
    "pydantic",
    "Arrow",
    "numpy",
    "object at 0x",
    "Posix",
    "<class",
)


class Begun(BaseException):
    """The input is good, and the work begins."""


def begin(*_, **__):
    raise Begun


WORK = (
    "aircraft.cache.cached_flight",
    "cosim.run.compiling_ahead",
    "cosim.papers.command.run_experiment",
    "align.maneuver.best_maneuver",
    "align.lmi.design.design",
    "cosim.campaign.engine.run_campaign",
    "cosim.campaign.report.draw_campaign",
    "cosim.replay._aligned",
)


@pytest.fixture(scope="module", autouse=True)
def without_the_work():
    """No mutation that leaves a file good starts what it asks for."""
    with contextlib.ExitStack() as stack:
        for name in WORK:
            stack.enter_context(mock.patch(f"fleetalign.{name}", begin))
        # The tree of commands is half of what a refusal costs.
        built = functools.cache(typer.main.get_command)
        stack.enter_context(mock.patch("typer.main.get_command", built))
        ask("check", "gao2009")  # what is imported and compiled at the start counts for no mutation
        ask("check", "wan2008")
        yield


@dataclass
class Answer:
    status: int | str | None
    out: str
    err: str
    seconds: float


def ask(*arguments) -> Answer:
    """Run the command line in this process; status 0 where its work would begin. What takes too long is asked
    once more: other work on a core slows all that is on it."""
    answer = asked(*arguments)
    return answer if answer.seconds < LONGEST_S else asked(*arguments)


def asked(*arguments) -> Answer:
    out, err, status = io.StringIO(), io.StringIO(), 0
    begun = time.process_time()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", ["fleetalign", *map(str, arguments)]),
    ):
        try:
            cli.main()
        except SystemExit as end:
            status = end.code
        except Begun:
            pass
    return Answer(status, out.getvalue(), err.getvalue(), time.process_time() - begun)


def judge(answer: Answer, files: tuple[Path, ...], out: Path) -> str:
    """What was told of a refusal, "" if there was none; either is as it must be."""
    assert answer.seconds < LONGEST_S, answer
    assert answer.status in (0, 2), answer
    if answer.status == 0:
        shutil.rmtree(out, ignore_errors=True)
        return ""
    assert answer.out == ""
    assert not out.exists()
    lines = answer.err.removesuffix("\n").split("\n")
    assert 1 <= len(lines) <= 21
    assert len(set(lines)) == len(lines)
    for line in lines:
        assert line.startswith("fleetalign: ")
        assert line.isprintable()
        assert len(line) <= 1000
        assert any(str(file) in line for file in files) or "option" in line or "--initial" in line
        assert not any(word in line for word in WORDS_OF_LIBRARIES), line
    return answer.err


class Raw(str):
    """Text that stands in a TOML file as it is."""


DEEP = Raw("[" * 3000 + "]" * 3000)
LIGHT = [
    *(-1, 0, 1, 3, 1e308, -1e308, 5e-324, -0.0, 0.5, float("nan"), float("inf"), -float("inf")),
    *(2**63 - 1, 2**63, -(2**70), 10**400, Raw("0x" + "f" * 6000), Raw("9" * 5000), True, False),
    *("", "text", "0.5", "nan", "é\u00a0", "\x1b[2J\x07", "a\x00b", "a\u2028b\u202ec", "\n\n"),
    *("/etc/passwd", "../../../../etc/passwd", "..", "~", "no.csv", "gao2009", "replay", "network", "{}%s"),
    *([], {}, [[]], [{}], [1, 2, 3], ["a"], {"kind": "replay", "file": "/etc/passwd"}, {"kind": 3}),
    *(Raw("1979-05-27"), Raw("1979-05-27T07:32:00Z"), Raw("07:32:00"), Raw("1e400")),
    *(DEEP, Raw("[" * 900 + "]" * 900), Raw("[" * 40 + "]" * 40)),
    *(Raw("{ " + ".".join("a" * 5000) + " = 1 }"), Raw("{ " + ".".join("a" * 40) + " = 1 }")),
]
HEAVY = [
    *("x" * 950_000, [0.5] * 100_000, ["y"] * 40_000, [{}] * 10_000, [-1] * 10_000),
    {f"k{i}": i for i in range(10_000)},
]


def odd_value(rng: random.Random):
    return copy.deepcopy(rng.choice(HEAVY if rng.random() < 0.03 else LIGHT))


NAMES = [
    "unknown",
    "",
    "é",
    "a.b",
    "\x1b]0;x\x07",
    "n" * 100_000,
    "kind",
    "file",
    "title",
    "seed",
    "__class__",
]


def toml(value) -> str:
    """A value as TOML, all in one line."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    if isinstance(value, int) and abs(value) > 10**300:
        return f"1{'0' * 400}"
    return repr(value)


def nodes(table, where=()):
    """Places of all entries of a content."""
    for key, value in table.items() if isinstance(table, dict) else enumerate(table):
        yield (*where, key)
        if isinstance(value, dict | list):
            yield from nodes(value, (*where, key))


def is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def must_be_refused(before, after) -> bool:
    """Whether no field that held the one takes the other: another type, or a number that no field takes."""
    if isinstance(after, Raw):
        return True
    if is_number(after) and not abs(after) < 1e300:
        return True
    if is_number(before):
        return not is_number(after) or not -(2**63) <= after < 2**63
    if isinstance(before, bool):  # 0 and 1, "yes" and "no" are taken for truth values
        return not isinstance(after, bool | int | float | str)
    if isinstance(before, str):  # the start of an alignment is a phase or a time
        return not isinstance(after, str) and not is_number(after)
    return type(before) is not type(after)


FREE = ("variants", "axes")
"""Tables whose keys are the user's."""


@dataclass
class Mutant:
    content: dict
    places: list
    """Where it differs."""
    wrong: bool
    """Whether it must be refused."""

    def judge(self, told: str, file: Path) -> None:
        """It is refused where it must be, and each line names a field that differs, or one near it."""
        assert told or not self.wrong, self.places
        for line in told.splitlines():
            _, named, line = line.partition(str(file))
            if named and not any(words in line for words in OF_THE_WHOLE):
                assert any(self._named(place, line) for place in self.places), (line, self.places)

    @staticmethod
    def _named(place, line) -> bool:
        """By its own name or that of a table that it is in; an entry of a list by the list's. What says of
        which kind a table is makes its other fields unknown."""
        if place[-1] in ("kind", "experiment"):
            return True
        names = [part for key in place if isinstance(key, str) for part in [*key.split("."), key]]
        return (
            any(name[:40] in line for name in names if name)
            or (place[-1] == "" and "unknown field" in line)
            or (place[0] == "variants" and "variant '" in line)
        )


OF_THE_WHOLE = (
    "not TOML",
    "too long",
    "entries",
    "nested more",
    "control character",
    "beyond 64 bits",
    "more m",
    "a paper's own",
    "run it by",
    "there is no network",
)
"""Of what no schema has seen, what there is no room for, and what another command is for."""


def mutant(rng: random.Random, content) -> Mutant:
    """A content with one to three entries that are others, gone, unknown or nested wrongly; and where."""
    content, places, wrong = copy.deepcopy(content), [], False
    for place in rng.sample(sorted(nodes(content), key=str), rng.randint(1, 3)):
        table = content
        try:
            for part in place[:-1]:
                table = table[part]
            table[place[-1]]
        except (KeyError, IndexError, TypeError):  # an earlier mutation took it away
            continue
        if not isinstance(table, dict | list):
            continue
        key, before = place[-1], table[place[-1]]
        free = place[0] in FREE and len(place) < 3
        match rng.choice(["other"] * 5 + ["gone", "unknown", "list", "table"]):
            case "gone":
                del table[key]
            case "unknown" if isinstance(table, dict):
                key = rng.choice(NAMES)
                table[key] = odd_value(rng)
                wrong = wrong or (not free and key in ("unknown", "é", "__class__"))
            case "list":
                table[key] = [table[key]]
            case "table":
                table[key] = {"a": table[key]}
            case _:
                table[key] = odd_value(rng)
                wrong = wrong or (not free and must_be_refused(before, table[key]))
        places.append((*place[:-1], key))
        if rng.random() < 0.7:
            break
    # Of several one may take another away.
    return Mutant(content, places, wrong and len(places) == 1)


ODD = [b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b'"', b"[", b"]", b"=", b"'''", b"\x1b[2J", b"\n", b","]


def damaged(rng: random.Random, raw: bytes) -> bytes:
    """Bytes cut off, flipped, put in, taken out, or standing there twice."""
    for _ in range(rng.randint(1, 4)):
        a, b = sorted((rng.randint(0, len(raw)), rng.randint(0, len(raw))))
        match rng.choice(["cut", "flip", "put", "twice", "out"]):
            case "cut":
                raw = raw[:a]
            case "flip" if a < len(raw):
                raw = raw[:a] + bytes([raw[a] ^ rng.randint(1, 255)]) + raw[a + 1 :]
            case "twice":
                raw = raw[:b] + raw[a:b] + raw[b:]
            case "out":
                raw = raw[:a] + raw[b:]
            case _:
                raw = raw[:a] + rng.choice(ODD) * rng.choice([1, 1, 3, 5000]) + raw[a:]
    return raw


def written(content) -> bytes:
    return "\n".join(f"{json.dumps(k)} = {toml(v)}" for k, v in content.items()).encode()


OWN = """
title = "Of all kinds"
runs = 3
outages = [{ start_s = 2.0, duration_s = 1.0 }]
[alignment]
filters = ["l2linf"]
[fixes]
delay = { kind = "replay", file = "data/delays.csv", column = "delay_ms" }
[variants.noisy]
"fixes.position_sd_m" = 20.0
[variants.late]
"fixes.delay" = { kind = "replay", file = "data/delays.csv" }
"outages.0.start_s" = 3.0
"""
RECORDED = """
title = "Fixes of a file"
[fixes]
kind = "replay"
file = "fixes.parquet"
"""
SCENARIOS = [SCENARIO_FOLDER.joinpath(f"{name}.toml").read_text() for name in scenario_names()] + [OWN] * 3
SCENARIOS += [RECORDED]
COMMANDS = ("check", "run", "fly", "localize", "bound", "maneuver")


def fixes_of_a_straight_flight(k=30) -> Fixes:
    t = np.arange(k) * 0.1
    lla = np.column_stack([0.5 + 10.0 * t / 6_371_000, np.full(k, 2.0), np.full(k, 100.0)])
    cov = np.tile(np.diag([1.0] * 3 + [0.01] * 3), (k, 1, 1))
    v_n = np.tile([10.0, 0.0, 0.0], (k, 1))
    return Fixes(t, t, t + 0.02, lla, v_n, cov, np.zeros(k, np.int64), np.arange(k))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With all the files that files name."""
    folder = tmp_path_factory.mktemp("malformed")
    (folder / "data").mkdir()
    (folder / "data/delays.csv").write_text("delay_ms\n10\n30\n")
    time_s = np.arange(320) * 0.01
    imu = {"time_s": time_s, "dtheta_x_rad": np.full(320, 1e-5), "dv_z_mps": np.full(320, -0.098)}
    imu |= dict.fromkeys(("dtheta_y_rad", "dtheta_z_rad", "dv_x_mps", "dv_y_mps"), np.zeros(320))
    for suffix in (".csv", ".parquet"):
        write_fixes(fixes_of_a_straight_flight(), folder / f"fixes{suffix}")
        write_columns(imu, folder / f"imu{suffix}")
    (folder / "base.toml").write_text(OWN)
    campaign_in(folder)
    (folder / "mine.toml").write_text(MAP)
    recording = ("--imu", folder / "imu.csv", "--fixes", folder / "fixes.csv", "--map", folder / "mine.toml")
    assert ask("replay", *recording).status == 0  # compiled loops look for broken samples
    return folder


def entries(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if not path.name.startswith("mine")}


RANDOM = st.randoms(use_true_random=True)


@MUTATIONS
@given(RANDOM)
def test_scenarios(folder, rng):
    file, out = folder / "mine.toml", folder / "out"
    text, mutated = rng.choice(SCENARIOS), None
    if rng.random() < 0.7:
        mutated = mutant(rng, tomllib.loads(text))
        file.write_bytes(written(mutated.content))
    else:
        file.write_bytes(damaged(rng, text.encode()))
    before, command = entries(folder), rng.choice(COMMANDS)
    told = judge(ask(command, file, *([] if command == "check" else ["--out", out])), (file,), out)
    if mutated:
        mutated.judge(told, file)
    assert entries(folder) == before


CAMPAIGN = """
title = "Points"
scenario = "base.toml"
runs = 4
shard_runs = 2
filters = ["ekf", "l2linf"]
[axes."fixes.position_sd_m"]
values = [5.0, 20]
[axes."fixes.velocity_sd_mps"]
low = 0.1
high = 0.4
steps = 2
log = true
"""
HYPERCUBE = CAMPAIGN.replace("shard_runs = 2", 'design = "latin_hypercube"\npoints = 3')


@MUTATIONS
@given(RANDOM)
def test_campaigns(folder, rng):
    file, out = folder / "mine.toml", folder / "out"
    text, mutated = rng.choice([CAMPAIGN, HYPERCUBE]), None
    if rng.random() < 0.7:
        mutated = mutant(rng, tomllib.loads(text))
        file.write_bytes(written(mutated.content))
    else:
        file.write_bytes(damaged(rng, text.encode()))
    before, files = entries(folder), (file, folder / "base.toml")
    told = judge(ask("campaign", file, "--out", out), files, out)
    if mutated:
        mutated.judge(told, file)
    assert entries(folder) == before


MAP = """
title = "A recording"
[recorded]
gap_limit_s = 0.5
[recorded.imu]
kind = "increments"
axes = "FRD"
gyro = ["dtheta_x_rad", "dtheta_y_rad", "dtheta_z_rad"]
[initial]
roll_deg = 0.0
pitch_deg = 0.0
heading_deg = 0.0
level_sd_deg = 1.0
[alignment]
filters = ["l2linf", "ekf_stamped"]
[alignment.settings]
horizon_s = 1.0
"""
CELLS = [
    "x",
    "",
    "nan",
    "-inf",
    "1e999",
    "-1e308",
    "9" * 400,
    "1e-320",
    "\x1b[2J",
    "y" * 100_000,
    '"',
    "0x1",
    "é",
    "1,2",
]


def spoilt_table(rng: random.Random, text: str) -> bytes:
    """A CSV table with odd cells, columns or rows."""
    rows = [line.split(",") for line in text.splitlines()]
    at, column = rng.randrange(1, len(rows)), rng.randrange(len(rows[0]))
    match rng.randrange(9):
        case 0:
            rows = [row[:column] + row[column + 1 :] for row in rows]
        case 1:
            rows = [[*row, row[column]] for row in rows]
        case 2:
            rng.shuffle(rows)
        case 3:
            rows[at] = rows[at][:column]
        case 4:
            rows = rows[: rng.choice([0, 1, 2, 5])]
        case 5:
            rows[0][column] = rng.choice([*NAMES[:-1], rows[0][0], "1"])
        case 6:
            for row in rows[1:]:
                row[column] = rng.choice([*CELLS[:8], "7"])
        case 7:
            return damaged(rng, text.encode())
        case _:
            rows[at][column] = rng.choice(CELLS)
    return "\n".join(map(",".join, rows)).encode()


ODD_COLUMNS = (
    lambda k: pa.array(["a"] * k),
    lambda k: pa.array([b"\xff"] * k),
    lambda k: pa.array([None] * k),
    lambda k: pa.array([True] * k),
    lambda k: pa.array([[1.0]] * k),
    lambda k: pa.array([{"a": 1}] * k),
    lambda k: pa.array([2**63 - 1] * k),
    lambda k: pa.array(np.full(k, 2**64 - 1, np.uint64)),
    lambda k: pa.array(np.full(k, 2**62), pa.timestamp("ns")),
    lambda k: pa.array(["a"] * k).dictionary_encode(),
    lambda k: pa.array([np.nan] * k),
    lambda k: pa.array([-1e308] * k),
    lambda k: pa.array([0] * k, pa.decimal128(20, 3)),
    lambda k: pa.array(np.full(k, 1, np.float16)),
)


def spoilt_parquet(rng: random.Random, file: Path) -> bytes:
    """A Parquet file with damaged bytes, or whole with an odd column."""
    if rng.random() < 0.5:
        return damaged(rng, file.read_bytes())
    table = pq.read_table(file)
    at = rng.randrange(table.num_columns)
    odd = rng.choice(ODD_COLUMNS)(len(table))
    name = rng.choice([table.column_names[at]] * 3 + [table.column_names[0], "\x1b", "n" * 100_000])
    table = table.set_column(at, name, odd) if rng.random() < 0.8 else table.append_column(name, odd)
    held = io.BytesIO()
    pq.write_table(table, held)
    return held.getvalue()


@MUTATIONS
@given(RANDOM)
def test_recordings(folder, rng):
    suffix, out = rng.choice([".csv", ".parquet"]), folder / "out"
    files = {name: folder / f"mine_{name}{suffix}" for name in ("imu", "fixes")} | {
        "map": folder / "mine.toml"
    }
    for name in ("imu", "fixes"):
        shutil.copy(folder / f"{name}{suffix}", files[name])
    files["map"].write_text(MAP)
    spoilt, mutated = rng.choice(["imu", "fixes", "map"]), None
    if spoilt != "map":
        whole = folder / f"{spoilt}{suffix}"
        change = spoilt_parquet(rng, whole) if suffix == ".parquet" else spoilt_table(rng, whole.read_text())
        files[spoilt].write_bytes(change)
    elif rng.random() < 0.7:
        mutated = mutant(rng, tomllib.loads(MAP))
        files["map"].write_bytes(written(mutated.content))
    else:
        files["map"].write_bytes(damaged(rng, MAP.encode()))
    before = entries(folder)
    options = [part for name, file in files.items() for part in (f"--{name}", file)]
    told = judge(ask("replay", *options, "--out", out), tuple(files.values()), out)
    if mutated:
        mutated.judge(told, files["map"])
    assert entries(folder) == before


def campaign_in(folder: Path) -> Path:
    """A campaign's folder with two finished shards of made-up rows."""
    file = folder / "campaign.toml"
    file.write_text(CAMPAIGN)
    campaign = load_campaign(file)
    with Ledger(folder / "kept", campaign, resume=False) as ledger:
        for shard in campaign.shards[:2]:
            rows = [
                {"point": shard.point, "run": shard.first_run + run, "filter": name, "failure": None}
                | dict.fromkeys(
                    ("roll_arcsec", "pitch_arcsec", "heading_arcmin", "v_east_mps", "v_north_mps"), 1.0
                )
                | {"nees": 3.0, "nis": 6.0, "fused": 9, "fixes": 10}
                | {name: [1.0, 2.0] for name in HISTORIES}
                for run in range(shard.runs)
                for name in ("ekf", "l2linf")
            ]
            ledger.add(shard, encoded(rows))
    return folder / "kept"


HISTORIES = ("history_time_s", "level_history_arcsec", "heading_history_arcmin")


@MUTATIONS
@given(RANDOM)
def test_folders_of_campaigns(folder, rng):
    kept, out = folder / "mine", folder / "out"
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(folder / "kept", kept)
    plan, shard = kept / "campaign.json", rng.choice(sorted((kept / "shards").iterdir()))
    match rng.randrange(4):
        case 0:
            text = as_json(mutant(rng, json.loads(plan.read_text())).content)
            # What no editor leaves: changed, and with the digest of that.
            with contextlib.suppress(ValueError, RecursionError):
                content = json.loads(text)
                text = json.dumps(content | {"content_sha256": content_digest(content)})
            plan.write_text(text)
        case 1:
            plan.write_bytes(damaged(rng, plan.read_bytes()))
        case 2:
            shard.write_bytes(spoilt_parquet(rng, shard))
            # What no disk makes of a shard: whole, and of odd content.
            with contextlib.suppress(pa.ArrowException, OSError):
                shard.write_bytes(sealed(pq.read_table(shard)))
        case _:
            names = (
                "p999999_r0000000.parquet",
                "p000001_r0000000.parquet",
                "x.parquet",
                "p-00001_r1.parquet",
            )
            shard.rename(shard.with_name(rng.choice(names)))
    before = entries(folder)
    answer = ask("report", kept)
    if judge(answer, (kept,), out):
        assert entries(folder) == before


def as_json(value) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)}: {as_json(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_json, value)) + "]"
    return str(value) if isinstance(value, Raw) else json.dumps(value)


PLANTS = [
    SCENARIO_FOLDER.joinpath("plants", f"{name}.toml").read_text() for name in ("two_state", "two_vertices")
]


@FEWER
@given(RANDOM)
def test_plants(folder, rng):
    file, text = folder / "mine.toml", rng.choice(PLANTS)
    if rng.random() < 0.7:
        file.write_bytes(written(mutant(rng, tomllib.loads(text)).content))
    else:
        file.write_bytes(damaged(rng, text.encode()))
    judge(ask("lmi", file), (file,), folder / "out")


HUGE = str(10**30)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        *((("run", "--runs", value), "runs") for value in ("-1", "0", "nan", HUGE, "9" * 5000, "1.5")),
        *((("run", "--seed", value), "seed") for value in ("-1", str(2**70), "0x1", "")),
        *((("run", "--run-id", value), "--run-id") for value in ("-1", HUGE)),
        *((("run", "--filter", value), "filter") for value in ("", "n" * 100_000, "\x1b[2J", "ekf\nekf")),
        *((("campaign", "base.toml", "--workers", value), "--workers") for value in ("0", "-3", HUGE, "two")),
        *((("localize", "--nodes", value), "--nodes") for value in ("-1", "1", "nan", HUGE)),
        *((("localize", "--draws", value), "--draws") for value in ("-1", HUGE)),
        *((("bound", "--draws", value), "--draws") for value in ("0", HUGE)),
        *((("maneuver", "--duration-s", value), "duration_s") for value in ("nan", "-1", "inf", "1e308")),
        *((("maneuver", "--velocity-sd-mps", value), "velocity_sd_mps") for value in ("nan", "-1", "1e-320")),
        (("lmi", "--kind", "k" * 100_000), "--kind"),
        *(
            (("check", value), "")
            for value in ("", ".", "/", "\x1b[2J", "x" * 5000, "/dev/null", "\udcff.toml")
        ),
        *((("replay", "--imu", value, "--fixes", "no.csv"), "") for value in ("", ".", "/", "\x1b.csv")),
        (("report", "/dev/null"), "/dev/null: no campaign"),
        (("report", "/proc/self/mem"), "no campaign"),
    ],
)
def test_options(arguments, told):
    answer = ask(*arguments)
    assert answer.status == 2
    assert told in answer.err
    assert answer.err.count("\n") == 1
    assert answer.err[:-1].isprintable()
    assert len(answer.err) < 6000
    assert not any(word in answer.err for word in WORDS_OF_LIBRARIES)
    assert answer.seconds < LONGEST_S


@pytest.mark.parametrize("command", [("run",), ("localize",), ("bound",), ("campaign", "campaign.toml")])
def test_an_output_folder_that_is_none_is_refused(folder, command):
    arguments = [folder / part if part.endswith(".toml") else part for part in command]
    for out in (folder / "base.toml", folder / "base.toml/inside", "/proc/none", folder / ("n" * 300)):
        answer = ask(*arguments, "--out", out)
        assert answer.status == 2
        assert answer.err.startswith(f"fleetalign: --out {out}: cannot be written: ")
        assert answer.err.count("\n") == 1


OUTSIDE = "outside the folder of the file that names it"


@pytest.fixture
def rooms(tmp_path):
    """A folder with a secret beside it, and links out of it and within it."""
    room = tmp_path / "room"
    (room / "sub").mkdir(parents=True)
    for place in (tmp_path, room, room / "sub"):
        (place / "delays.csv").write_text("delay_ms\n10\n30\n")
        (place / "five.toml").write_text('title = "Five"\nruns = 2\n')
    (room / "out.csv").symlink_to(tmp_path / "delays.csv")
    (room / "out").symlink_to(tmp_path)
    (room / "in.csv").symlink_to(room / "sub/delays.csv")
    (room / "loop.csv").symlink_to(room / "loop.csv")
    return room


@pytest.mark.parametrize(
    ("named", "why"),
    [
        ("delays.csv", ""),
        ("sub/delays.csv", ""),
        ("sub/../delays.csv", ""),
        ("in.csv", ""),
        ("../delays.csv", OUTSIDE),
        ("sub/../../delays.csv", OUTSIDE),
        ("out.csv", OUTSIDE),
        ("out/delays.csv", OUTSIDE),
        ("loop.csv", "cannot be read"),
        ("sub", "is no file"),
        ("", "is no file"),
        ("{room}/delays.csv", "an absolute path"),
        ("/etc/hostname", "an absolute path"),
    ],
)
def test_no_path_in_a_scenario_reaches_outside(rooms, named, why):
    named = named.format(room=rooms)
    delay = f'{{ kind = "replay", file = {json.dumps(named)} }}'
    file = rooms / "mine.toml"
    texts = [
        f"[fixes]\ndelay = {delay}\n",
        f'[variants.a]\n"fixes.delay" = {delay}\n',
        f'[fixes]\ndelay = {{ kind = "replay", file = "delays.csv" }}\n'
        f'[variants.a]\n"fixes.delay.file" = {json.dumps(named)}\n',
    ]
    for text in texts:
        file.write_text(f'title = "Paths"\n{text}')
        answer = ask("check", file)
        assert answer.status == (2 if why else 0)
        if why:
            assert "fixes.delay.file" in answer.err
            assert why in answer.err
            assert answer.err.count("\n") == 1


@pytest.mark.parametrize(
    ("named", "why"),
    [
        ("five.toml", ""),
        ("sub/five.toml", ""),
        ("gao2009", ""),
        ("../five.toml", OUTSIDE),
        ("out/five.toml", OUTSIDE),
        ("{room}/five.toml", "an absolute path"),
        ("sub", "is no file"),
    ],
)
def test_no_path_in_a_campaign_reaches_outside(rooms, monkeypatch, named, why):
    # A scenario of that name where the command is typed is not the one beside the campaign.
    monkeypatch.chdir(rooms.parent)
    file = rooms / "mine.toml"
    named = named.format(room=rooms)
    file.write_text(f'title = "Paths"\nscenario = {json.dumps(named)}\n')
    answer = ask("campaign", file, "--out", rooms / "kept")
    assert answer.status == (2 if why else 0)
    assert why in answer.err
    assert not why or f"mine.toml: scenario = {named[:40]!r}"[:-1] in answer.err
    file.write_text(
        'title = "x"\nscenario = "five.toml"\n[axes."fixes.delay.file"]\nvalues = ["../delays.csv"]\n'
    )
    answer = ask("campaign", file, "--out", rooms / "another")
    assert "fixes.delay.file: a file is no axis" in answer.err


def test_a_foreign_folder_makes_a_report_read_nowhere_else(rooms):
    (rooms / "five.toml").write_text(
        'title = "Five"\n[fixes]\ndelay = { kind = "replay", file = "sub/delays.csv" }\n'
    )
    file, kept = rooms / "campaign.toml", rooms / "kept"
    file.write_text('title = "Own copies"\nscenario = "five.toml"\nruns = 2\n')
    with Ledger(kept, load_campaign(file), resume=False):
        pass
    shutil.rmtree(rooms / "sub")
    assert ask("report", kept).status == 0
    plan = kept / "campaign.json"
    content = json.loads(plan.read_text())
    assert content["base"]["fixes"]["delay"]["file"] == "delays.csv"
    for named in ("/etc/hostname", "../../delays.csv", str(kept / "points/delays.csv")):
        content["base"]["fixes"]["delay"]["file"] = named
        plan.write_text(json.dumps(content))
        answer = ask("report", kept)
        assert answer.status == 2
        assert "base.fixes.delay.file" in answer.err
        assert OUTSIDE in answer.err or "an absolute path" in answer.err


@pytest.mark.parametrize("name", ["campaign.lock", "campaign.json", "shards", "points"])
def test_a_link_in_a_campaigns_folder_is_not_followed(folder, tmp_path, name):
    kept, outside, out = tmp_path / "kept", tmp_path / "outside", tmp_path / "out"
    shutil.copytree(folder / "kept", kept)
    (kept / name).rename(outside)
    (kept / name).symlink_to(outside)
    files = sorted(outside.rglob("*")) if outside.is_dir() else [outside]
    before = [file.read_bytes() for file in files]
    commands = [("campaign", folder / "campaign.toml", "--resume", "--out", kept)]
    for command in [*commands, *([("report", kept)] if name != "campaign.lock" else [])]:
        answer = ask(*command)
        assert (answer.status, answer.out) == ((1 if name == "campaign.lock" else 2), "")
        assert answer.err.count("\n") == 1
        assert (
            "symbolic links" in answer.err or f"kept/{name}: a link: must be the folder's own" in answer.err
        )
    assert (sorted(outside.rglob("*")) if outside.is_dir() else [outside]) == files
    assert [file.read_bytes() for file in files] == before
    assert not out.exists()


def test_a_shard_that_is_a_link_is_none(folder, tmp_path):
    kept = tmp_path / "kept"
    shutil.copytree(folder / "kept", kept)
    shard = next((kept / "shards").iterdir())
    shard.rename(tmp_path / shard.name)
    shard.symlink_to(tmp_path / shard.name)
    answer = ask("report", kept)
    assert answer.status == 2
    assert f"{shard.name}: damaged: a link; " in answer.err
    assert ask("campaign", folder / "campaign.toml", "--resume", "--out", kept).status == 0
    assert (tmp_path / shard.name).exists()


def test_a_report_that_cannot_be_written_is_a_line(folder, tmp_path, monkeypatch):
    kept = tmp_path / "kept"
    shutil.copytree(folder / "kept", kept)
    (kept / "report.html").mkdir()
    drawn = dict.fromkeys(("axis_0", "axis_1", "convergence", "nees"), "")
    monkeypatch.setattr("fleetalign.cosim.campaign.report.draw_campaign", lambda _: drawn)
    answer = ask("report", kept)
    assert (answer.status, answer.out) == (1, "")
    assert answer.err == f"{kept}: Is a directory: no report\n"
    assert not list(kept.glob("*.partial"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "[alignment]\nduration_s = 3600\nstart = 0\n[flight]\ns_start_s = 3600\n[fixes]\nrate_hz = 1000",
            "rate_hz",
        ),
        (
            "[alignment]\nduration_s = 3600\nstart = 0\n[alignment.settings]\noutput_rate_hz = 1000\n"
            "[flight]\ns_start_s = 3600",
            "output_rate_hz",
        ),
        (
            "[alignment]\nduration_s = 3600\nstart = 0\n[flight]\ns_start_s = 3600\n"
            '[fixes]\nkind = "network"\nrate_hz = 100\n[fixes.fleet]\nnodes = 40',
            "fixes.fleet.nodes = 40",
        ),
        ("".join(f"[variants.v{i}]\nruns = 1\n" for i in range(101)), "variants"),
        ("outages = [" + "{ start_s = 0, duration_s = 1 }, " * 101 + "]", "outages"),
    ],
)
def test_what_would_fill_the_memory_is_refused(tmp_path, text, told):
    file = tmp_path / "mine.toml"
    file.write_text(f'title = "Large"\n{text}\n')
    assert told in judge(ask("check", file), (file,), tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("runs = 1_000_000\nshard_runs = 1", "shard_runs = 1: 1000000 shards"),
        (
            "".join(f"[axes.a{i}]\nlow = 0\nhigh = 1\nsteps = 1000\n" for i in range(20)),
            "points: allowed are 100000",
        ),
        ("".join(f"[axes.a{i}]\nlow = 0\nhigh = 1\n" for i in range(21)), "axes"),
        ("[axes.seed]\nlow = 0\nhigh = 1\nsteps = 1_000_000_000", "steps = 1000000000"),
        ('[axes."fixes.rate_hz"]\nlow = 1\nhigh = 1e9\nsteps = 10_000', "fixes.rate_hz = 1000000000.0"),
        ('[axes."outages.1.start_s"]\nvalues = [1.0]', "outages has entry 0, and not 1"),
        ('[axes."outages.x.start_s"]\nvalues = [1.0]', "outages has entry 0, and not x"),
        ('[axes."outages.0.start_s"]\nvalues = [1e9]', "outages.0.start_s = 1000000000.0 s: allowed is"),
        ('[axes."outages.0.start_s"]\nvalues = ["a"]', "outages.0.start_s = 'a' s: allowed is"),
        ('[axes."fixes.\u2028.0"]\nvalues = [1.0]', "control character"),
        (f'[axes."outages.{"0." * 3000}0"]\nvalues = [1.0]', "outages.0"),
        (f'[axes."outages.{"9" * 5000}"]\nvalues = [1.0]', "outages has entry 0, and not 999"),
        ('[axes."outages.0"]\nvalues = [1.0]', "outages.0 = 1.0: must be a table"),
        ('[axes."outages.0.start_s"]\nlow = 1\nhigh = 2\nsteps = 2', ""),
    ],
)
def test_campaigns_of_too_many_runs_or_strange_axes_are_refused(folder, text, told):
    file = folder / "mine.toml"
    file.write_text(f'title = "Large"\nscenario = "base.toml"\n{text}\n')
    answer = judge(ask("campaign", file, "--out", folder / "out"), (file,), folder / "out")
    assert (told in answer) if told else not answer


def test_a_small_file_of_many_rows_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("fleetalign.network.tables.MOST_ROWS", 1000)
    write_columns({"delay_ms": np.zeros(1001)}, tmp_path / "delays.parquet")
    file = tmp_path / "mine.toml"
    file.write_text('title = "x"\n[fixes]\ndelay = { kind = "replay", file = "delays.parquet" }\n')
    answer = ask("check", file)
    assert answer.status == 2
    assert "1001 rows: allowed are 1000" in answer.err


def test_gaps_do_not_fill_the_memory(folder, tmp_path):
    time_s = np.cumsum(np.where(np.arange(200) % 3, 0.01, 50.0))
    table = pq.read_table(folder / "imu.parquet").slice(0, 200).to_pydict() | {"time_s": time_s}
    write_columns(table, tmp_path / "imu.csv")
    (tmp_path / "map.toml").write_text(MAP.replace("gap_limit_s = 0.5", "gap_limit_s = 60"))
    answer = ask(
        *("replay", "--imu", tmp_path / "imu.csv", "--fixes", folder / "fixes.csv"),
        *("--map", tmp_path / "map.toml", "--out", tmp_path / "out"),
    )
    assert answer.status == 2
    assert "rows are missing among 200: allowed are 4000" in answer.err


def test_a_number_is_no_text_and_no_truth_value(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('title = "x"\n[alignment.settings]\nlever_arm_b_m = [1, "2", true]\n')
    assert ask("check", file).err.splitlines() == [
        f"fleetalign: {file}: alignment.settings.lever_arm_b_m.{i} = {value} m: allowed is [-100, 100] m"
        for i, value in ((1, "'2'"), (2, "True"))
    ]


def test_an_entry_of_a_list_is_told_in_the_words_of_its_field(tmp_path):
    text = SCENARIO_FOLDER.joinpath("wan2008.toml").read_text()
    content = tomllib.loads(text)
    content["experiment"]["range_error_shares"] = [0.1, -0.02]
    file = tmp_path / "mine.toml"
    file.write_bytes(written(content))
    assert ask("check", file).err == (
        f"fleetalign: {file}: experiment.range_error_shares.1 = -0.02: allowed is [0.001, 0.5]\n"
    )


def test_many_mistakes_are_told_in_few_lines(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('title = "x"\n' + "".join(f"unknown{i} = 1\n" for i in range(1000)))
    lines = ask("check", file).err.splitlines()
    assert len(lines) == 21
    assert lines[-1] == f"fleetalign: {file}: and 980 more mistakes"
