"""Live runs: a second process sends, is killed and comes back; folders, streams, a slow computer."""

import contextlib
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console
from sequences import settings

from edslam_ti.arguments import UsageError
from edslam_ti.commands.live import main, read_live_options
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.live import loop
from edslam_ti.live.addresses import Address, address_of
from edslam_ti.live.client import Client, send_all
from edslam_ti.live.connections import SocketSource, StreamSource
from edslam_ti.live.folder import FolderSource
from edslam_ti.live.items import DepthItem, EndItem, EventsItem, Inbox, Item, NoteItem, Source, TimeItem
from edslam_ti.live.loop import LiveSettings, Milestones, Pressure, run_live
from edslam_ti.live.messages import encoded
from edslam_ti.live.recording import RecordingSource
from edslam_ti.session import Session
from edslam_ti.slam import Slam
from edslam_ti.trajectory import read_tum
from edslam_ti.viewer import NoViewer

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
LOCAL = Address(None, "127.0.0.1", 0)


@pytest.fixture(autouse=True)
def kernels_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "warm_up", lambda config: None)


def config_for(out: Path, **differences: Any) -> Config:
    mapping = {"iterations": 1, "final_iterations": 4} | differences.pop("mapping", {})
    return settings(out=str(out), mapping=mapping, **differences)


def tracked_live(source: Source, config: Config, **options: Any) -> tuple[Path, str]:
    """Return the results of a live run, and what was printed."""
    printed = io.StringIO()
    folder = run_live(source, config, LiveSettings(**options), Console(file=printed, width=200), NoViewer())
    return folder, printed.getvalue()


def metrics_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


# --- a recording, played ---


def test_a_recording_without_a_pace_is_the_run_to_the_bit(
    tiny_sequence: EventDepthSequence, tmp_path: Path
) -> None:
    samples = SampledSequence(tiny_sequence, 0.0, None, 0.05)
    config = config_for(tmp_path, contrast_threshold=0.1, mapping={"enabled": False})
    session = Session(tiny_sequence.camera, config, initial_pose=samples[0].T_world_camera)
    for sample in samples:
        events = sample.events
        session.add_events(events.x, events.y, events.t, events.polarity)
        session.add_depth(sample.timestamp, sample.depth)
    expected = session.finish().trajectory
    folder, _ = tracked_live(RecordingSource(tiny_sequence, pace=0.0), config)
    found = read_tum(folder / "trajectory_tum.txt")
    assert len(found) == len(expected)
    np.testing.assert_allclose(found.poses, expected.poses, atol=2e-9)  # nine decimals
    metrics = metrics_of(folder)
    assert (metrics["num_frames_merged"], metrics["num_frames_not_mapped"]) == (0, 0)
    assert 0 < metrics["latency_median_ms"] <= metrics["latency_99_ms"]
    assert folder.relative_to(tmp_path).parts[:3] == ("live", "live", "ed_slam")


def test_a_recording_is_played_at_its_pace(tiny_sequence: EventDepthSequence) -> None:
    now = [0.0]
    source = RecordingSource(tiny_sequence, pace=2.0, clock=lambda: now[0])
    waits: list[float] = []

    class Waiting:
        def wait(self, seconds: float) -> bool:
            waits.append(seconds)
            now[0] += seconds
            return False

    source._closed = Waiting()  # type: ignore[assignment]
    items = list(source.items())
    assert isinstance(items[-1], EndItem)
    assert now[0] == pytest.approx(0.35, abs=0.01)  # seconds for a recording of 0.7 s
    events = [item for item in items if isinstance(item, EventsItem)]
    assert sum(len(item.t) for item in events) == len(tiny_sequence.events(-1, 1))
    assert sum(isinstance(item, DepthItem) for item in items) == len(tiny_sequence.depth_timestamps)


# --- a socket ---


def sender(folder: Path, address: str, pace: float, *more: str) -> subprocess.Popen[str]:
    """Start a second process that sends a recording."""
    words = ["--send", str(folder), "--to", address, "--pace", str(pace), *more]
    program = "from edslam_ti.commands.live import main; import sys; main(sys.argv[1:])"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", program, *words], env=environment, stdout=subprocess.PIPE, text=True
    )


