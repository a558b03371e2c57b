"""Scenario files: mistakes are told in one line each, with file, field, value, unit and allowed range."""

import numpy as np
import pytest
from fleetalign.align.methods import METHODS
from fleetalign.cosim.scenario import ScenarioError, load_scenario, replaced, scenario_names
from fleetalign.network.fixes import write_fixes
from fleetalign.network.source import draw_fixes

GOOD = 'title = "A test"\n'


def refused(tmp_path, text):
    """Lines of the error that a file with this text raises."""
    path = tmp_path / "mine.toml"
    path.write_text(text, "utf-8")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(path))
    lines = str(caught.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    return [line.removeprefix(f"{path}: ") for line in lines]


def test_bundled_scenario_is_the_papers(gao2009):
    assert "gao2009" in scenario_names()
    assert gao2009.flight.altitude_m == 1015
    assert gao2009.flight.speed_mps == 200
    assert (gao2009.flight.start.longitude_deg, gao2009.flight.start.latitude_deg) == (120, 30)
    assert gao2009.flight.s_maneuver.duration_s <= 40
    assert (gao2009.imu.gyro_bias_deg_h, gao2009.imu.accel_bias_ug) == (0.02, 100)
    assert gao2009.paper.ekf.heading_arcmin == 5.12
    assert gao2009.paper.l2linf.v_north_mps == 0.022


def test_a_file_states_only_what_differs(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + "[fixes]\nrate_hz = 5\n", "utf-8")
    name, scenario = load_scenario(str(path))
    assert name == "mine"
    assert scenario.fixes.rate_hz == 5
    assert scenario.fixes.position_sd_m == 10


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "title: missing"),
        (GOOD + "runs = 0", "runs = 0: allowed is [1, 100000]"),
        (GOOD + "extra = 1", "extra: unknown field"),
        (
            GOOD + "[imu]\ngyro_bias_deg_h = -1.0",
            "imu.gyro_bias_deg_h = -1.0 deg/h: allowed is [0, 10000] deg/h",
        ),
        (GOOD + "[imu]\nvibration_mps = nan", "imu.vibration_mps = nan m/s: allowed is [0, 10] m/s"),
        (GOOD + "[imu]\nvibration_mps = inf", "imu.vibration_mps = inf m/s: allowed is [0, 10] m/s"),
        (
            GOOD + "[flight.s_maneuver]\nduration_s = 41",
            "flight.s_maneuver.duration_s = 41 s: allowed is [5, 40] s",
        ),
        (
            GOOD + '[fixes]\ndelay = { kind = "uniform", max_ms = 1e9 }',
            "fixes.delay.max_ms = 1000000000.0 ms: allowed is [0, 60000] ms",
        ),
        (
            GOOD + '[alignment]\nfilters = ["kalman"]',
            f"alignment.filters = ['kalman']: no filter 'kalman'; known: {', '.join(METHODS)}",
        ),
        (
            GOOD + "[alignment.settings]\ngate_probability = 1",
            "alignment.settings.gate_probability = 1: allowed is (0.5, 1)",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, text, line):
    assert refused(tmp_path, text) == [line]


def test_every_mistake_is_told(tmp_path):
    lines = refused(tmp_path, "runs = -1\nseed = 'x'\n")
    assert len(lines) == 3


def test_unknown_airframe_is_refused_with_the_known_ones(tmp_path):
    (line,) = refused(tmp_path, GOOD + '[flight]\nairframe = "b52"')
    assert "flight.airframe" in line
    assert "b52" in line
    assert "f16" in line


def test_unknown_kind_of_delay_is_refused_with_the_known_ones(tmp_path):
    (line,) = refused(tmp_path, GOOD + '[fixes]\ndelay = { kind = "poisson" }')
    assert "fixes.delay" in line
    assert "bernoulli" in line


def test_broken_toml_names_the_place(tmp_path):
    (line,) = refused(tmp_path, "title = \n")
    assert "not TOML" in line
    assert "line 1" in line


def test_text_that_is_not_utf8_is_refused(tmp_path):
    path = tmp_path / "latin.toml"
    path.write_bytes(b'title = "\xe9"')
    with pytest.raises(ScenarioError, match="UTF-8"):
        load_scenario(str(path))


@pytest.mark.parametrize("name", ["nothing", "nothing.toml"])
def test_missing_scenario_is_refused(name):
    with pytest.raises(ScenarioError, match="nothing"):
        load_scenario(name)


