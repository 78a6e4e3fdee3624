"""The command `edslam reproduce`: its subcommands and their options."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from edslam_ti.arguments import UsageError
from edslam_ti.cold_start import load_kernels
from edslam_ti.config import Stage
from edslam_ti.experiments.paper_options import LongOptions, PaperOptions
from edslam_ti.experiments.selection import Selection
from edslam_ti.sensor_config import DepthSensorName, SensorName


class TrackingOptions(Selection):
    """Cases, methods and folders."""

    methods: tuple[str, ...] = ("ed_slam", "ed_slam_paper", "open3d_icp", "open3d_rgbd")
    """Methods to compare, side by side in the tables."""
    out: Path = Path("results/reproduce")
    """Folder that receives results.json, tracking.md, the pictures, and one file per run."""
    data_dir: Path = Path("data")
    """Folder with trajectories/, scenes/ and slider_depth/; cases without their data are skipped."""
    sensor: SensorName = "ideal"
    """Event sensor of the simulated recordings (docs/sensors.md)."""
    depth_sensor: DepthSensorName = "exact"
    """Their depth sensor; any but exact measures at its own rate and stands for all kinds of depth."""
    quick: bool = False
    """Four short cases instead of all."""
    mapping: bool = False
    """Run the whole system instead of tracking alone."""
    fresh: bool = False
    """Repeat runs that have a result already."""
    keep_recordings: bool = True
    """false: delete each simulated recording after its last case."""
    threads: int = 2
    """CPU threads."""


def tracking(options: TrackingOptions) -> None:
    """Run methods on the cases of the tracking benchmark."""
    load_kernels()
    from edslam_ti.experiments.cases import all_cases, quick_cases, with_sensors
    from edslam_ti.experiments.recordings import Recordings
    from edslam_ti.experiments.report import write_report
    from edslam_ti.experiments.runs import methods_as_variants, run_all

    cases = quick_cases() if options.quick else all_cases()
    cases = with_sensors(cases, options.sensor, options.depth_sensor)
    cases = [case for case in cases if options.includes(case)]
    if not cases:
        raise UsageError("no case passes the filters; leave some out")
    variants = methods_as_variants(options.methods, options.mapping)
    recordings = Recordings(options.data_dir)
    keep, fresh, out = options.keep_recordings, options.fresh, options.out
    results: list[dict[str, Any]] = []
    try:
        results.extend(run_all(cases, variants, recordings, out, Console(), options.threads, fresh, keep))
    finally:  # write partial results after Ctrl-C, too
        if results:
            table = write_report(results, out, "Tracking")
            print(f"{table}: {len(results)} of {len(cases) * len(variants)} runs")


class AblationOptions(Stage):
    """Recordings, and output of the tables."""

    scenes: tuple[str, ...] = ("office0", "room0", "wall")
    """Built-in scenes, with Kinect-like depth at 20 Hz."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of path and noise."""
    out: Path = Path("results/ablations")
    """Folder that receives ablations.md and one file per run."""
    document: Path | None = None
    """Markdown file that also receives the tables, between its lines `<!-- ablations -->` and
    `<!-- end ablations -->`."""
    fresh: bool = False
    """Repeat runs that have a result already."""
    threads: int = 2
    """CPU threads."""


def ablations(options: AblationOptions) -> None:
    """Change one setting of the tracker at a time."""
    load_kernels()
    from edslam_ti.experiments.ablations import ablation_cases, ablation_markdown, ablation_variants
    from edslam_ti.experiments.recordings import Recordings
    from edslam_ti.experiments.report import insert_into
    from edslam_ti.experiments.runs import run_all

    cases, recordings = ablation_cases(options.scenes, options.seeds), Recordings(Path())
    console, threads, fresh = Console(), options.threads, options.fresh
    results = list(run_all(cases, ablation_variants(), recordings, options.out, console, threads, fresh))
    text = ablation_markdown(results)
    (options.out / "ablations.md").write_text(text)
    if options.document is not None:
        insert_into(options.document, "ablations", text)
    print(text)


class LongStreamOptions(Stage):
    """Recording, and settings of the measurement."""

    recording: Path | None = None
    """Folder in EventReplica's layout; omitted: the loop through a built-in room."""
    scene: str = "office0"
    """Built-in room; 30 s of office0 take 4 GB at full size."""
    duration: float = 30.0
    """Length of the simulated recording in seconds."""
    rounds: int = 2
    """Number of times to play the recording, which must end where it began."""
    width: int = 384
    """Of the made recording, pixels."""
    height: int = 240
    """Of the made recording, pixels."""
    config: Path | None = None
    """YAML file with settings that differ from the defaults."""
    length: float = 5.0
    """Seconds of data per line of the table."""
    out: Path = Path("results/long_stream")
    """Folder that receives long_stream.md, long_stream.png and frames.csv."""
    threads: int = 2
    """CPU threads."""


