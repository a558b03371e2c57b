"""The command line: what it writes, what it prints, and how it refuses."""

import io
import json
import os
import signal

import numpy as np
import pyarrow.parquet as pq
import pytest
from fleetalign.aircraft import cache
from fleetalign.aircraft.envelope import FlightError
from fleetalign.cosim import outputs, terminal
from fleetalign.cosim.run import simulate
from fleetalign.cosim.score import COLUMNS
from rich.console import Console

FILES = {"summary.json", "estimates.parquet", "recording.rrd", "report.html", "manifest.json"}
SHORT = """
title = "A short alignment"
runs = 3
[flight]
s_start_s = 150
tail_s = 1
[alignment]
filters = ["l2linf", "ekf_stamped"]
"""


def test_run_writes_the_files_of_the_contract(command, tmp_path):
    status, out, _ = command("run", "gao2009", "--runs", 2, "--seed", 7, "--out", tmp_path / "new" / "out")
    assert status == 0
    folder = tmp_path / "new" / "out"
    assert {path.name for path in folder.iterdir()} == FILES
    assert str(folder / "report.html") in out.replace("\n", "")
    assert "paper: Gao et al., Table 3" in out

    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["scenario"], summary["seed"], summary["runs"]) == ("gao2009", 7, 2)
    flight = summary["flight"]
    assert flight["altitude_m"] == pytest.approx(1015, abs=1)
    assert flight["speed_mps"] == pytest.approx(200, abs=0.5)
    assert flight["s_duration_s"] <= 40
    assert flight["s_altitude_deviation_m"] < 10
    assert set(summary["filters"]) == {"ekf", "ekf_stamped", "l2linf"}
    for row in summary["filters"].values():
        assert set(COLUMNS) <= set(row)
        assert set(row["window"]) == set(COLUMNS)
        assert row["failed_runs"] == 0
        assert {"level_below_60_arcsec_s", "heading_below_5_arcmin_s", "nees", "nis"} <= set(row)
    assert set(summary["bound"]["stamped"]) == set(COLUMNS)
    assert summary["paper"]["l2linf"]["pitch_arcsec"] == 21.14

    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["seed"] == 7
    assert len(manifest["scenario_sha256"]) == 64
    assert manifest["versions"]["jsbsim"]

    estimates = pq.read_table(folder / "estimates.parquet").to_pydict()
    assert set(estimates["run"]) == {0, 1}
    final = np.array(estimates["time_s"]) == max(estimates["time_s"])
    mine = np.array(estimates["filter"]) == "l2linf"
    errors = np.array(estimates["error_roll_arcsec"], float)[final & mine]
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(summary["filters"]["l2linf"]["roll_arcsec"], rel=1e-5)


@pytest.mark.usefixtures("undrawn")
def test_run_takes_a_file_and_filters_and_prints_json(command, tmp_path):
    scenario = tmp_path / "short.toml"
    scenario.write_text(SHORT, "utf-8")
    arguments = ("run", scenario, "--filter", "l2linf", "--json", "--out")
    status, out, err = command(*arguments, tmp_path / "a")
    assert (status, err) == (0, "")
    summary = json.loads(out)
    assert set(summary["filters"]) == {"l2linf"}
    assert summary["runs"] == 3
    assert "paper" not in summary
    _, again, _ = command(*arguments, tmp_path / "b")
    assert again == out
    assert pq.read_table(tmp_path / "a/estimates.parquet") == pq.read_table(tmp_path / "b/estimates.parquet")