def test_a_second_process_sends_is_killed_and_comes_back(
    tiny_folder: Path, tmp_path: Path, tiny_sequence: EventDepthSequence
) -> None:
    source = SocketSource(Address(tmp_path / "slam.sock"))
    address = str(source.address)
    killed = threading.Event()

    def send() -> None:
        first = sender(tiny_folder, address, 0.5)
        while not any(isinstance(item, DepthItem) and item.t > 0.3 for item in seen):
            time.sleep(0.01)
        first.kill()
        first.wait()
        killed.set()
        assert sender(tiny_folder, address, 1.0, "--start", "0.3").wait() == 0

    seen: list[Item] = []
    thread = threading.Thread(target=send)
    original = source.items

    def items() -> Iterator[Item]:
        for item in original():
            seen.append(item)
            yield item

    source.items = items  # type: ignore[method-assign]
    thread.start()
    config = config_for(tmp_path / "out", mapping={"enabled": False})
    folder, printed = tracked_live(source, config)
    thread.join()
    assert killed.is_set()
    assert "client 1 has gone; waiting for another" in printed
    assert "client 2 connected" in printed
    metrics = metrics_of(folder)
    assert metrics["num_lost_frames"] == 0
    found = read_tum(folder / "trajectory_tum.txt")
    assert found.timestamp(-1) > 0.65
    truth = tiny_sequence.truth.resampled(found.timestamps)  # type: ignore[union-attr]
    assert np.linalg.norm(found.poses[:, :3, 3] - truth.poses[:, :3, 3], axis=1).max() < 0.03
    assert "client 1 has gone" in (folder / "log.txt").read_text()


def test_malformed_messages_close_the_connection_and_the_session_goes_on(
    tiny_sequence: EventDepthSequence, tmp_path: Path
) -> None:
    source = SocketSource(LOCAL)
    recording = RecordingSource(tiny_sequence, pace=0.0)

    def send() -> None:
        cut_off = encoded(recording.camera, recording.camera) + b"EDSL\x01\xff"
        for data in (b"GET / HTTP/1.1\r\n\r\n", cut_off):
            with source.address.connect(5.0) as connection:
                connection.sendall(data)
                connection.shutdown(socket.SHUT_WR)
                with contextlib.suppress(ConnectionResetError):  # not all was read
                    assert connection.recv(1) == b""
        send_all(recording, source.address)

    thread = threading.Thread(target=send)
    thread.start()
    config = config_for(tmp_path, mapping={"enabled": False})
    folder, printed = tracked_live(source, config, keeps_up=False)
    thread.join()
    assert "client 1: connection closed: expected a message that begins with b'EDSL'" in printed
    assert "client 2: connection closed: the stream ends within a header" in printed
    assert metrics_of(folder)["num_frames"] == 14


def test_another_camera_is_refused(tiny_sequence: EventDepthSequence) -> None:
    source = SocketSource(LOCAL, wait=0.3)
    recording = RecordingSource(tiny_sequence, pace=0.0)
    other = recording.camera.file.model_copy(update={"fx": 99.0})
    inbox = Inbox()
    inbox.fill_from(source)
    for file in (recording.camera.file, other):
        camera = type(recording.camera)(file, "s", "m")
        with Client(source.address, camera):
            time.sleep(0.3)
    while not inbox.is_ended:
        time.sleep(0.01)
    notes = [item.text for item, _ in inbox.take(0.0) if isinstance(item, NoteItem)]
    assert "client 2: connection closed: camera: expected the one that the session began with" in notes[-1]


def test_nothing_listens_in_one_line(tmp_path: Path) -> None:
    camera = RecordingSource.__new__(RecordingSource)
    with pytest.raises(DataError, match="nothing listens there"):
        Client(Address(tmp_path / "none.sock"), camera, patience=0.1)  # type: ignore[arg-type]


def test_a_dead_socket_is_replaced_and_a_living_one_is_not(tmp_path: Path) -> None:
    address = Address(tmp_path / "slam.sock")
    dead, _ = address.listen()
    with pytest.raises(DataError, match="another process listens"):
        address.listen()
    dead.close()
    address.listen()[0].close()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DataError, match="there is a file of that name"):
        Address(tmp_path / "file").listen()
    assert oct((tmp_path / "slam.sock").stat().st_mode & 0o777) == "0o600"


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [("5700", "127.0.0.1", 5700), ("0.0.0.0:80", "0.0.0.0", 80), ("[::1]:9", "::1", 9)],
)
def test_addresses(text: str, host: str, port: int) -> None:
    assert address_of(text) == Address(None, host, port)
    for wrong in ("", "abc", "1:2:x", "70000", "unix:", "unix:" + 200 * "a"):
        with pytest.raises(DataError, match="address: expected"):
            address_of(wrong)


# --- a stream, a folder ---


