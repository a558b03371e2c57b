import csv
from dataclasses import fields, replace

import numpy as np
import pytest
from fleetalign.network.delay import BernoulliDelay, ConstantDelay, NoDelay, ReplayedDelay, UniformDelay
from fleetalign.network.fixes import Fixes, FixesError, concatenate, read_fixes, write_fixes
from fleetalign.network.source import AnyFixSource, FixSource, RecordedFixes, draw_fixes
from fleetalign.network.tables import TableError, write_columns
from fleetalign.sins import earth
from pydantic import TypeAdapter, ValidationError

START, END = 100.0, 900.0
SOURCE = TypeAdapter(AnyFixSource)


class Circle:
    """A level circle, as truth for the sources."""

    def at(self, t):
        angle = 0.05 * t
        d = np.stack([1000 * np.sin(angle), 1000 * (1 - np.cos(angle)), 0 * t], axis=-1)
        v_n = np.stack([50 * np.cos(angle), 50 * np.sin(angle), 0 * t], axis=-1)
        q_nb = np.stack([np.cos(angle / 2), 0 * t, 0 * t, np.sin(angle / 2)], axis=-1)
        return earth.displaced([np.radians(30), np.radians(120), 1015.0], d), v_n, q_nb


def draw(seed=1, end=END, **settings):
    return draw_fixes(Circle(), START, end, FixSource(**settings), np.random.default_rng(seed))


def errors(fixes):
    """Position (NED, m) and velocity errors, (k, 6)."""
    lla, v_n, _ = Circle().at(fixes.t_valid)
    return np.hstack([earth.displacement_n(fixes.lla, lla), fixes.v_n - v_n])


def assert_share(count, n, probability):
    """A binomial count within five deviations."""
    assert abs(count - n * probability) < 5 * np.sqrt(n * probability * (1 - probability))


def assert_equal(fixes, expected, rtol=0.0):
    for field in fields(Fixes):
        np.testing.assert_allclose(
            getattr(fixes, field.name), getattr(expected, field.name), rtol=rtol, err_msg=field.name
        )