def long_stream(options: LongStreamOptions) -> None:
    """Measure time per frame, memory and size of the map while tracking and mapping a recording."""
    load_kernels()
    from edslam_ti import kernels
    from edslam_ti.config import Config, read_differences
    from edslam_ti.datasets import EventDepthSequence
    from edslam_ti.datasets.altered import RepeatedSequence
    from edslam_ti.datasets.builtin import builtin_sequence_folder
    from edslam_ti.datasets.event_replica import EventReplicaSequence
    from edslam_ti.experiments.cases import Recording
    from edslam_ti.experiments.long_stream import measure

    kernels.init("cpu", threads=options.threads)
    recording = options.recording
    if recording is None:
        loop = Recording(options.scene, "loop", duration=options.duration).settings
        size = {"width": options.width, "height": options.height}
        recording = builtin_sequence_folder(options.scene, loop.model_copy(update=size))
    sequence: EventDepthSequence = EventReplicaSequence(recording)
    if options.rounds > 1:
        sequence = RepeatedSequence(sequence, options.rounds)
    differences = {} if options.config is None else read_differences(options.config)
    settings = Config(threads=options.threads).updated(differences)
    measure(sequence, settings, options.out, options.length, print)
    print((options.out / "long_stream.md").read_text())


def table1(options: PaperOptions) -> None:
    """Table I: patch size of ed_slam_paper."""
    _paper("table1", options)


def table2(options: PaperOptions) -> None:
    """Table II: number of patches of ed_slam_paper."""
    _paper("table2", options)


def table3(options: PaperOptions) -> None:
    """Table III: novel view synthesis, every method."""
    _paper("table3", options)


def table4(options: PaperOptions) -> None:
    """Table IV: absolute trajectory error, every method."""
    _paper("table4", options)


def runtime(options: PaperOptions) -> None:
    """Speed of tracking and mapping, total, memory and size of the map, every method."""
    _paper("runtime", options)


def everything(options: PaperOptions) -> None:
    """All tables, figures 3 to 5, and report.html."""
    _paper("all", options)


def long(options: LongOptions) -> None:
    """Walk a minute and five through a flat of four rooms, and with something that moves in view."""
    load_kernels()
    from edslam_ti.experiments.long_runs import reproduce_long

    reproduce_long(options)


def _paper(name: str, options: PaperOptions) -> None:
    load_kernels()
    from edslam_ti.experiments.paper import reproduce_paper
    from edslam_ti.experiments.paper_plan import TABLES

    reproduce_paper(TABLES if name == "all" else (name,), options)


class SensorOptions(Stage):
    """Recordings, and output of the table."""

    data_dir: Path = Path("data")
    """Folder with slider_depth/, real_events/ and aedat4/; what is not there is left out."""
    scene: str = "office0"
    """Built-in room that every simulated sensor records."""
    duration: float = 0.5
    """Seconds of it."""
    width: int = 346
    """Largest width in pixels; sensors with more pixels are made smaller."""
    store: Path | None = None
    """Checkout whose docs/results also receives the table; `edslam reproduce report` shows it."""
    threads: int = 2
    """CPU threads."""


def sensors(options: SensorOptions) -> None:
    """Compare statistics of events of simulated sensors with those of real ones."""
    load_kernels()
    from edslam_ti import kernels
    from edslam_ti.experiments.sensor_statistics import compare_sensors

    kernels.init("cpu", threads=options.threads)
    compare_sensors(
        options.scene, options.duration, options.width, options.data_dir, options.store, Console()
    )


class ReportOptions(Stage):
    """Documents to update."""

    root: Path = Path()
    """Checkout that contains README.md and docs/."""
    check: bool = False
    """Change nothing; fail if a document differs from the stored numbers."""


def report(options: ReportOptions) -> None:
    """Write the tables of README.md and docs/*.md from the numbers in docs/results/*.json."""
    from edslam_ti.experiments.documents import report_tables

    report_tables(options.root, options.check)


# command -> its options and its function
COMMANDS: dict[str, tuple[type[Stage], Callable[[Any], None]]] = {
    "tracking": (TrackingOptions, tracking),
    "ablations": (AblationOptions, ablations),
    "long_stream": (LongStreamOptions, long_stream),
    "table1": (PaperOptions, table1),
    "table2": (PaperOptions, table2),
    "table3": (PaperOptions, table3),
    "table4": (PaperOptions, table4),
    "runtime": (PaperOptions, runtime),
    "all": (PaperOptions, everything),
    "long": (LongOptions, long),
    "sensors": (SensorOptions, sensors),
    "report": (ReportOptions, report),
}
