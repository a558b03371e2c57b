"""Campaigns: their points, what is kept of them, and what they outlive."""

import errno
import io
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import wait
from functools import partial
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import dask
import distributed  # (a setting that is changed for a time must have its default before)
import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
from fleetalign.cosim.campaign import cluster, engine, ledger, plan
from fleetalign.cosim.campaign.cluster import on_cluster
from fleetalign.cosim.campaign.engine import locally, run_campaign
from fleetalign.cosim.campaign.ledger import Ledger, read_points
from fleetalign.cosim.campaign.plan import Shard, load_campaign
from fleetalign.cosim.campaign.report import campaign_table
from fleetalign.cosim.campaign.shard import done_shard, encoded, failed_rows, shard_rows
from fleetalign.cosim.run import alignment_window, simulate
from fleetalign.cosim.scenario import ScenarioError
from fleetalign.cosim.score import COLUMNS, errors_against
from rich.console import Console

SCENARIO = """
title = "Five seconds"
[flight]
s_start_s = 500
[alignment]
duration_s = 5.0
filters = ["ekf_stamped", "l2linf"]
"""
CAMPAIGN = """
title = "Fixes of two kinds"
scenario = "five.toml"
runs = 5
seed = 7
shard_runs = 2
[axes."fixes.velocity_sd_mps"]
values = [0.1, 0.2]
"""


@pytest.fixture
def file(tmp_path, flight):  # the flight: in the cache, where workers find it
    (tmp_path / "five.toml").write_text(SCENARIO)
    path = tmp_path / "campaign.toml"
    path.write_text(CAMPAIGN)
    return path