def correlated(k=4):
    """A few fixes with full covariances."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(k, 6, 6)) * np.array([10, 10, 10, 0.1, 0.1, 0.1])[:, None]
    lla, v_n, _ = Circle().at(np.arange(k) * 1.0)
    return Fixes(
        t_valid=np.arange(k) * 1.0,
        t_stamp=np.arange(k) + 0.001,
        t_arrival=np.arange(k) + 0.04,
        lla=lla,
        v_n=v_n,
        cov=root @ root.transpose(0, 2, 1),
        source=np.full(k, 7),
        sequence=np.arange(k) + 2**40,
    )


# The source


def test_defaults_are_ten_hertz_ten_metres_and_up_to_fifty_milliseconds():
    source = FixSource()
    assert (source.rate_hz, source.position_sd_m, source.velocity_sd_mps) == (10, 10, 0.1)
    assert source.delay == UniformDelay(min_ms=0, max_ms=50)
    fixes = draw()
    np.testing.assert_allclose(fixes.t_valid, 100 + 0.1 * np.arange(8001), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(fixes.t_stamp, fixes.t_valid)
    np.testing.assert_array_equal(fixes.sequence, np.arange(8001))
    np.testing.assert_array_equal(fixes.source, 0)


@pytest.mark.parametrize(
    ("rate_hz", "end", "count"),
    [(10, 140.0, 401), (3, 101.0, 4), (3, 100.99, 3), (10, 100.0, 1), (10, 100.3 - 1e-9, 4)],
)
def test_fixes_fill_the_interval_from_its_start_to_its_end(rate_hz, end, count):
    fixes = draw(rate_hz=rate_hz, end=end)
    assert len(fixes) == count
    assert fixes.t_valid[0] == START
    assert fixes.t_valid[-1] <= end


def test_interval_that_ends_before_it_starts_is_refused():
    with pytest.raises(FixesError, match=r"100 s to 99 s"):
        draw(end=99.0)


def test_errors_agree_with_their_covariance():
    fixes = draw(position_sd_m=4.0, velocity_sd_mps=0.3, node=3)
    e = errors(fixes)
    k = len(fixes)
    np.testing.assert_allclose(e.std(0), [4, 4, 4, 0.3, 0.3, 0.3], rtol=5 / np.sqrt(2 * k))
    assert np.all(np.abs(e.mean(0)) < 5 / np.sqrt(k) * e.std(0))
    assert np.abs(np.corrcoef(e.T) - np.eye(6)).max() < 5 / np.sqrt(k)
    nees = np.einsum("ki,kij,kj->k", e, np.linalg.inv(fixes.cov), e)
    assert nees.mean() == pytest.approx(6, abs=5 * np.sqrt(12 / k))
    np.testing.assert_array_equal(fixes.source, 3)


@pytest.mark.parametrize(
    ("delay", "mean_s", "sd_s"),
    [
        (NoDelay(), 0.0, 0.0),
        (ConstantDelay(delay_ms=40), 0.04, 0.0),
        (UniformDelay(), 0.025, 0.05 / np.sqrt(12)),
        (UniformDelay(min_ms=20, max_ms=80), 0.05, 0.06 / np.sqrt(12)),
        (BernoulliDelay(), 0.025, 0.025),
        (BernoulliDelay(rho=0.8, step_ms=100), 0.02, 0.04),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_delays_have_the_statistics_that_filters_are_told(delay, mean_s, sd_s):
    assert delay.mean_s == pytest.approx(mean_s)
    assert delay.sd_s == pytest.approx(sd_s)
    fixes = draw(delay=delay)
    lag = fixes.t_arrival - fixes.t_valid
    k = len(lag)
    assert lag.mean() == pytest.approx(mean_s, abs=5 * sd_s / np.sqrt(k) + 1e-12)
    # Five deviations of a deviation: its own is at most 0.8 % here (rho = 0.8, kurtosis 3.25).
    assert lag.std() == pytest.approx(sd_s, rel=0.05, abs=1e-12)
    assert lag.min() > -1e-12
    if isinstance(delay, BernoulliDelay):
        np.testing.assert_allclose(np.unique(lag.round(9)), [0, delay.step_ms / 1000])
        assert_share(np.sum(lag < 1e-9), k, delay.rho)
    if isinstance(delay, UniformDelay):
        assert delay.min_ms <= 1e3 * lag.min() + 1e-9
        assert 1e3 * lag.max() <= delay.max_ms + 1e-9


def test_lost_packets_do_not_arrive():
    all_sent, fixes = draw(), draw(loss_probability=0.3)
    assert_share(len(fixes), len(all_sent), 0.7)
    assert_equal(fixes, all_sent[np.isin(all_sent.sequence, fixes.sequence)])
    assert len(draw(loss_probability=1.0, duplicate_probability=1.0)) == 0


def test_duplicates_repeat_the_packet_at_another_time():
    plain, fixes = draw(), draw(duplicate_probability=0.2)
    assert_share(len(fixes) - len(plain), len(plain), 0.2)
    _, first, counts = np.unique(fixes.sequence, return_index=True, return_counts=True)
    assert set(counts) == {1, 2}
    for sequence in fixes.sequence[first[counts == 2]][:50]:
        pair = fixes[fixes.sequence == sequence]
        assert_equal(replace(pair[:1], t_arrival=pair.t_arrival[1:]), pair[1:])
        assert pair.t_arrival[0] < pair.t_arrival[1] <= pair.t_valid[0] + 0.05
    # The other packets are as they were.
    arrivals = [set(zip(f.sequence.tolist(), f.t_arrival.tolist(), strict=True)) for f in (plain, fixes)]
    assert arrivals[0] < arrivals[1]
    lag = fixes.t_arrival - fixes.t_valid
    assert lag.mean() == pytest.approx(0.025, abs=5 * 0.0145 / np.sqrt(len(fixes)))


def test_detours_break_the_order():
    source = {"out_of_order_probability": 0.25, "out_of_order_max_s": 1.5}
    plain, fixes = draw(), draw(**source)
    assert np.all(np.diff(fixes.t_arrival) >= 0)
    assert np.any(np.diff(fixes.sequence) < 0)
    assert not np.any(np.diff(plain.sequence) < 0)
    in_order = fixes[np.argsort(fixes.sequence)]
    detour = in_order.t_arrival - plain.t_arrival
    assert_share(np.sum(detour > 0), len(plain), 0.25)
    assert 1.4 < detour.max() <= 1.5
    lag = fixes.t_arrival - fixes.t_valid
    told = FixSource(**source)
    assert lag.mean() == pytest.approx(told.delay_mean_s, abs=5 * told.delay_sd_s / np.sqrt(len(lag)))
    assert lag.std() == pytest.approx(told.delay_sd_s, rel=0.07)


def test_stamps_carry_the_error_of_the_clock():
    fixes = draw(stamp_sd_ms=3.0)
    error = fixes.t_stamp - fixes.t_valid
    assert error.std() == pytest.approx(0.003, rel=5 / np.sqrt(2 * len(fixes)))
    assert abs(error.mean()) < 5 * 0.003 / np.sqrt(len(fixes))


@pytest.mark.parametrize(
    ("effect", "changes"),
    [
        ({"position_sd_m": 3.0}, {"lla", "cov"}),
        ({"delay": BernoulliDelay()}, {"t_arrival"}),
        ({"delay": ConstantDelay()}, {"t_arrival"}),
        ({"stamp_sd_ms": 5.0}, {"t_stamp"}),
        ({"out_of_order_probability": 0.3}, {"t_arrival"}),
        ({"loss_probability": 0.3}, set()),
    ],
)
@pytest.mark.parametrize(
    "base", [{}, {"out_of_order_probability": 0.1, "loss_probability": 0.1, "stamp_sd_ms": 1.0}]
)
def test_switching_an_effect_on_leaves_the_draws_of_the_others(effect, changes, base):
    both = [draw(end=200.0, **settings) for settings in (base, base | effect)]
    common = np.intersect1d(*(fixes.sequence for fixes in both))
    assert len(common) > 500
    before, after = (fixes[np.argsort(fixes.sequence)] for fixes in both)
    before, after = (fixes[np.isin(fixes.sequence, common)] for fixes in (before, after))
    changed = {
        field.name
        for field in fields(Fixes)
        if not np.array_equal(getattr(before, field.name), getattr(after, field.name))
    }
    assert changed == changes


def test_a_seed_repeats_and_another_differs():
    busy = {"out_of_order_probability": 0.1, "duplicate_probability": 0.1, "loss_probability": 0.1}
    assert_equal(draw(seed=4, **busy), draw(seed=4, **busy))
    assert not np.array_equal(draw(seed=4, end=110.0).lla, draw(seed=5, end=110.0).lla)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rate_hz": 0}, "rate_hz"),
        ({"position_sd_m": 0}, "position_sd_m"),
        ({"velocity_sd_mps": float("nan")}, "velocity_sd_mps"),
        ({"loss_probability": 1.1}, "loss_probability"),
        ({"out_of_order_max_s": -1}, "out_of_order_max_s"),
        ({"stamp_sd_ms": -1}, "stamp_sd_ms"),
        ({"rate": 10}, "rate"),
        ({"delay": {"kind": "gamma"}}, "'none', 'constant', 'uniform', 'bernoulli', 'replay'"),
        ({"delay": {"kind": "constant", "delay_ms": -1}}, "delay_ms"),
        ({"delay": {"kind": "bernoulli", "rho": 1.5}}, "rho"),
        ({"delay": {"kind": "uniform", "min_ms": 60}}, "min_ms = 60 must not exceed max_ms = 50"),
        ({"delay": {"kind": "replay", "file": "none.csv", "column": "delay_h"}}, "column"),
        ({"delay": {"kind": "replay", "file": "none.csv"}}, "none.csv: no such file"),
        ({"kind": "replay", "file": "none.csv"}, "none.csv: no such file"),
        ({"kind": "oracle"}, "'simulated', 'replay'"),
    ],
)
def test_impossible_sources_are_refused(settings, message):
    with pytest.raises(ValidationError, match=message):
        SOURCE.validate_python(settings)


# Recordings


@pytest.mark.parametrize(("column", "unit_s"), [("delay_ms", 1e-3), ("wait_s", 1.0)])
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_recorded_delays_are_replayed_in_order(tmp_path, suffix, column, unit_s):
    delays = np.array([10, 30, 20])
    write_columns({column: delays * 1e-3 / unit_s}, tmp_path / f"delays{suffix}")
    source = SOURCE.validate_python(
        {"delay": {"kind": "replay", "file": f"delays{suffix}", "column": column}},
        context={"folder": tmp_path},
    )
    assert isinstance(source, FixSource)
    assert source.delay.mean_s == pytest.approx(0.02)
    assert source.delay.sd_s == pytest.approx(np.std(delays) * 1e-3)
    starts = set()
    for seed in range(30):
        fixes = draw_fixes(Circle(), 0.0, 0.6, source, np.random.default_rng(seed))
        lag = 1e3 * (fixes.t_arrival - fixes.t_valid)
        (start,) = np.flatnonzero(np.isclose(delays, lag[0]))
        np.testing.assert_allclose(lag, np.resize(np.roll(delays, -start), 7))
        starts.add(start)
    # Each row is missed by all 30 seeds once in 190 thousand.
    assert starts == {0, 1, 2}


def test_duplicates_have_recorded_delays_of_their_own(tmp_path):
    write_columns({"delay_ms": np.arange(1.0, 51.0)}, tmp_path / "delays.csv")
    fixes = draw(end=200.0, delay=ReplayedDelay(file=tmp_path / "delays.csv"), duplicate_probability=1.0)
    of_sequence = fixes.t_arrival[np.argsort(fixes.sequence, kind="stable")].reshape(-1, 2)
    assert len(of_sequence) == 1001
    assert np.all(of_sequence[:, 1] - of_sequence[:, 0] > 0.9e-3)


@pytest.mark.parametrize("value", [-1.0, 60_001.0])
def test_recorded_delays_must_be_delays(tmp_path, value):
    file = tmp_path / "delays.csv"
    write_columns({"delay_ms": [1.0, value]}, file)
    with pytest.raises(ValidationError, match=r"delays.csv, column delay_ms, row 2: .*0 to 60000"):
        ReplayedDelay(file=file)


def test_recorded_delays_must_be_numbers(tmp_path):
    write_columns({"delay_ms": [True, False]}, tmp_path / "delays.parquet")
    with pytest.raises(ValidationError, match="column delay_ms: holds bool, not numbers"):
        ReplayedDelay(file=tmp_path / "delays.parquet")


def test_recorded_delays_must_not_be_empty(tmp_path):
    write_columns({"delay_ms": np.zeros(0)}, tmp_path / "delays.csv")
    with pytest.raises(ValidationError, match="no rows"):
        ReplayedDelay(file=tmp_path / "delays.csv")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize(
    "fixes",
    [
        correlated(),
        draw(end=110.0, duplicate_probability=0.3, out_of_order_probability=0.3, stamp_sd_ms=1),
        correlated()[:0],
    ],
    ids=["correlated", "drawn", "empty"],
)
def test_fixes_come_back_from_a_file(tmp_path, suffix, fixes):
    write_fixes(fixes, tmp_path / f"fixes{suffix}")
    # Degrees to radians and correlations to covariances cost a few roundings.
    assert_equal(read_fixes(tmp_path / f"fixes{suffix}"), fixes, rtol=1e-14)


def test_file_holds_degrees_and_standard_deviations(tmp_path):
    write_fixes(correlated(), tmp_path / "fixes.csv")
    with (tmp_path / "fixes.csv").open() as file:
        row = next(csv.DictReader(file))
    cov = correlated().cov[0]
    assert float(row["lat_deg"]) == pytest.approx(30)
    assert float(row["lon_deg"]) == pytest.approx(120)
    assert float(row["height_m"]) == pytest.approx(1015)
    assert float(row["v_north_mps"]) == pytest.approx(50)
    assert float(row["sd_v_down_mps"]) == pytest.approx(np.sqrt(cov[5, 5]))
    assert float(row["corr_east_v_north"]) == pytest.approx(cov[1, 3] / np.sqrt(cov[1, 1] * cov[3, 3]))


def test_recorded_fixes_are_cut_to_the_interval(tmp_path):
    fixes = draw(end=110.0, delay=ConstantDelay(delay_ms=30))
    write_fixes(fixes, tmp_path / "fixes.parquet")
    source = SOURCE.validate_python(
        {"kind": "replay", "file": "fixes.parquet"}, context={"folder": str(tmp_path)}
    )
    assert isinstance(source, RecordedFixes)
    assert source.delay_mean_s == pytest.approx(0.03)
    assert source.delay_sd_s == pytest.approx(0, abs=1e-12)
    replayed = draw_fixes(Circle(), 103.95, 106.05, source, np.random.default_rng(0))
    assert_equal(replayed, fixes[40:61], rtol=1e-14)


def test_recorded_fixes_must_not_be_empty(tmp_path):
    write_fixes(correlated()[:0], tmp_path / "fixes.csv")
    with pytest.raises(ValidationError, match="no rows"):
        RecordedFixes(file=tmp_path / "fixes.csv")


def test_recorded_fixes_are_sorted_by_arrival(tmp_path):
    write_fixes(replace(correlated(), t_arrival=np.array([5.0, 2.0, 4.0, 3.0])), tmp_path / "fixes.csv")
    np.testing.assert_array_equal(read_fixes(tmp_path / "fixes.csv").t_valid, [1, 3, 2, 0])


@pytest.mark.parametrize(
    ("column", "cell", "message"),
    [
        ("lat_deg", "95", "95 is not allowed (-90 to 90)"),
        ("v_north_mps", "fast", "'fast' is not a finite number"),
        ("height_m", "", "an empty cell is not a finite number"),
        ("t_stamp_s", "nan", "is not a finite number"),
        ("sd_east_m", "0", "0 is not allowed (1e-06 to 1000000)"),
        ("sequence", "1.5", "1.5 is not allowed (a whole number)"),
        ("source", "-1", "-1 is not allowed (0 to"),
        ("t_arrival_s", "1.5", "1.5 is not allowed (t_valid_s or later)"),
        ("corr_north_east", "1.5", "1.5 is not allowed (-1 to 1)"),
    ],
)
def test_wrong_cell_is_named(tmp_path, column, cell, message):
    file = tmp_path / "fixes.csv"
    write_fixes(correlated(), file)
    with file.open() as written:
        rows = list(csv.reader(written))
    rows[3][rows[0].index(column)] = cell
    with file.open("w") as out:
        csv.writer(out).writerows(rows)
    with pytest.raises(TableError) as caught:
        read_fixes(file)
    text = str(caught.value)
    assert text.startswith(f"{file}, column {column}, row 3: ")
    assert message in text
    assert "\n" not in text
    assert (caught.value.column, caught.value.row) == (column, 3)
    assert caught.value.allowed is not None


def test_impossible_correlations_are_named(tmp_path):
    fixes = correlated()
    cov = np.tile(np.eye(6), (4, 1, 1))
    # Each pair may be so, the three together not.
    for i, j, value in ((0, 1, 0.9), (0, 2, 0.9), (1, 2, -0.9)):
        cov[1, i, j] = cov[1, j, i] = value
    write_fixes(replace(fixes, cov=cov), tmp_path / "fixes.csv")
    with pytest.raises(TableError, match=r"row 2: .*eigenvalue"):
        read_fixes(tmp_path / "fixes.csv")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text.replace("lat_deg", "latitude"), "no column lat_deg; it has t_valid_s, "),
        (lambda text: text.replace("corr_north_east", "corr_nort_east"), "unknown column corr_nort_east"),
        (lambda text: text.replace("lon_deg", "lat_deg"), "column lat_deg: stands there more than once"),
        (lambda text: text + "1,2\n", "got 2"),
        (lambda text: "", "mpty"),
    ],
)
def test_wrong_table_is_explained_in_one_line(tmp_path, edit, message):
    file = tmp_path / "fixes.csv"
    write_fixes(correlated(), file)
    file.write_text(edit(file.read_text()))
    with pytest.raises(TableError) as caught:
        read_fixes(file)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_files_are_explained(tmp_path):
    (tmp_path / "broken.parquet").write_text("not parquet at all")
    for file, message in (
        ("fixes.xlsx", "csv or .parquet"),
        ("none.csv", "no such"),
        ("broken.parquet", "arquet"),
    ):
        with pytest.raises(TableError, match=message):
            read_fixes(tmp_path / file)
    with pytest.raises(TableError, match=r"csv or .parquet"):
        write_fixes(correlated(), tmp_path / "fixes.xlsx")


# The type


def test_concatenated_receptions_are_in_order_of_arrival():
    fixes = draw(end=110.0)
    assert_equal(concatenate([fixes[1::2], fixes[::2]]), fixes)


def test_packets_that_arrive_together_keep_their_order():
    fixes = draw(end=110.0)
    together = 200.0 + (fixes.sequence % 3)
    kept = replace(fixes, t_arrival=together).sorted_by_arrival()
    np.testing.assert_array_equal(kept.sequence, np.r_[0:101:3, 1:101:3, 2:101:3])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("lla", np.zeros((4, 2)), r"lla must be float64 \(4, 3\); got float64 \(4, 2\)"),
        ("cov", np.zeros((4, 6)), r"cov must be float64 \(4, 6, 6\)"),
        ("sequence", np.zeros(4), r"sequence must be int64 \(4,\); got float64"),
        ("v_n", [[0.0] * 3] * 4, "v_n must be float64 .* got list"),
        ("t_stamp", np.array([0, 1, np.nan, 3]), "t_stamp must be finite"),
    ],
)
def test_arrays_that_do_not_make_fixes_are_refused(name, value, message):
    with pytest.raises(FixesError, match=message):
        replace(correlated(), **{name: value})


def test_what_is_not_a_number_may_arrive():
    fixes = correlated()
    fixes.lla[1] = np.nan
    assert len(replace(fixes)) == 4
