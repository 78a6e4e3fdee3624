"""RAW, DAT and HDF5 files of Prophesee's cameras: every event, from files that the test encodes itself."""

from pathlib import Path

import numpy as np
import pytest
from event_files.written_ecf import EVENT, write_ecf
from event_files.written_prophesee import SIZE, Event, header, some_events, write_dat, write_raw

from edslam_ti.errors import DataError
from edslam_ti.event_files import EventStream, open_events, raw, sliced

VERSIONS = ("2.0", "2.1", "3.0")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "events"


def assert_holds(stream: EventStream, events: list[Event]) -> None:
    first, last = stream.time_range
    assert (first, last) == (events[0].t / 1e6, events[-1].t / 1e6)
    found = stream.between(first, np.nextafter(last, np.inf))
    expected = np.array(events)
    assert len(stream) == len(found) == len(events)
    assert (found.x == expected[:, 0]).all()
    assert (found.y == expected[:, 1]).all()
    assert (found.t == expected[:, 2] / 1e6).all()
    assert (found.polarity == np.where(expected[:, 3] > 0, 1, -1)).all()


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("at_once", [7, 500_000])
def test_raw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, at_once: int) -> None:
    monkeypatch.setattr(raw, "WORDS_AT_ONCE", at_once)  # vectors and stamps go on in the next piece
    events = some_events()
    stream = open_events(write_raw(tmp_path / "a.raw", events, version, "geometry 1280x720"))
    assert stream.size == SIZE
    assert_holds(stream, events)


@pytest.mark.parametrize("is_legacy", [False, True])
@pytest.mark.parametrize("is_stated", [False, True])
def test_both_orders_of_the_halves_of_evt21_are_read(
    tmp_path: Path, is_legacy: bool, is_stated: bool
) -> None:
    line = f"format EVT21;height=720;width=1280;endianness={'legacy' if is_legacy else 'little'}"
    lines = [line] if is_stated else ["width 1280", "height 720"]
    events = some_events()
    stream = open_events(write_raw(tmp_path / "a.raw", events, "2.1", *lines, is_legacy=is_legacy))
    assert stream.size == SIZE
    assert_holds(stream, events)


@pytest.mark.parametrize(
    ("version", "bits", "start"),
    [("3.0", 24, 15_777_216), ("3.0", 24, 100_000_000), ("2.0", 34, 17_179_868_184)],
)
def test_stamps_go_on_when_the_counter_starts_again(
    tmp_path: Path, version: str, bits: int, start: int
) -> None:
    events = some_events(start=start, span=3000)
    before = start & ~(
        (1 << (24 if version == "3.0" else 34)) - 1
    )  # turns before the file begins are unknown
    stream = open_events(write_raw(tmp_path / "a.raw", events, version), SIZE)
    assert_holds(stream, [event._replace(t=event.t - before) for event in events])


def test_many_turns_of_the_counter(tmp_path: Path) -> None:
    events = [Event(k % 640, 5, 1_000_000 * k, k % 2) for k in range(100)]
    assert_holds(open_events(write_raw(tmp_path / "a.raw", events, "3.0"), SIZE), events)


@pytest.mark.parametrize(
    ("plugin", "size"),
    [
        ("hal_plugin_gen3_fx3", (640, 480)),
        ("hal_plugin_imx636_evk4", (1280, 720)),
        ("hal_plugin_genx320", (320, 320)),
    ],
)
def test_the_sensor_tells_the_size(tmp_path: Path, plugin: str, size: tuple[int, int]) -> None:
    events = [Event(k, 3, k, 1) for k in range(200)]
    assert open_events(write_raw(tmp_path / "a.raw", events, "2.0", f"plugin_name {plugin}")).size == size