@pytest.fixture
def one_worker(monkeypatch):
    """A pool of one process, where none must die: each takes seconds to begin."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)


def contents(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "shards").iterdir())}


def test_a_grid_has_all_combinations_and_shards_have_each_run_once(file):
    file.write_text(
        CAMPAIGN + '[axes."fixes.position_sd_m"]\nlow = 1.0\nhigh = 100.0\nsteps = 3\nlog = true\n'
    )
    campaign = load_campaign(file)
    points = [(p["fixes.velocity_sd_mps"], p["fixes.position_sd_m"]) for p in campaign.coordinates]
    assert points == [(v, pytest.approx(s)) for v in (0.1, 0.2) for s in (1.0, 10.0, 100.0)]
    runs = [(s.point, s.first_run + i) for s in campaign.shards for i in range(s.runs)]
    assert sorted(runs) == [(point, run) for point in range(6) for run in range(5)]
    assert campaign.scenario(4).fixes.position_sd_m == pytest.approx(10.0)
    assert campaign.scenario(4).seed == 7


def test_a_latin_hypercube_has_a_point_in_each_slice_and_is_the_same_again(file):
    hypercube = CAMPAIGN.replace("runs = 5", 'runs = 5\ndesign = "latin_hypercube"\npoints = 8').replace(
        "values = [0.1, 0.2]", "low = 0.1\nhigh = 0.9"
    )
    file.write_text(hypercube + '[axes."fixes.rate_hz"]\nvalues = [5, 10]\n')
    campaign = load_campaign(file)
    slices = np.floor([(p["fixes.velocity_sd_mps"] - 0.1) / 0.1 for p in campaign.coordinates])
    assert sorted(slices) == list(range(8))
    assert sorted(p["fixes.rate_hz"] for p in campaign.coordinates) == [5] * 4 + [10] * 4
    assert load_campaign(file).coordinates == campaign.coordinates
    assert load_campaign(file).digest == campaign.digest


def test_a_range_of_whole_numbers_has_no_others_and_all_in_equal_shares(file):
    (file.parent / "five.toml").write_text(SCENARIO + '[fixes]\nkind = "network"\n')
    axis = '[axes."fixes.fleet.nodes"]\nlow = 12\nhigh = 14\nsteps = 5\ninteger = true\n'
    grid = CAMPAIGN.replace("fixes.velocity_sd_mps", "fixes.rate_hz").replace("[0.1, 0.2]", "[5]") + axis
    file.write_text(grid)
    assert [p["fixes.fleet.nodes"] for p in load_campaign(file).coordinates] == [12, 13, 14]
    file.write_text(grid.replace("runs = 5", 'runs = 5\ndesign = "latin_hypercube"\npoints = 12'))
    drawn = [p["fixes.fleet.nodes"] for p in load_campaign(file).coordinates]
    assert {type(nodes) for nodes in drawn} == {int}
    assert sorted(drawn) == [12] * 4 + [13] * 4 + [14] * 4
    file.write_text(grid.replace("high = 14", "high = 96\nlog = true"))
    assert [p["fixes.fleet.nodes"] for p in load_campaign(file).coordinates] == [12, 20, 34, 57, 96]
    # From 1 up to 4 in even ratios, half is below 2, and log(3) / log(4) = 0.79 of it below 3.
    ratios = plan.Range(low=1, high=3, log=True, integer=True)
    assert [ratios.drawn(share) for share in (0.0, 0.49, 0.51, 0.79, 0.8, 1.0)] == [1, 1, 2, 2, 3, 3]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            ("fixes.velocity_sd_mps", "fixes.colour"),
            "axes: at fixes.colour = 0.1: fixes.colour: unknown field",
        ),
        (("[0.1, 0.2]", "[0.1, -2]"), "axes: at fixes.velocity_sd_mps = -2: fixes.velocity_sd_mps"),
        (("[0.1, 0.2]", "[]"), "values"),
        (("values = [0.1, 0.2]", "low = 2\nhigh = 1"), "low = 2: must be below high = 1"),
        (("values = [0.1, 0.2]", "low = 0\nhigh = 1\nlog = true"), "low = 0: must be above 0"),
        (("values = [0.1, 0.2]", "low = 0\nhigh = 1\nsteps = 1"), "steps = 1: allowed is [2, 10000]"),
        (
            ("values = [0.1, 0.2]", "low = 0.5\nhigh = 2\ninteger = true"),
            "low = 0.5, high = 2: must be whole where integer = true",
        ),
        (("runs = 5", "runs = 0"), "runs = 0: allowed is [1, 1e+06]"),
        (("five.toml", "six.toml"), "six.toml"),
        (("seed = 7", "seed = 7\ncolour = 1"), "colour: unknown field"),
        (("title", "= title"), "not TOML"),
        (('axes."fixes.velocity_sd_mps"', 'axes.""'), "axes: '': no field's dotted name"),
        (
            ("seed = 7", 'seed = 7\nfilters = ["ekf", "nope"]'),
            "campaign.toml: filters = ['ekf', 'nope']: no filter 'nope'; known: ekf, ",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(command, file, change, told):
    file.write_text(CAMPAIGN.replace(*change))
    status, out, err = command("campaign", file)
    assert (status, out) == (2, "")
    assert told in err
    assert len(err.splitlines()) == 1


def test_rows_are_the_runs(file, flight):
    campaign = load_campaign(file)
    scenario = campaign.scenario(1)
    rows = shard_rows(scenario, Shard(1, 2, 2))
    assert [(r["point"], r["run"], r["filter"]) for r in rows] == [
        (1, run, name) for run in (2, 3) for name in ("ekf_stamped", "l2linf")
    ]
    run = simulate(scenario, flight, 3, 7)
    errors = errors_against(alignment_window(scenario, flight), run.estimates["l2linf"])
    assert [rows[3][c] for c in COLUMNS] == errors[-1].tolist()
    assert rows[3]["history_time_s"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert rows[3]["heading_history_arcmin"][-1] == pytest.approx(abs(errors[-1, 2]))
    assert done_shard(scenario, Shard(1, 2, 2)) == done_shard(scenario, Shard(1, 2, 2))


POISON = """
import os
from fleetalign.cosim.campaign import shard as real


def done_shard(scenario, shard):
    runs = range(shard.first_run, shard.first_run + shard.runs)
    if {3, 9} & set(runs):
        os._exit(9)
    real.measured = broken
    return real.done_shard(scenario, shard)


measured = real.measured


def broken(scenario, flight, run_id, seed):
    if run_id == 1:
        raise ZeroDivisionError("a run\\nof lead")
    return measured(scenario, flight, run_id, seed)