def test_data_files_are_beside_the_scenario(tmp_path):
    (tmp_path / "delays.csv").write_text("delay_ms\n10\n30\n", "utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + '[fixes]\ndelay = { kind = "replay", file = "delays.csv" }\n', "utf-8")
    scenario = load_scenario(str(path))[1]
    assert scenario.fixes.delay_mean_s == pytest.approx(0.02)
    before = scenario.digest
    (tmp_path / "delays.csv").write_text("delay_ms\n10\n50\n", "utf-8")
    assert load_scenario(str(path))[1].digest != before


@pytest.mark.parametrize(
    "table", ['delay = { kind = "replay", file = "delays.csv" }', 'kind = "replay"\nfile = "fixes.csv"']
)
def test_digest_depends_on_what_a_file_holds_and_not_on_where_it_is(
    tmp_path, monkeypatch, stated, window, table
):
    fixes = draw_fixes(window, 500, 501, stated.fixes, np.random.default_rng(1))
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "delays.csv").write_text("delay_ms\n10\n30\n", "utf-8")
        (tmp_path / folder / "mine.toml").write_text(f"{GOOD}[fixes]\n{table}\n", "utf-8")
        write_fixes(fixes, tmp_path / folder / "fixes.csv")
    digests = set()
    for folder, path in (("", "a/mine.toml"), ("", "b/mine.toml"), ("a", "mine.toml")):
        monkeypatch.chdir(tmp_path / folder)
        digests.add(load_scenario(path)[1].digest)
    assert len(digests) == 1


def test_replaced_checks_like_a_file(gao2009):
    assert replaced(gao2009, {"imu.vibration_mps": 0.5}).imu.vibration_mps == 0.5
    with pytest.raises(ScenarioError, match=r"imu.vibration_mps = -1 m/s"):
        replaced(gao2009, {"imu.vibration_mps": -1})
    with pytest.raises(ScenarioError, match="unknown field"):
        replaced(gao2009, {"imu.nothing.more": 1})


LISTS = """
outages = [{ start_s = 2.0, duration_s = 1.0 }, { start_s = 8.0, duration_s = 1.0 }]
[faults]
imu = [{ kind = "nan", start_s = 1.0 }]
[flight]
s_start_s = 300
failures = [{ kind = "engine_out", time_s = 8.0 }]
[fixes]
kind = "network"
[fixes.faults]
lies = [{ kind = "ramp", nodes = [1], start_s = 3.0 }]
[variants.later]
"outages.1.start_s" = 9.0
"faults.imu.0" = { kind = "infinity", start_s = 4.0 }
"""


def test_dotted_names_reach_into_lists(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + LISTS, "utf-8")
    scenario = load_scenario(str(path))[1]
    names = ("faults.imu.0.start_s", "fixes.faults.lies.0.start_s", "outages.0.duration_s")
    changed = replaced(scenario, dict.fromkeys((*names, "flight.failures.0.time_s"), 1.5))
    assert changed.faults.imu[0].start_s == 1.5
    assert changed.fixes.faults.lies[0].start_s == 1.5
    assert [outage.duration_s for outage in changed.outages] == [1.5, 1.0]
    assert changed.flight.failures[0].time_s == 1.5
    later = scenario.variant("later")
    assert [outage.start_s for outage in later.outages] == [2.0, 9.0]
    assert (later.faults.imu[0].kind, later.faults.imu[0].start_s) == ("infinity", 4.0)
    assert scenario.outages[1].start_s == 8.0


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("outages.2.start_s", "outages.2.start_s: outages has entries 0 to 1, and not 2"),
        ("outages.2", "outages.2: outages has entries 0 to 1, and not 2"),
        ("outages.-1.start_s", "outages.-1.start_s: outages has entries 0 to 1, and not -1"),
        ("outages.01.start_s", "outages.01.start_s: outages has entries 0 to 1, and not 01"),
        ("outages.first.start_s", "outages.first.start_s: outages has entries 0 to 1, and not first"),
        ("outages.\u0661.start_s", "outages.\u0661.start_s: outages has entries 0 to 1, and not \u0661"),
        ("faults.imu.1.start_s", "faults.imu.1.start_s: faults.imu has entry 0, and not 1"),
        (
            "flight.air.gusts.0.start_s",
            "flight.air.gusts.0.start_s: flight.air.gusts has no entry, and not 0",
        ),
        ("outages.0.start_s.0", "outages.0.start_s.0: unknown field"),
        ("outages.0.nothing", "outages.0.nothing: unknown field"),
        ("imu.0", "imu.0: unknown field"),
    ],
)
def test_dotted_names_that_reach_nothing_are_told_in_a_line(tmp_path, name, told):
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + LISTS, "utf-8")
    with pytest.raises(ScenarioError) as caught:
        replaced(load_scenario(str(path))[1], {name: 1.0}, "point 3")
    assert str(caught.value) == f"point 3: {told}"


def test_digest_depends_on_content_alone(gao2009):
    assert gao2009.digest == load_scenario("gao2009")[1].digest
    assert gao2009.digest != replaced(gao2009, {"seed": 2}).digest