def test_a_stream_of_messages(tiny_sequence: EventDepthSequence, tmp_path: Path) -> None:
    recording = RecordingSource(tiny_sequence, pace=0.0)
    data = b"".join(encoded(item, recording.camera) for item in recording.items())
    config = config_for(tmp_path, mapping={"enabled": False})
    folder, _ = tracked_live(StreamSource(BytesIO(data)), config, keeps_up=False)
    assert metrics_of(folder)["num_frames"] == 14
    folder, printed = tracked_live(StreamSource(BytesIO(data[: len(data) // 2])), config, keeps_up=False)
    assert "the data ended: " in printed
    assert metrics_of(folder)["num_frames"] > 3
    with pytest.raises(DataError, match="begins with b'EDSL'"):
        tracked_live(StreamSource(BytesIO(b"not a message")), config)
    with pytest.raises(DataError, match="ended before there were any"):
        tracked_live(StreamSource(BytesIO(b"")), config)


def write_folder(folder: Path, sequence: EventDepthSequence) -> None:
    """Write a recording as another process would, each file under another name first."""
    camera = sequence.camera
    names = ("width", "height", "fx", "fy", "cx", "cy")
    values = {name: getattr(camera, name) for name in names} | {"time_unit": "us", "depth_unit": "mm"}
    for kind in ("events", "depth"):
        (folder / kind).mkdir()
    (folder / "camera.json").write_text(json.dumps(values | {"contrast_threshold": 0.1}))
    for k, start in enumerate(np.arange(0, 0.71, 0.01)):
        events = sequence.events(float(start), float(start) + 0.01)
        t = np.rint(events.t * 1e6).astype(np.int64)
        np.savez(folder / "events" / f".{k}.npz", x=events.x, y=events.y, t=t, p=events.polarity)
        (folder / "events" / f".{k}.npz").rename(folder / "events" / f"{k}.npz")
    for k, stamp in enumerate(sequence.depth_timestamps):
        path = folder / "depth" / f"{round(stamp * 1e6)}.png"
        cv2.imwrite(str(path), np.rint(1000 * sequence.depth(k)).astype(np.uint16))
    (folder / "depth" / "250001.png").write_bytes(b"damaged")
    np.save(folder / "events" / "999.npy", np.zeros((2, 3)))
    (folder / "end").touch()


def test_a_folder_that_is_written_into(tiny_sequence: EventDepthSequence, tmp_path: Path) -> None:
    incoming = tmp_path / "incoming"
    incoming.mkdir()
    thread = threading.Thread(target=write_folder, args=(incoming, tiny_sequence))
    thread.start()
    config = config_for(tmp_path / "out", mapping={"enabled": False})
    folder, printed = tracked_live(FolderSource(incoming), config, keeps_up=False, patience=5.0)
    thread.join()
    metrics = metrics_of(folder)
    assert (metrics["num_frames"], metrics["num_lost_frames"]) == (14, 0)
    assert "left out" in printed
    assert "250001.png" in printed
    assert "expected events [N, 4]" in printed
    with pytest.raises(DataError, match="expected a directory"):
        FolderSource(tmp_path / "none")


# --- a computer that is too slow ---


class Flood:
    """All of a recording at once, as to a computer that was busy meanwhile; its end is not known yet."""

    description, is_live = "a flood", True

    def __init__(self, sequence: EventDepthSequence) -> None:
        self._recording = RecordingSource(sequence, pace=0.0)
        self.sessions: list[Session] = []

    def items(self) -> Iterator[Item]:
        yield from (item for item in self._recording.items() if not isinstance(item, EndItem))
        while not self.sessions or self.sessions[0].next_times() or len(self.sessions[0].trajectory) < 6:
            time.sleep(0.01)
        yield EndItem()

    def close(self) -> None:
        self._recording.close()


def test_mapping_gives_way_then_frames_are_merged(
    tiny_sequence: EventDepthSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    floods = [Flood(tiny_sequence), Flood(tiny_sequence)]

    def made(*arguments: Any, **options: Any) -> Session:
        session = Session(*arguments, **options)
        for flood in floods:
            flood.sessions.insert(0, session)
        return session

    monkeypatch.setattr(loop, "Session", made)
    monkeypatch.setattr(loop, "Pressure", lambda: Pressure(-1.0, 1e9))
    folder, printed = tracked_live(floods[0], config_for(tmp_path / "a"))
    metrics = metrics_of(folder)
    not_mapped = metrics["num_frames_not_mapped"]
    assert not_mapped == 14 - 3 - 1  # three are held out anyway, and after the last one there is time
    assert (metrics["num_mapping_steps_skipped"], metrics["num_frames_merged"]) == (not_mapped, 0)
    assert metrics["num_lost_frames"] == 0
    assert f"{not_mapped} not mapped" in printed
    monkeypatch.setattr(loop, "Pressure", lambda: Pressure(-1.0, -1.0))
    monkeypatch.setattr(loop, "MOST_MERGED", 2)
    floods[1].sessions.clear()
    config = config_for(tmp_path / "b", mapping={"enabled": False})
    folder, _ = tracked_live(floods[1], config, patience=5.0)
    metrics = metrics_of(folder)
    assert metrics["num_frames"] + metrics["num_frames_merged"] == 14
    assert metrics["num_frames_merged"] >= 4
    assert metrics["num_events"] > 0.9 * len(tiny_sequence.events(0, 1))  # none is lost


def test_an_inbox_is_bounded() -> None:
    inbox = Inbox(most=1000)
    item = EventsItem(*(np.zeros(300, np.uint8) for _ in range(4)))
    done = threading.Event()

    def fill() -> None:
        for _ in range(3):
            inbox.put(item)
        done.set()

    threading.Thread(target=fill, daemon=True).start()
    assert not done.wait(0.1)
    while not done.is_set():
        assert len(inbox.take(1.0)) <= 1
    inbox.end()
    assert not inbox.put(TimeItem(1))


def test_a_source_waits_where_every_frame_is_mapped(
    tiny_sequence: EventDepthSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting: list[float] = []

    class Watched(Session):
        def process_next(self, is_mapped: bool = True, merged: int = 1) -> bool:
            waiting.append(self.newest - self.next_times()[0])
            return super().process_next(is_mapped, merged)

    monkeypatch.setattr(loop, "Session", Watched)
    monkeypatch.setattr(loop, "Inbox", lambda: Inbox(most=20_000))
    config = config_for(tmp_path, mapping={"enabled": False})
    tracked_live(RecordingSource(tiny_sequence, pace=0.0), config)
    assert max(waiting) < 0.1  # seconds of data in the session, however fast they can be read


def test_milestones() -> None:
    milestones = Milestones()
    for stamp, moment in ((0.1, 10.0), (0.1, 11.0), (0.3, 12.0)):
        milestones.note(stamp, moment)
    assert milestones.moment_of(0.1) == 10.0
    assert milestones.moment_of(0.2) == 12.0
    assert milestones.moment_of(0.4) is None


# --- how it ends ---


def test_ctrl_c_ends_the_data_and_refines(
    tiny_sequence: EventDepthSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Endless(Flood):
        def items(self) -> Iterator[Item]:
            yield from (item for item in self._recording.items() if not isinstance(item, EndItem))
            time.sleep(0.2)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)

    folder, printed = tracked_live(Endless(tiny_sequence), config_for(tmp_path), keeps_up=False)
    assert "no more data: refining and saving" in printed
    assert not metrics_of(folder)["is_interrupted"]
    assert json.loads((folder / "run.json").read_text())["state"] == "finished"


def test_a_defect_in_the_loop_saves_what_there_is(
    tiny_sequence: EventDepthSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = Slam.process

    def failing(self: Slam, *arguments: Any, **options: Any) -> Any:
        if len(self.results) == 6:
            raise np.linalg.LinAlgError("Singular matrix")
        return process(self, *arguments, **options)

    monkeypatch.setattr(Slam, "process", failing)
    config = config_for(tmp_path, mapping={"enabled": False})
    with pytest.raises(ValueError, match="Singular matrix"):
        tracked_live(RecordingSource(tiny_sequence, pace=0.0), config)
    folder = (tmp_path / "live/live/ed_slam/latest").resolve()
    assert len(read_tum(folder / "trajectory_tum.txt")) == 6
    assert json.loads((folder / "run.json").read_text())["state"] == "failed"


# --- the command ---


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected one of --play, --listen, --folder, --camera, --send, got none"),
        (["--play", "a", "--listen", "1"], "got --play and --listen"),
        (["--send", "a"], "--send and --to: expected both"),
        (["--listen", "1", "--depth-camera", "realsense"], "expected with --camera"),
    ],
)
def test_what_does_not_agree_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read_live_options(words)


def test_other_machines_only_by_an_explicit_flag(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="other machines can reach it"):
        main(["--listen", "0.0.0.0:0"])
    with pytest.raises(DataError, match="ended before there were any"):
        main(["--listen", "0.0.0.0:0", "--any-address", "--wait", "0.2", "--mapping.enabled", "false"])
    assert "warning: whoever can reach 0.0.0.0" in capsys.readouterr().out


def test_settings_that_need_a_recording_are_refused() -> None:
    with pytest.raises(ConfigError, match="maps with true poses"):
        main(["--listen", "0", "--wait", "0.1", "--method", "event_3dgs"])