"""


def one_at_a_time(pending, return_when):
    """As `wait` returns where it is fast: what else ended is not yet told."""
    ended, rest = wait(pending, return_when=return_when)
    return {ended.pop()}, rest | ended


@pytest.mark.parametrize("by", ["locally", "on_cluster"])
def test_poison_runs_are_failed_rows_and_the_rest_finishes(file, tmp_path, monkeypatch, by):
    (tmp_path / "poison_of_a_test.py").write_text(POISON)
    monkeypatch.syspath_prepend(tmp_path)
    import poison_of_a_test

    module = engine if by == "locally" else cluster
    monkeypatch.setattr(module, "done_shard", poison_of_a_test.done_shard)
    monkeypatch.setattr(engine, "wait", one_at_a_time)
    file.write_text(CAMPAIGN.replace("runs = 5", "runs = 10").replace("[0.1, 0.2]", "[0.1]"))
    campaign, folder = load_campaign(file), tmp_path / "out"
    # Dask gives up a task whose worker dies four times: one is enough, and blames more of those beside it.
    one = dask.config.set({"distributed.scheduler.allowed-failures": 0})
    with one, Ledger(folder, campaign, resume=False) as kept:
        run_campaign(campaign, kept, partial(getattr(module, by), workers=2))
    failures = {}
    for point, table in read_points(folder):
        for row in table.to_pylist():
            failures[point, row["run"], row["filter"]] = row["failure"]
    assert len(failures) == 10 * 2
    reasons = {1: "ZeroDivisionError: a run", 3: engine.DIED, 9: engine.DIED}
    assert {run: reason for (_, run, _), reason in failures.items() if reason} == reasons


def test_a_worker_may_die_while_a_result_is_kept(file, tmp_path):
    file.write_text(CAMPAIGN.replace("[0.1, 0.2]", "[0.1]").replace("shard_runs = 2", "shard_runs = 1"))
    campaign, done = load_campaign(file), []
    for shard, content in locally(campaign, campaign.shards, workers=1):
        done.append(shard)
        assert content
        if len(done) == 1:
            # All that was in work, some 10 ms each, is done, and the worker waits: its death fails nothing
            # but what comes next.
            (worker,) = multiprocessing.active_children()
            time.sleep(1.0)
            worker.kill()
            time.sleep(1.0)
    assert sorted(done, key=lambda shard: shard.name) == campaign.shards


IN_FRONT = """
import signal
from fleetalign.cosim.cli import main

# What a shell starts in the background, and these tests with it, does not hear of Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""


def test_a_command_that_is_stopped_goes_on_where_it_was(file, tmp_path):
    """By a kill that lets it tell nobody, by what a batch system sends, and by Ctrl-C, which a terminal sends
    to the workers, too."""
    # More than is done before a busy machine sends the signals.
    file.write_text(CAMPAIGN.replace("runs = 5", "runs = 600"))
    folder, shards = tmp_path / "out", 2 * 300
    options = ["campaign", str(file), "--out", str(folder), "--quiet", "--resume"]
    line = [sys.executable, "-c", IN_FRONT, *options]
    for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
        before = len(list(folder.glob("shards/*.parquet")))
        process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, start_new_session=True)
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and process.poll() is None:
            if len(list(folder.glob("shards/*.parquet"))) > before:
                break
            time.sleep(0.02)
        workers = psutil.Process(process.pid).children(recursive=True)
        assert workers
        if number == signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
        _, err = process.communicate(timeout=60)
        assert psutil.wait_procs(workers, timeout=20)[1] == []
        kept = len(contents(folder))
        assert before < kept < shards
        if number == signal.SIGKILL:
            assert process.returncode == -signal.SIGKILL
        else:
            assert process.returncode == 1
            # A signal may come when a shard is on the disk and not yet counted.
            told = [
                f"stopped; {2 * n} of 1200 runs are kept, go on with --resume\n" for n in (kept, kept - 1)
            ]
            assert err in told
    # What a dying disk leaves: a shard that ends early.
    first = next((folder / "shards").iterdir())
    first.write_bytes(first.read_bytes()[:100])
    campaign = load_campaign(file)
    with Ledger(folder, campaign, resume=True) as ledger:
        assert len(ledger.done) == kept - 1
        for shard in set(campaign.shards) - ledger.done:
            if shard.name == first.name:
                ledger.add(shard, done_shard(campaign.scenario(shard.point), shard))
        done = ledger.done
    # How the rest follows: `test_ten_kills_at_random_moments_change_no_bit`.
    assert contents(folder) == {s.name: done_shard(campaign.scenario(s.point), s) for s in done}
    rows = [row for _, table in read_points(folder) for row in table.to_pylist()]
    assert len(rows) == len({(r["point"], r["run"], r["filter"]) for r in rows}) == kept * 2 * 2


def test_a_worker_ends_with_the_main_process_even_one_that_begins_after_it():
    program = "import time; from fleetalign.cosim.campaign.engine import _quiet; _quiet(0); time.sleep(60)"
    assert subprocess.run([sys.executable, "-c", program], timeout=50, check=False).returncode == 1
    pool = engine._pool(1)
    try:
        assert pool.submit(os.getppid).result() == os.getpid()
        assert pool.submit(signal.getsignal, signal.SIGINT).result() == signal.SIG_IGN
        pool.submit(time.sleep, 3 * engine._WATCH_S).result()  # and goes on while that lives
    finally:
        engine._stop(pool)


