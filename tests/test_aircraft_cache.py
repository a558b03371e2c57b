"""The flight cache returns what was flown, and nothing else."""

import os
import time
import warnings

import numpy as np
import pytest
from fleetalign.aircraft import cache
from fleetalign.aircraft.cache import CacheWarning, cached_flight, flight_key
from fleetalign.aircraft.flight import Flight
from fleetalign.aircraft.mission import Air, FlightPlan, SManeuver
from fleetalign.aircraft.simulator import fly

PLAN = FlightPlan(s_start_s=130.0, s_maneuver=SManeuver(duration_s=5.0), tail_s=0.0, fdm_rate_hz=100)
ARRAYS = ("time", "lla", "v_n", "q_nb", "dtheta_b", "dv_b")


@pytest.fixture(scope="module")
def flown() -> Flight:
    return fly(PLAN)


@pytest.fixture
def flights(monkeypatch, tmp_path, flown):
    """An empty cache folder, and a list that grows with each flight that is really flown."""
    monkeypatch.setenv(cache.FOLDER_VARIABLE, str(tmp_path / "flights"))
    flights = []

    def counted_fly(plan, progress=None):
        flights.append(plan)
        return flown

    monkeypatch.setattr(cache, "fly", counted_fly)
    return flights


def entry():
    (path,) = cache.cache_folder().iterdir()
    return path


def same(one: Flight, other: Flight) -> bool:
    arrays = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)
    facts = (one.phases, one.airframe, one.gravity) == (other.phases, other.airframe, other.gravity)
    return arrays and facts and type(one.gravity) is type(other.gravity)


def test_second_time_is_read(flights, flown):
    first, hit = cached_flight(PLAN)
    assert not hit
    assert same(first, flown)
    second, hit = cached_flight(PLAN)
    assert hit
    assert same(second, flown)
    assert flights == [PLAN]
    assert entry().name == f"{flight_key(PLAN)}.npz"


def test_without_cache_nothing_is_read_or_written(flights):
    assert not cached_flight(PLAN, use_cache=False)[1]
    assert not cache.cache_folder().exists()
    cached_flight(PLAN)
    assert not cached_flight(PLAN, use_cache=False)[1]
    assert len(flights) == 3


def flipped_bit(content: bytes, place: float) -> bytes:
    at = int(place * len(content))
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: flipped_bit(content, 0.1),
        lambda content: flipped_bit(content, 0.5),
        lambda content: flipped_bit(content, 0.9),
        lambda content: b"not an archive",
    ],
)
def test_damaged_entry_is_flown_again_and_replaced(flights, flown, damage):
    cached_flight(PLAN)
    sound = entry().read_bytes()
    entry().write_bytes(damage(sound))
    flight, hit = cached_flight(PLAN)
    assert not hit
    assert same(flight, flown)
    assert entry().read_bytes() == sound
    assert cached_flight(PLAN)[1]
    assert len(flights) == 2


HEADERS = {b"PK\x03\x04": 30, b"PK\x01\x02": 46, b"PK\x05\x06": 22}
"""Signatures of the archive's local, central and last records, with the length of their fixed part."""


@pytest.mark.parametrize("signature", HEADERS)
def test_any_flipped_bit_of_the_archives_headers_is_survived(flights, flown, signature, monkeypatch):
    brief = flown.window(0.0, 0.1)
    monkeypatch.setattr(cache, "fly", lambda plan, progress=None: brief)
    cached_flight(PLAN)
    sound = entry().read_bytes()
    header = sound.rindex(signature)
    flown_again = 0
    for place in range(8 * HEADERS[signature]):
        damaged = bytearray(sound)
        damaged[header + place // 8] ^= 1 << place % 8
        entry().write_bytes(damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            flight, hit = cached_flight(PLAN)
        # Some bits, as those of the time of writing, say nothing of the content.
        assert same(flight, brief)
        flown_again += not hit
    assert flown_again > 40


def rewritten(**changes):
    with np.load(entry()) as content:
        arrays = {**content, **changes}
    np.savez(entry(), **{name: array for name, array in arrays.items() if array is not None})


@pytest.mark.parametrize("name", [*ARRAYS, "metadata", "digest"])
def test_entry_of_another_schema_is_flown_again(flights, name):
    cached_flight(PLAN)
    rewritten(**{name: None})
    assert not cached_flight(PLAN)[1]


def test_entry_with_other_values_than_its_digest_is_flown_again(flights, flown):
    cached_flight(PLAN)
    rewritten(v_n=flown.v_n + 1e-9)
    assert not cached_flight(PLAN)[1]


def test_entry_with_a_true_digest_of_wrong_content_is_flown_again(flights, flown):
    cached_flight(PLAN)
    metadata = cache._metadata(flown).replace("J2", "FLAT")
    arrays = {name: getattr(flown, name) for name in ARRAYS}
    rewritten(metadata=metadata, digest=cache._digest(metadata, arrays))
    assert not cached_flight(PLAN)[1]
    arrays["lla"] = arrays["lla"][:-1]
    metadata = cache._metadata(flown)
    rewritten(lla=arrays["lla"], digest=cache._digest(metadata, arrays))
    assert not cached_flight(PLAN)[1]


def test_temporary_files_left_behind_are_removed_after_a_day(flights):
    cache.cache_folder().mkdir()
    old, young, other = (cache.cache_folder() / name for name in ("old.tmp", "young.tmp", "old.txt"))
    for file, age_h in ((old, 25), (young, 23), (other, 25)):
        file.write_bytes(b"half an entry")
        written = time.time() - 3600 * age_h
        os.utime(file, (written, written))
    cached_flight(PLAN)
    assert not old.exists()
    assert young.exists()
    assert other.exists()


def test_unwritable_folder_is_one_warning(flights, flown, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(cache.FOLDER_VARIABLE, str(tmp_path / "file" / "flights"))
    with pytest.warns(CacheWarning, match="the flight is not cached") as caught:
        flight, hit = cached_flight(PLAN)
    assert not hit
    assert same(flight, flown)
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)


@pytest.mark.parametrize(
    "changes",
    [{"seed": 1}, {"airframe": "a4"}, {"tail_s": 1.0}, {"air": Air(wind_down_mps=0.1)}, {"imu_rate_hz": 50}],
)
def test_key_tells_plans_apart(changes):
    assert flight_key(PLAN.model_copy(update=changes)) != flight_key(PLAN)


def test_key_knows_the_code_its_libraries_and_the_machine(monkeypatch):
    key = flight_key(PLAN)
    assert flight_key(FlightPlan(**{**dict(PLAN), "airframe": "F16"})) == key
    monkeypatch.setattr(cache.jsbsim, "__version__", "0.0")
    assert flight_key(PLAN) != key
    monkeypatch.undo()
    monkeypatch.setattr(cache.np, "__version__", "0.0")
    assert flight_key(PLAN) != key
    monkeypatch.undo()
    monkeypatch.setattr(cache.platform, "machine", lambda: "abacus")
    assert flight_key(PLAN) != key
    monkeypatch.undo()
    changed, asked = {"sins/attitude.py"}, cache.sources_digest
    monkeypatch.setattr(cache, "sources_digest", lambda *files: asked(*(set(files) - changed)))
    assert flight_key(PLAN) != key


def test_default_folder_is_the_users(monkeypatch):
    monkeypatch.delenv(cache.FOLDER_VARIABLE, raising=False)
    assert cache.cache_folder().parts[-2:] == ("fleetalign", "flights")