@pytest.mark.usefixtures("undrawn")
def test_run_that_is_stopped_keeps_what_it_has(command, tmp_path, monkeypatch):
    from fleetalign.cosim import run as run_module

    real = run_module.simulate_all

    def stopping(*arguments, **options):
        for run in real(*arguments, **options):
            yield run
            if run.run_id == 1:
                os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(run_module, "simulate_all", stopping)
    scenario, folder = tmp_path / "short.toml", tmp_path / "out"
    scenario.write_text(SHORT, "utf-8")
    status, _, err = command("run", scenario, "--runs", 30, "--quiet", "--out", folder)
    assert status == 1
    assert "after 3 of 30" in err
    # The run in hand when Ctrl-C came is done whole, for all filters and in all files.
    assert json.loads((folder / "summary.json").read_text())["runs"] == 3
    rows = pq.read_table(folder / "estimates.parquet").group_by(["run", "filter"]).aggregate([])
    assert rows.num_rows == 3 * 2
    assert json.loads((folder / "manifest.json").read_text())["runs"] == 3
    assert {path.name for path in folder.iterdir()} == FILES


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("fixes", "without"), [("loss_probability = 1.0", 3), ("loss_probability = 0.5\nrate_hz = 0.3", 1)]
)
def test_runs_without_a_fix_are_named_and_leave_all_files(command, tmp_path, fixes, without):
    scenario = tmp_path / "lost.toml"
    scenario.write_text(f"{SHORT}duration_s = 5\n[fixes]\n{fixes}\n", "utf-8")
    status, out, _ = command("run", scenario, "--out", tmp_path / "out")
    assert status == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    for name, row in summary["filters"].items():
        assert list(row["failures"].values()).count("no_fix") == without
        assert (row["roll_arcsec"] is None) == (without == 3)
        (line,) = (line.split() for line in out.splitlines() if line.startswith(f" {name} "))
        assert (line[1] == "-") == (without == 3)
        assert line[-1] == str(row["failed_runs"])


def test_run_that_breaks_leaves_no_estimates(tmp_path, stated, window):
    done = simulate(stated, window, 0, seed=1)
    path = tmp_path / "estimates.parquet"

    def broken_off(error):
        with outputs.estimates_writer(path, window, 0.0) as estimates:
            estimates.add(done)
            estimates.flush()
            assert list(tmp_path.iterdir())
            raise error

    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            broken_off(error)
        assert list(tmp_path.iterdir()) == []
    with outputs.estimates_writer(path, window, 0.0) as estimates:
        estimates.add(done)
    assert list(tmp_path.iterdir()) == [path]
    assert set(pq.read_table(path)["run"].to_pylist()) == {0}


def test_standard_deviations_hold_the_vibration(tmp_path, stated, window):
    done = simulate(stated, window, 0, seed=1)
    path = tmp_path / "estimates.parquet"
    with outputs.estimates_writer(path, window, 3.0) as estimates:
        estimates.add(done)
    estimate = done.estimates["l2linf"]
    table = pq.read_table(path, filters=[("filter", "=", "l2linf")]).to_pydict()
    np.testing.assert_allclose(table["sd_v_east_mps"], np.hypot(estimate.sd[:, 4], 3.0), rtol=1e-6)
    np.testing.assert_allclose(table["sd_v_north_mps"], np.hypot(estimate.sd[:, 3], 3.0), rtol=1e-6)


def test_fly_tells_and_writes_the_flight(command, tmp_path, flight):
    status, out, _ = command("fly", "gao2009", "--out", tmp_path, "--json")
    assert status == 0
    assert json.loads(out) == flight.summary | {"failures": [], "gusts": []}
    table = pq.read_table(tmp_path / "flight.parquet").to_pydict()
    np.testing.assert_allclose(table["height_m"], flight.lla[:, 2])
    np.testing.assert_allclose(table["dv_z_mps"], flight.dv_b[:, 2])
    status, out, _ = command("fly")
    assert "s_maneuver" in out


def test_fly_tells_what_befell_the_flight(command, tmp_path, monkeypatch, flight):
    monkeypatch.setattr("fleetalign.cosim.fly_command.flown", lambda *_: flight)
    file = tmp_path / "mine.toml"
    file.write_text(
        'title = "x"\n[flight]\nfailures = [{ kind = "stuck", control = "rudder", time_s = 510.0 },'
        ' { kind = "engine_out", time_s = 515.0 }]\n'
        "[flight.air]\ngusts = [{ start_s = 20.0, rise_s = 1.0, hold_s = 2.0, down_mps = -5.0 },"
        " { start_s = 4000.0 }]\n"
    )
    status, out, _ = command("fly", file)
    assert status == 0
    # By the clock; the other gust would come after the end.
    assert [" ".join(line.split()) for line in out.splitlines()[-3:]] == [
        "gust at 20.00 s: 0, 0, -5 m/s north, east, down, for 4 s",
        "failure at 510.00 s: the rudder stuck",
        "failure at 515.00 s: engine 1 went out",
    ]
    told = json.loads(command("fly", file, "--json")[1])
    assert [failure["time_s"] for failure in told["failures"]] == [510.0, 515.0]
    assert [gust["down_mps"] for gust in told["gusts"]] == [-5.0, 0.0]