TEN_KILLS = """
import os, random, signal, sys, time
from pathlib import Path
from fleetalign.cosim.campaign.engine import run_campaign
from fleetalign.cosim.campaign.ledger import Ledger
from fleetalign.cosim.campaign.plan import load_campaign
from fleetalign.cosim.campaign.shard import done_shard

file, whole, killed = map(Path, sys.argv[1:])
campaign = load_campaign(file)


def one_by_one(campaign, shards):
    # In no order, so that what is kept has holes.
    for shard in random.Random(len(shards)).sample(shards, len(shards)):
        yield shard, done_shard(campaign.scenario(shard.point), shard)


def go(folder):
    with Ledger(folder, campaign, resume=True) as ledger:
        run_campaign(campaign, ledger, one_by_one)


def kept():
    return len(list(killed.glob("shards/*.parquet")))


go(whole)
moments = random.Random(7)
for _ in range(10):
    until = kept() + moments.randint(0, 5)
    child = os.fork()
    if child == 0:
        go(killed)
        os._exit(0)
    while kept() < until and os.waitpid(child, os.WNOHANG) == (0, 0):
        time.sleep(0.001)
    time.sleep(moments.uniform(0, 0.05))  # a shard takes as long
    os.kill(child, signal.SIGKILL)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), kept())
go(killed)
"""


def test_ten_kills_at_random_moments_change_no_bit(file, tmp_path):
    file.write_text(CAMPAIGN.replace("runs = 5", "runs = 60"))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    line = [sys.executable, "-c", TEN_KILLS, str(file), str(whole), str(killed)]
    told = subprocess.run(line, capture_output=True, text=True, check=True).stdout.split()
    assert told[::2] == [str(-signal.SIGKILL)] * 10
    assert 10 < int(told[-1]) < 60  # they met it at work
    assert contents(killed) == contents(whole)
    rows = [row for _, table in read_points(killed) for row in table.to_pylist()]
    assert len(rows) == len({(r["point"], r["run"], r["filter"]) for r in rows}) == 2 * 60 * 2


@pytest.mark.usefixtures("one_worker")
def test_a_full_disk_ends_in_one_line_and_keeps_what_is_done(command, file, tmp_path, monkeypatch, undrawn):
    folder, write, written = tmp_path / "out", ledger._write, []

    def full(path, content):
        written.append(path)
        if len(written) == 4:  # after the plan and two shards
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, content)

    monkeypatch.setattr(ledger, "_write", full)
    status, _, err = command("campaign", file, "--out", folder, "--quiet")
    assert status == 1
    kept = sum(pq.read_metadata(path).num_rows for path in (folder / "shards").iterdir()) // 2
    assert f"No space left on device; {kept} of 10 runs are kept, go on with --resume" in err.replace(
        "\n", " "
    )
    assert len(contents(folder)) == 2
    monkeypatch.setattr(ledger, "_write", write)
    status, _, err = command("campaign", file, "--out", folder, "--quiet")
    assert status == 2
    assert "has 2 finished shards; go on with --resume" in err.replace("\n", "")
    status, out, _ = command("campaign", file, "--out", folder, "--resume", "--json")
    assert status == 0
    points = json.loads(out)["points"]
    assert [(p["point"], p["filter"], p["runs"], p["failed"]) for p in points] == [
        (point, name, 5, 0) for point in (0, 1) for name in ("ekf_stamped", "l2linf")
    ]
    page = (folder / "report.html").read_text()
    assert "Along fixes.velocity_sd_mps" in page
    assert f"fleetalign run {folder}/points/000000.toml --run-id" in page
    other = file.with_name("other.toml")
    other.write_text(CAMPAIGN.replace("seed = 7", "seed = 8"))
    status, _, err = command("campaign", other, "--out", folder, "--resume")
    assert status == 2
    assert "holds another campaign" in err


def test_dask_brings_the_same_bytes_and_outlives_a_worker(file, tmp_path):
    campaign = load_campaign(file)
    with Ledger(tmp_path / "whole", campaign, resume=False) as whole:
        run_campaign(campaign, whole, partial(locally, workers=1))
    killed = []
    with Ledger(tmp_path / "dask", campaign, resume=False) as by_dask:
        for shard, content in on_cluster(campaign, campaign.shards, workers=2):
            by_dask.add(shard, content)
            if not killed:
                from distributed import get_client

                pids = {a: w["id"] for a, w in get_client().scheduler_info()["workers"].items()}
                worker = next(iter(pids))
                killed.append(get_client().run(os.getpid, workers=[worker])[worker])
                os.kill(killed[0], signal.SIGKILL)
    assert contents(tmp_path / "dask") == contents(tmp_path / "whole")