def test_a_file_that_does_not_tell_its_size(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.raw", some_events(), "3.0")
    with pytest.raises(DataError, match="does not state the size of its image; pass width and height"):
        open_events(path)


def test_dat(tmp_path: Path, cache: Path) -> None:
    events = some_events()
    stream = open_events(write_dat(tmp_path / "a.dat", events))
    assert stream.size == SIZE
    assert_holds(stream, events)
    assert not cache.exists()  # it is read in place


def test_dat_of_more_than_71_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edslam_ti.event_files.dat.LOOK_EVERY", 50)
    monkeypatch.setattr(sliced, "BLOCK", 100)
    events = [Event(k % 640, 5, 30_000_000 * k, k % 2) for k in range(500)]  # s by s, 4 hours
    stream = open_events(write_dat(tmp_path / "a.dat", events))
    assert_holds(stream, events)
    assert stream.between(6000, 6060).t.tolist() == [6000, 6030]


@pytest.mark.parametrize("how", ["all packed", "packed", "masked"])
@pytest.mark.parametrize("rate", [0.01, 1, 1000])  # us between events
def test_ecf(tmp_path: Path, how: str, rate: float) -> None:
    random = np.random.default_rng(0)
    rows = np.zeros(3000, EVENT)
    rows["t"] = 10**6 + np.sort(random.integers(0, max(2, int(3000 * rate)), 3000))
    rows["x"], rows["y"], rows["p"] = (random.integers(0, n, 3000) for n in (1280, 720, 2))
    rows["y"][100:400], rows["x"][100:400] = 7, np.arange(300)  # neighbours in a row
    rows["p"][1000:1500], rows["p"][2000:2127] = 1, 0  # long runs, and just as long as a marker
    rows["y"][2000:2031] = 3
    rows["t"][2500:] += 10**9  # a gap
    path = write_ecf(tmp_path / "a.hdf5", rows, 512, how, SIZE)
    stream = open_events(path)
    assert stream.size == SIZE
    assert_holds(stream, [Event(x, y, t, p) for x, y, p, t in rows.tolist()])


# --- what is wrong ---


@pytest.mark.parametrize("version", VERSIONS)
def test_a_cut_file_keeps_what_it_has(tmp_path: Path, version: str) -> None:
    path = write_raw(tmp_path / "a.raw", some_events(), version)
    path.write_bytes(path.read_bytes()[:-1])
    stream = open_events(path, SIZE)
    assert 2900 < len(stream) <= 3000
    assert len(stream.notes) == 1
    assert "bytes are cut off and left out" in stream.notes[0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header("evt 3.0"), "expected events, got none"),
        (header("evt 4.0") + b"\x00" * 100, "expected a header '% evt VERSION' with 2.0, 2.1, 3.0, got 4.0"),
        (header("date 2020") + b"\x00" * 100, "got none"),
        (header("evt 3.0") + b"\x80\x80" * 10 + b"\xff\x9f" * 5000, "of unknown types; the file is damaged"),
        (b"", "the file is empty"),
        (b"\x00\x01" * 100, "got a file that is none of them"),
    ],
)
def test_a_bad_file_gets_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "a.raw").write_bytes(content)
    with pytest.raises(DataError, match=words) as caught:
        open_events(tmp_path / "a.raw", SIZE)
    assert "\n" not in str(caught.value)


def test_events_outside_the_image_are_refused(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.raw", some_events(), "3.0")
    with pytest.raises(DataError, match="expected x in 0 to 639 and y in 0 to 479"):
        open_events(path, (640, 480))


def test_a_damaged_ecf_chunk_gets_one_line(tmp_path: Path) -> None:
    rows = np.zeros(3000, EVENT)
    rows["t"] = np.arange(3000)
    path = write_ecf(tmp_path / "a.hdf5", rows, 512, "packed", SIZE)
    content = path.read_bytes()
    place = content.index((512 << 2 | 1).to_bytes(4, "little"))
    path.write_bytes(content[:place] + b"\xff" * 12 + content[place + 12 :])
    with pytest.raises(DataError, match="cannot be read"):
        open_events(path)


# --- real recordings ---


def test_real_evt3_equals_its_decoded_truth(shared_data: Path) -> None:
    """Pixels and polarities are those of the truth, its stamps without the turns that it adds.

    Its decoder adds 4096 us for each step backwards of the low part of the time, although the high part
    states the turns itself, and some steps are of 4 to 11 us.
    """
    folder = shared_data / "formats" / "prophesee_evt2_evt3"
    truth = np.load(folder / "evt3_sample.npy")
    rows, size = raw.raw_rows(folder / "evt3_sample.raw")
    found = np.concatenate([block.rows for block in rows.blocks()])
    assert size == SIZE
    assert len(found) == len(truth) == 219_596
    for column, name in ((0, "x"), (1, "y"), (3, "p")):
        assert (found[:, column] == truth[name]).all()
    content = (folder / "evt3_sample.raw").read_bytes()
    words = np.frombuffer(content[-2 * (len(content) // 2 - 100) :], "<u2")  # without the header
    low = words[words >> 12 == 6] & 0xFFF
    steps_back = int((low[1:] < low[:-1]).sum())
    excess = truth["t"] - np.rint(1e6 * found[:, 2]).astype(int)
    assert (np.diff(excess, prepend=0) % 4096 == 0).all()
    assert np.flatnonzero(np.diff(excess, prepend=0)).size == steps_back == excess[-1] / 4096 == 11
    stream = open_events(folder / "evt3_sample.raw")
    assert len(stream) == 219_596


def test_real_evt2(shared_data: Path) -> None:
    stream = open_events(shared_data / "formats" / "prophesee_evt2_evt3" / "evt2_sample.raw")
    assert (len(stream), stream.size) == (539_481, (640, 480))
    assert stream.time_range == (1.317888, 1.367888)
    assert stream.num_dropped == 0