def test_check_and_list(command):
    assert command("check", "gao2009")[0] == 0
    status, out, _ = command("list")
    assert status == 0
    for name in ("gao2009", "f16", "f4n", "t38", "a4", "ekf", "ekf_stamped", "l2linf"):
        assert name in out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("check", "nothing.toml"), "nothing.toml: cannot be read"),
        (("check", "n" * 300), "neither a bundled scenario"),
        (("run", "--runs", "0"), "option: runs = 0: allowed is [1, 100000]"),
        (("run", "--runs", "many"), "--runs"),
        (("run", "--seed", "-1"), "option: seed = -1"),
        (("run", "--filter", "kalman"), "no filter 'kalman'"),
        (("run", "--out", "/proc/no/where"), "--out /proc/no/where: cannot be written"),
        (("run", "--colour"), "--colour"),
        (("land",), "land"),
    ],
)
def test_mistakes_end_with_one_line_and_status_2(command, arguments, told):
    status, out, err = command(*arguments)
    assert status == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert told in err


def test_flight_that_cannot_be_flown_ends_with_one_line(command, tmp_path):
    scenario = tmp_path / "weak.toml"
    scenario.write_text('title = "x"\n[flight.start]\nrunway_length_m = 100\n', "utf-8")
    status, _, err = command("run", scenario, "--quiet", "--out", tmp_path / "out")
    assert status == 2
    assert "takeoff" in err
    assert len(err.splitlines()) == 1


def test_flight_model_at_fault_is_not_the_users_mistake(command, monkeypatch):
    def missing(*_, **__):
        raise FlightError("preparation", 0.0, "the flight model has no property 'x'")

    monkeypatch.setattr(cache, "cached_flight", missing)
    status, _, err = command("fly", "--quiet")
    assert status == 1
    assert err.splitlines() == [
        "fleetalign: flight failed in phase preparation at 0.00 s: the flight model has no property 'x'"
    ]


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('[alignment]\nstart = "landing"', "alignment.start = 'landing': neither seconds"),
        ("[alignment]\nstart = -1.0", "alignment.start = -1.0: neither seconds"),
        ("[alignment]\nstart = inf", "alignment.start = inf: neither seconds"),
        ("[alignment]\nstart = true", "alignment.start = True: neither seconds"),
        ("[alignment]\nstart = [1]", "alignment.start = [1]: neither seconds"),
        ("[imu]\nvibration_mps = true", "imu.vibration_mps = True m/s: allowed is [0, 10] m/s"),
        ('runs = "100"', "runs = '100': allowed is [1, 100000]"),
        ("fixes = 3", "fixes = 3:"),
        ("[[fixes]]", "fixes"),
        (f"seed = {'9' * 5000}", "not TOML"),
        (f"a = {'[' * 20000}", "not TOML"),
        ("[alignment]\nstart = 9000.0", "alignment from 9000 s for 40 s does not end before the flight"),
        ("[alignment]\nduration_s = 60", "alignment from 500 s for 60 s does not end before the flight"),
        ("[flight.s_maneuver]\nlateral_acceleration_mps2 = 25", "guidance allows the F-16"),
        ('[fixes]\nkind = "replay"\nfile = "none.csv"', "none.csv"),
    ],
)
def test_check_refuses_what_cannot_be_run(command, tmp_path, line, told):
    scenario = tmp_path / "mine.toml"
    scenario.write_text(f'title = "x"\n{line}\n', "utf-8")
    status, _, err = command("check", scenario)
    assert status == 2
    assert told in err
    assert len(err.splitlines()) == 1