HOLDER = """
import sys
from pathlib import Path
from fleetalign.cosim.campaign.ledger import Ledger
from fleetalign.cosim.campaign.plan import load_campaign
from fleetalign.cosim.campaign.shard import done_shard

campaign = load_campaign(Path(sys.argv[1]))
with Ledger(Path(sys.argv[2]), campaign, resume=False) as ledger:
    shard = campaign.shards[0]
    ledger.add(shard, done_shard(campaign.scenario(shard.point), shard))
    print("holds", flush=True)
    sys.stdin.read()
"""


@pytest.mark.usefixtures("one_worker")
def test_one_process_at_a_time_works_in_a_folder_and_anybody_reports(command, file, tmp_path, undrawn):
    folder = tmp_path / "out"
    line = [sys.executable, "-c", HOLDER, str(file), str(folder)]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"holds\n"
        before = contents(folder)
        for options in ([], ["--resume"]):
            status, out, err = command("campaign", file, "--out", folder, *options)
            assert (status, out) == (2, "")
            assert f"{folder}: another process works in it: process {holder.pid} on " in err
            assert ", since 20" in err
            assert len(err.splitlines()) == 1
        assert contents(folder) == before
        assert command("report", folder, "--quiet")[0] == 0
        assert "8 of 10 runs are not done" in (folder / "report.html").read_text()
        holder.kill()
    assert command("campaign", file, "--out", folder, "--resume", "--quiet")[0] == 0
    # Nor does a lock stay when a campaign ends, or is refused.
    assert command("campaign", file, "--out", folder, "--quiet")[0] == 2
    assert command("campaign", file, "--out", folder, "--resume", "--quiet")[0] == 0
    (folder / "campaign.json").unlink()
    status, _, err = command("campaign", file, "--out", folder, "--resume")
    assert status == 2
    assert "has 6 shards and no campaign.json that says whose" in err


def test_where_there_are_no_locks_there_is_a_warning(file, tmp_path, monkeypatch):
    def unable(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", unable)
    with pytest.warns(UserWarning, match="no lock: No locks available"):
        Ledger(tmp_path / "out", load_campaign(file), resume=False).close()


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        ([], []),
        (["--workers", "3"], [{"scheduler": None, "workers": 3}]),
        (["--scheduler", "tcp://a:1"], [{"scheduler": "tcp://a:1", "workers": None}]),
    ],
)
def test_options_say_who_does_it(command, file, tmp_path, monkeypatch, undrawn, options, asked):
    cluster_asked, pool_asked = [], []
    monkeypatch.setattr(cluster, "check_cluster", lambda scheduler: None)
    monkeypatch.setattr(cluster, "on_cluster", lambda *_, **how: cluster_asked.append(how) or [])
    monkeypatch.setattr(engine, "locally", lambda *_: pool_asked.append(True) or [])
    folder = tmp_path / "out"
    status, out, _ = command("campaign", file, "--out", folder, "--json", *options)
    assert status == 0
    assert json.loads(out)["points"] == []
    assert cluster_asked == asked
    assert pool_asked == ([] if asked else [True])
    assert "10 of 10 runs are not done" in (folder / "report.html").read_text()
    status, _, err = command("campaign", file, "--workers", "2", "--scheduler", "tcp://a:1")
    assert status == 2
    assert "--workers: not beside --scheduler" in err


def test_a_scheduler_that_does_not_answer_leaves_nothing(command, file, tmp_path):
    folder = tmp_path / "out"
    status, out, err = command("campaign", file, "--out", folder, "--scheduler", "nowhere")
    assert (status, out) == (2, "")
    assert "--scheduler nowhere: does not answer" in err
    assert len(err.splitlines()) == 1
    assert not folder.exists()


