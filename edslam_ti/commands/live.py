"""edslam live --listen 5700

Track data while they come: from another process, a directory that it writes into, a camera, or a recording
played at its own pace. Results land in results/live/<name>/<method>/<time>/, as those of `edslam slam`.
Messages, directories and drivers are described in docs/live.md.

    edslam live --play office0 --pace 1                a recording, as if it were happening now
    edslam live --listen 5700                          messages of another process on this machine
    edslam live --send office0 --to 5700 --pace 1      that process: send a recording
    edslam live --listen unix:slam.sock
    edslam live --listen -                             messages from standard input
    edslam live --folder incoming                      files that another process renames into a folder
    edslam live --camera neuromorphic --depth-camera realsense --calibration camera.json

Ctrl-C ends the data, then refines and saves. Exit codes: as for `edslam slam`.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from edslam_ti.arguments import Shown, UsageError, read_given
from edslam_ti.cold_start import load_kernels
from edslam_ti.config import Config, Stage, merged, read_differences
from edslam_ti.methods import METHODS

if TYPE_CHECKING:
    from edslam_ti.live.items import Source

SOURCES = ("play", "listen", "folder", "camera", "send")


class LiveOptions(Stage):
    """Where the data come from."""

    play: Annotated[str | None, Shown("RECORDING")] = None
    """Folder of a recording, or a scene: play it."""
    pace: float = Field(1.0, ge=0)
    """With --play and --send: 1 is the recording's own pace, 2 twice that, 0 as fast as it is taken in."""
    listen: Annotated[str | None, Shown("ADDRESS")] = None
    """Messages: PORT or unix:PATH on this machine, HOST:PORT, or - for standard input."""
    any_address: bool = False
    """Allow --listen at an address that other machines can reach: anyone there can then send data."""
    wait: float | None = Field(None, gt=0)
    """With --listen: seconds without a client after which the data end; omitted: wait for ever."""
    folder: Path | None = None
    """Directory that another process writes into."""
    camera: Literal["neuromorphic"] | None = None
    """Event camera, by its driver (not tried with hardware yet)."""
    depth_camera: Literal["realsense"] | None = None
    """Depth camera, by its driver (not tried with hardware yet)."""
    calibration: Annotated[Path | None, Shown("CAMERA.json")] = None
    """With --camera: the event camera's camera.json, with T_events_depth for the depth camera."""
    send: Annotated[str | None, Shown("RECORDING")] = None
    """Send a recording to a session, instead of tracking."""
    to: Annotated[str | None, Shown("ADDRESS")] = None
    """With --send: where the session listens."""
    name: str = Field("live", pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]{0,79}$")
    """Name of the session, a folder of the results."""
    patience: float = Field(0.25, ge=0)
    """Seconds of data that events and depth wait for each other."""
    reorder: float = Field(0.0, ge=0, le=10)
    """Seconds by which events may come out of order."""
    keep_up: bool = True
    """Skip mapping, then merge frames, where the computer is too slow; false: the source waits instead."""


class _AllOptions(Config, LiveOptions):
    """Where the data come from, and all settings of a run."""

    config: Annotated[Path | None, Shown("FILE")] = Field(None)
    """YAML file of settings that differ from the defaults."""


def main(argv: Sequence[str] | None = None) -> None:
    """Track data while they come, or send a recording."""
    options, config = read_live_options(argv)
    config.require_device()
    load_kernels()
    from edslam_ti.patient_console import patient_console, say

    console = patient_console()
    if options.send is not None:
        _send(options.send, options.to or "", options.pace, config, lambda line: say(console, line))
        return
    from edslam_ti.live.loop import LiveSettings, run_live
    from edslam_ti.results.reading import require_tracked
    from edslam_ti.viewer import make_viewers

    source = _source(options, config, lambda line: say(console, line))
    settings = LiveSettings(options.name, options.patience, options.reorder, options.keep_up)
    viewer = make_viewers(config, lambda line: say(console, line))
    require_tracked(run_live(source, config, settings, console, viewer))