@pytest.mark.usefixtures("undrawn")
def test_titles_and_paths_are_printed_as_they_are(command, tmp_path):
    scenario = tmp_path / "marked.toml"
    scenario.write_text(SHORT.replace("A short alignment", "[/bold] [red]x"), "utf-8")
    assert "[/bold] [red]x" in command("check", scenario)[1]
    status, out, _ = command("run", scenario, "--runs", 1, "--out", tmp_path / "out[b]x")
    assert status == 0
    assert "[/bold] [red]x" in out
    assert "out[b]x/report.html" in out.replace("\n", "")


def test_level_flight_must_last_a_moment(command, tmp_path):
    settled = json.loads(command("fly", "gao2009", "--json")[1])["s_start_s"]
    assert settled == 500
    scenario = tmp_path / "early.toml"
    scenario.write_text('title = "x"\n[flight]\ns_start_s = 120.5\n', "utf-8")
    status, _, err = command("fly", scenario, "--quiet")
    assert status == 2
    assert "has not settled" in err


def test_alignment_in_a_phase_that_ends_too_late_ends_with_one_line(command, tmp_path):
    scenario = tmp_path / "late.toml"
    scenario.write_text(SHORT + 'start = "level"\nduration_s = 300\n', "utf-8")
    status, _, err = command("run", scenario, "--quiet", "--out", tmp_path / "out")
    assert status == 2
    assert "late.toml: alignment" in err
    assert len(err.splitlines()) == 1


@pytest.fixture
def clock(monkeypatch):
    """The time by which progress goes, in a list."""
    now = [1000.0]
    monkeypatch.setattr(terminal, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(("later_s", "left"), [(0, "0:00:44"), (36, "0:00:08"), (100, "-:--:--")])
def test_the_rate_of_lumps_is_that_of_all_the_time(clock, monkeypatch, later_s, left):
    """Two shards end within half a second, after a minute; 20 runs are of a command before."""
    shown = io.StringIO()
    monkeypatch.setattr(terminal, "error_console", Console(file=shown, force_terminal=True, width=120))
    with terminal.progress_bar("campaign", False, "runs") as progress:
        progress(20, 160)
        for done, after_s in ((60, 57.0), (100, 0.5)):
            clock[0] += after_s
            progress(done, 160)
        clock[0] += later_s
    # 80 runs in 57.5 s; 60 are left.
    last = shown.getvalue().replace("\x1b[0m", "").rpartition("100/160")[2]
    assert "1.39 runs/s" in last
    assert left in last


@pytest.mark.parametrize(("total", "apart"), [(1000, 100), (420, 60), (100_000, 600)])
def test_where_nobody_watches_progress_is_a_line_now_and_then(clock, capfd, total, apart):
    """Of one run a second: a line each tenth of the work, but each minute at most, each ten at least."""
    with terminal.progress_bar("campaign", False, "runs") as progress:
        for done in range(0, min(total, 2000) + 1, 10):
            progress(done, total)
            clock[0] += 10
    out, err = capfd.readouterr()
    first, second, *_ = lines = err.splitlines()
    assert out == ""
    assert [int(line.split()[1]) for line in lines] == list(range(10, min(total, 2001), apart))
    assert first.startswith(f"campaign: 10 of {total} runs, 1 runs/s, ")
    if total == 1000:
        assert second == "campaign: 110 of 1000 runs, 1 runs/s, 0:14:50 left"


@pytest.mark.parametrize(
    ("silent", "pause_s", "told"),
    [(False, 1.0, "aligning: 20%, 0:00:08 left\n"), (False, 0.1, ""), (True, 1.0, "")],
)
def test_what_is_over_soon_or_silent_has_no_line_of_progress(clock, capfd, silent, pause_s, told):
    with terminal.progress_bar("aligning", silent) as progress:
        for done in range(11):
            progress(done, 10)
            clock[0] += pause_s
    assert capfd.readouterr().err == told