@pytest.fixture
def scheduler(tmp_path):
    """Address of a scheduler that runs, and its process."""
    at = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    process = subprocess.Popen(
        [*command, "--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(at)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not at.is_file() or not at.read_text():
        assert process.poll() is None
        time.sleep(0.1)
    yield json.loads(at.read_text())["address"], process
    process.kill()
    process.wait()


def worker_of(address, *options):
    command = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-dashboard", "--no-nanny"]
    return subprocess.Popen(
        [*command, *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def test_a_scheduler_that_is_lost_is_told_in_a_line(command, file, tmp_path, scheduler, monkeypatch):
    address, process = scheduler
    worker = worker_of(address)
    add = Ledger.add

    def then_lost(self, shard, content):
        add(self, shard, content)
        process.kill()

    monkeypatch.setattr(Ledger, "add", then_lost)
    try:
        status, out, err = command(
            "campaign", file, "--out", tmp_path / "out", "--scheduler", address, "--quiet"
        )
    finally:
        worker.kill()
        worker.wait()
    assert (status, out) == (1, "")
    told = err.splitlines()[-1]
    assert told.startswith(f"{tmp_path / 'out'}: the scheduler is lost; ")  # a folder named by "lost", too
    assert told.endswith(" of 10 runs are kept, go on with --resume")
    assert len(contents(tmp_path / "out")) >= 1


def test_workers_with_other_versions_are_refused(command, file, tmp_path, scheduler, monkeypatch):
    address, _ = scheduler
    worker = worker_of(address)
    wanted = cluster.versions()
    monkeypatch.setattr(cluster, "versions", OtherVersions())
    try:
        with cluster._client(address) as client:
            client.wait_for_workers(1)
        status, out, err = command("campaign", file, "--out", tmp_path / "out", "--scheduler", address)
    finally:
        worker.kill()
        worker.wait()
    assert (status, out) == (2, "")
    assert f"has numba {wanted['numba']}, and not 0.1 as here" in err
    assert not (tmp_path / "out").exists()


LATE = """
import time
from pathlib import Path
from fleetalign.cosim.campaign import plan
plan.versions = lambda: {{"numba": "0.1"}}
while not Path({first!r}).exists():
    time.sleep(0.05)
"""


def test_a_worker_that_joins_late_with_other_versions_does_nothing(
    command, file, tmp_path, scheduler, monkeypatch
):
    """It joins when the first shard is there, and the campaign is not over before."""
    address, _ = scheduler
    file.write_text(CAMPAIGN.replace("runs = 5", "runs = 20"))
    (tmp_path / "late.py").write_text(LATE.format(first=str(tmp_path / "first")))
    workers = [worker_of(address), worker_of(address, "--preload", str(tmp_path / "late.py"))]
    add = Ledger.add

    def then_joined(self, shard, content):
        add(self, shard, content)
        (tmp_path / "first").touch()
        distributed.get_client().wait_for_workers(2, timeout=30)

    monkeypatch.setattr(Ledger, "add", then_joined)
    try:
        with cluster._client(address) as client:
            client.wait_for_workers(1, timeout=30)
        where = "--out", tmp_path / "out", "--scheduler", address
        status, out, err = command("campaign", file, *where, "--quiet")
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert err.startswith("fleetalign: worker tcp://")
    assert f"has fleetalign None, and not {cluster.versions()['fleetalign']} as here" in err
    assert 1 <= len(contents(tmp_path / "out")) < 20


TOLD_VERSION = "from fleetalign.cosim.campaign.plan import versions; print(versions()['fleetalign'])"


def test_other_code_is_another_version_and_the_same_elsewhere_is_none(file, tmp_path, monkeypatch):
    """Of a copy as a wheel leaves it, outside the repository."""
    project = Path(__file__).parents[1]
    for room in ("sins", "aircraft", "network", "align", "cosim", "scenarios"):
        shutil.copytree(
            project / room, tmp_path / "wheel/fleetalign" / room, ignore=shutil.ignore_patterns("__pycache__")
        )

    def told():
        line = [sys.executable, "-c", TOLD_VERSION]
        environment = os.environ | {"PYTHONPATH": str(tmp_path / "wheel"), "PYTHONDONTWRITEBYTECODE": "1"}
        run = subprocess.run(line, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        return run.stdout.strip()

    here = plan.versions()["fleetalign"]
    assert told() == here
    with (tmp_path / "wheel/fleetalign/align/lmi/alignment.py").open("a") as source:
        source.write("# other\n")
    other = told()
    assert other != here
    assert other.partition("+")[0] == here.partition("+")[0] == metadata.version("fleetalign")
    Ledger(tmp_path / "out", load_campaign(file), resume=False).close()
    wanted = plan.versions()
    monkeypatch.setattr(plan, "versions", lambda: wanted | {"fleetalign": other})
    with pytest.raises(ScenarioError, match="holds another campaign, or one of other versions or code"):
        Ledger(tmp_path / "out", load_campaign(file), resume=True)


class OtherVersions:
    """Here they are others than on workers, to whom it travels as the real ones."""

    def __call__(self):
        return {"numba": "0.1"}

    def __reduce__(self):
        return getattr, (plan, "versions")


def test_no_campaign_has_no_report(command, tmp_path):
    status, _, err = command("report", tmp_path)
    assert status == 2
    assert "no campaign is kept there" in err


def test_a_shard_without_a_flight_is_failed_rows(file):
    scenario = load_campaign(file).scenario(0)
    slow = scenario.model_copy(update={"flight": scenario.flight.model_copy(update={"s_start_s": 60.0})})
    rows = shard_rows(slow, Shard(0, 0, 2))
    assert len(rows) == 4
    assert all("FlightError" in row["failure"] for row in rows)


def test_a_folder_may_hold_no_foreign_plan(file, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "campaign.json").write_text("{")
    with pytest.raises(ScenarioError, match="damaged"):
        Ledger(folder, load_campaign(file), resume=True)


def test_no_bit_of_a_shard_changes_unseen(file, tmp_path, monkeypatch):
    campaign, (shard, *_) = (made := load_campaign(file)), made.shards
    rows = failed_rows(campaign.scenario(0), 0, 0, "x") + failed_rows(campaign.scenario(0), 0, 1, "x")
    for number, row in enumerate(rows):
        row |= {"nees": 1.0 + number, "fused": number, "history_time_s": [1.0, 2.0]}
    whole = encoded(rows)
    with Ledger(tmp_path / "out", campaign, resume=False) as kept:
        kept.add(shard, whole)
    assert pq.read_table(tmp_path / "out/shards")["nees"].to_pylist() == [1.0, 2.0, 3.0, 4.0]
    path, drawn = tmp_path / "out/shards" / shard.name, random.Random(1)
    # The first and the last byte, too, and one without its end.
    places = [0, 8 * len(whole) - 1, *drawn.sample(range(8 * len(whole)), 300)]
    flipped = [
        whole[: at // 8] + bytes([whole[at // 8] ^ 1 << at % 8]) + whole[at // 8 + 1 :] for at in places
    ]
    for content in (*flipped, whole[:-1], b""):
        path.write_bytes(content)
        with pytest.raises(ScenarioError, match="damaged"):
            list(read_points(tmp_path / "out"))
    with Ledger(tmp_path / "out", campaign, resume=True) as kept:
        assert kept.done == set()
        kept.add(shard, whole)
    monkeypatch.setattr(ledger, "_MOST_BYTES", len(whole) - 1)
    with pytest.raises(ScenarioError, match=f"damaged: more than {len(whole) - 1} bytes"):
        list(read_points(tmp_path / "out"))


def test_runs_are_counted_whatever_the_filters_of_a_point(command, file, tmp_path, undrawn):
    axis = '[axes."alignment.filters.0"]\nvalues = ["ekf_stamped", "ekf", "l2linf"]\n'
    file.write_text(CAMPAIGN.replace("runs = 5", "runs = 4") + axis)
    campaign, folder = load_campaign(file), tmp_path / "out"
    with Ledger(folder, campaign, resume=False) as kept:
        for shard in campaign.shards:
            runs = range(shard.first_run, shard.first_run + shard.runs)
            scenario = campaign.scenario(shard.point)
            kept.add(
                shard, encoded([r for run in runs for r in failed_rows(scenario, shard.point, run, "x")])
            )
    assert command("report", folder, "--quiet")[0] == 0
    assert "are not done" not in (folder / "report.html").read_text()
    (folder / "shards" / campaign.shards[-1].name).unlink()
    assert command("report", folder, "--quiet")[0] == 0
    assert "2 of 24 runs are not done" in (folder / "report.html").read_text()


def test_rows_have_the_schema(file):
    content = done_shard(load_campaign(file).scenario(0), Shard(0, 0, 1))

    assert pq.read_schema(io.BytesIO(content)).names[:4] == ["point", "run", "filter", "failure"]


def test_one_run_alone_is_that_run_among_the_others(command, file, tmp_path, undrawn):
    scenario, folder = file.with_name("five.toml"), tmp_path / "one"
    status, out, _ = command("run", scenario, "--run-id", 3, "--seed", 7, "--out", folder, "--json")
    assert status == 0
    (row,) = (
        r for r in shard_rows(load_campaign(file).scenario(0), Shard(0, 3, 1)) if r["filter"] == "l2linf"
    )
    assert json.loads(out)["runs"] == 1
    assert json.loads(out)["filters"]["l2linf"]["heading_arcmin"] == pytest.approx(abs(row["heading_arcmin"]))
    status, _, err = command("run", scenario, "--run-id", 3, "--runs", 2)
    assert status == 2
    assert "--run-id: not beside --runs" in err


@pytest.mark.parametrize(
    ("design", "change", "told"),
    [
        ("grid", ("[0.1, 0.2]", "[0.1, 0.2, -3, 0.3]"), "fixes.velocity_sd_mps = -3"),
        ("latin_hypercube", ("[0.1, 0.2]", "[0.1, 0.2, -3, 0.3]"), "fixes.velocity_sd_mps = -3"),
        # Bad at two of 2000 points.
        ("latin_hypercube", ("low = 5", "low = -0.01"), "fixes.position_sd_m = -0.0"),
    ],
)
def test_a_bad_value_among_many_points_is_told_soon(command, file, monkeypatch, design, change, told):
    checked, replaced = [], plan.replaced
    monkeypatch.setattr(plan, "replaced", lambda *how, **more: checked.append(1) or replaced(*how, **more))
    stated = CAMPAIGN.replace("seed = 7", f'seed = 7\ndesign = "{design}"\npoints = 2000')
    for axis in ("position_sd_m", "rate_hz"):
        stated += f'[axes."fixes.{axis}"]\nlow = 5\nhigh = 10\nsteps = 20\n'
    file.write_text(stated.replace(*change, 1))
    status, _, err = command("campaign", file)
    assert status == 2
    assert told in err
    assert len(err.splitlines()) == 1
    # The two at the ends of the design, of both ranges, and some of the values before it.
    assert len(checked) <= 10


def test_a_bad_combination_of_good_values_is_told_in_one_line(command, file):
    fault = '[[faults.imu]]\nkind = "dropped"\nstart_s = 1\nduration_s = 1\n'
    (file.parent / "five.toml").write_text(SCENARIO + fault)
    # Five seconds hold all sums but that of the middle ones.
    axes = [f'[axes."faults.imu.0.{name}_s"]\nvalues = [{values}]\n' for name, values in FAULTS.items()]
    file.write_text(CAMPAIGN.partition("[axes")[0] + "".join(axes))
    status, _, err = command("campaign", file)
    assert status == 2
    assert "at faults.imu.0.start_s = 3.0, faults.imu.0.duration_s = 4.0: scenario: faults.imu[0]" in err
    assert len(err.splitlines()) == 1
    told = []
    file.write_text(file.read_text().replace("3.0", "1.0"))
    load_campaign(file, lambda *done: told.append(done))
    assert told == [(done, 9) for done in range(9)]


FAULTS = {"start": "0.5, 3.0, 0.25", "duration": "1.0, 4.0, 2.0"}


def test_a_plan_that_was_changed_is_refused(command, file, tmp_path, undrawn):
    folder = tmp_path / "out"
    Ledger(folder, load_campaign(file), resume=False).close()
    assert command("report", folder, "--quiet")[0] == 0
    kept = folder / "campaign.json"
    written = kept.read_text()
    for change in (('"runs": 5', '"runs": 4'), ("0.2", "0.25"), ("Fixes of two", "Fixes of 2")):
        kept.write_text(written.replace(*change))
        assert kept.read_text() != written
        for line in (("report", folder), ("campaign", file, "--out", folder, "--resume")):
            status, out, err = command(*line)
            assert (status, out) == (2, "")
            assert f"{kept}: not as it was written" in err
            assert len(err.splitlines()) == 1


@pytest.mark.parametrize(("width", "shown"), [(160, 4), (80, 2), (50, 0)])
def test_points_are_told_apart_however_narrow_the_table(width, shown):
    names = [
        "fixes.position_sd_m",
        "fixes.velocity_sd_mps",
        "flight.s_maneuver.lateral_acceleration_mps2",
        "faults.packets.outlier_share",
    ]
    scores = [
        SimpleNamespace(
            point=point, filter="ekf_stamped", runs=100, failed=0, nees=3.0, rms=dict.fromkeys(RMS, RMS_OF)
        )
        for point in (0, 123)
    ]
    coordinates = [dict(zip(names, (20.5 + i, 0.125, 6.5, 0.01), strict=True)) for i in range(124)]
    content = {"title": "T", "settings": {"axes": dict.fromkeys(names)}, "coordinates": coordinates}
    page = Console(file=io.StringIO(), width=width)
    page.print(campaign_table(SimpleNamespace(plan=content, scores=scores), page))
    lines = page.file.getvalue().splitlines()
    rows = [line.split() for line in lines if "ekf_stamped" in line or "ekf_sta" in line]
    assert [row[0] for row in rows] == ["0", "123"]
    assert [row[1 : shown + 1] for row in rows] == [
        [value, "0.125", "6.5", "0.01"][:shown] for value in ("20.5", "143.5")
    ]
    note = " ".join(" ".join(lines).partition("in the report: ")[2].split())
    assert note == ", ".join(name.rpartition(".")[2] for name in names[shown:])
    assert ("\u2026" in " ".join(lines)) == (width < 60)


RMS, RMS_OF = ("level", "heading", "velocity"), (12.34, 10.0, 15.0)