def read_live_options(argv: Sequence[str] | None) -> tuple[LiveOptions, Config]:
    """Return where the data come from and a run's settings; raises UsageError where they do not agree."""
    notes = {"method": [f"{name}: {method.description}" for name, method in METHODS.items()]}
    given = read_given(_AllOptions, argv, "edslam live", __doc__, notes)
    own = {name: given.pop(name) for name in list(given) if name not in Config.model_fields}
    file = own.pop("config", None)
    differences = merged({} if file is None else read_differences(file), given)
    method = differences.get("method", Config().method)
    presets: dict[str, Any] = dict(METHODS[method].overrides) if method in METHODS else {}
    values = merged(merged(Config().model_dump(), presets), differences)
    config = Config.validated(values, source="command line")
    options = LiveOptions.validated(own, source="command line")
    chosen = [f"--{name}" for name in SOURCES if getattr(options, name) is not None]
    if len(chosen) != 1:
        known = ", ".join(f"--{name}" for name in SOURCES)
        raise UsageError(f"expected one of {known}, got {' and '.join(chosen) or 'none'}")
    if (options.send is None) != (options.to is None):
        raise UsageError("--send and --to: expected both or neither; give the missing one")
    if (options.depth_camera or options.calibration) and options.camera is None:
        raise UsageError("--depth-camera, --calibration: expected with --camera")
    if options.camera is not None and options.calibration is None:
        raise UsageError("--camera: expected --calibration CAMERA.json with it")
    return options, config


def _source(options: LiveOptions, config: Config, tell: Callable[[str], None]) -> "Source":
    """Open the source that the options name."""
    if options.play is not None:
        from edslam_ti.kernels import runtime
        from edslam_ti.live.recording import RecordingSource, open_named

        runtime.ensure(config.device, config.threads)  # a built-in room is made on first use
        sequence = open_named(options.play, config)
        return RecordingSource(sequence, options.pace, config.start, config.duration)
    if options.listen is not None:
        from edslam_ti.live.addresses import address_of
        from edslam_ti.live.connections import SocketSource, StreamSource

        if options.listen == "-":
            return StreamSource()
        address = address_of(options.listen)
        if not address.is_local and not options.any_address:
            raise UsageError(
                f"--listen {address}: other machines can reach it, and whoever does can send data; use "
                "127.0.0.1, or --any-address if that is what you want"
            )
        if not address.is_local:
            tell(f"warning: whoever can reach {address} can send data; there is no password")
        return SocketSource(address, options.wait)
    if options.folder is not None:
        from edslam_ti.live.folder import FolderSource

        return FolderSource(options.folder)
    from edslam_ti.kernels import runtime
    from edslam_ti.live.cameras import CameraSource, RealsenseDepth, load_driver

    assert options.calibration is not None, "checked above"
    tell("warning: camera drivers are written by their documentation and not tried with hardware")
    runtime.ensure(config.device, config.threads)  # depth is drawn into the event camera
    events_driver = load_driver("neuromorphic_drivers")
    depth = RealsenseDepth(load_driver("pyrealsense2")) if options.depth_camera is not None else None
    return CameraSource(options.calibration, events_driver, depth)


def _send(name: str, to: str, pace: float, config: Config, tell: Callable[[str], None]) -> None:
    """Send a recording to a session."""
    from rich.progress import TimeRemainingColumn

    from edslam_ti.kernels import runtime
    from edslam_ti.live.addresses import address_of
    from edslam_ti.live.client import send_all
    from edslam_ti.live.recording import RecordingSource, open_named
    from edslam_ti.patient_console import patient_console, progress_bar

    address = address_of(to)
    runtime.ensure(config.device, config.threads)  # a built-in room is made on first use
    source = RecordingSource(open_named(name, config), pace, config.start, config.duration)
    tell(f"sending {source.description} to {address}")
    with progress_bar(patient_console(), TimeRemainingColumn()) as bar:
        task = bar.add_task("sending", total=round(1000 * source.seconds), status="ms of the recording")
        number = send_all(source, address, lambda seconds: bar.update(task, completed=round(1000 * seconds)))
    tell(f"{number} messages sent")
