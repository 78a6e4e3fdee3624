"""What `apps/reproduce.py` does: its commands, and what each of them takes."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from edslam_ti.command_line import UsageError
from edslam_ti.experiments.cases import EVERYTHING, Selection, all_cases, quick_cases


def tracking(
    select: Annotated[Selection, tyro.conf.arg(name="")] = EVERYTHING,
    methods: tuple[str, ...] = ("ed_slam", "ed_slam_paper", "open3d_icp", "open3d_rgbd"),
    out: Path = Path("results/reproduce"),
    data_dir: Path = Path("data"),
    quick: bool = False,
    mapping: bool = False,
    fresh: bool = False,
    keep_recordings: bool = True,
    threads: int = 2,
) -> None:
    """Run methods over the bench.

    Args:
        select: filters
        methods: methods to compare, side by side in the tables
        out: folder that receives results.json, tracking.md, the pictures, and one file per run
        data_dir: folder with trajectories/, scenes/ and slider_depth/; cases without their data are skipped
        quick: four short cases instead of all
        mapping: run the whole system instead of tracking alone
        fresh: run again what has a result already
        keep_recordings: false: delete each simulated recording after its last case
        threads: CPU threads
    """
    cases = [case for case in (quick_cases() if quick else all_cases()) if select.includes(case)]
    if not cases:
        raise UsageError("no case passes the filters; leave some out")
    # After the arguments: torch and Taichi take seconds to load.
    from edslam_ti.experiments.recordings import Recordings
    from edslam_ti.experiments.report import write_report
    from edslam_ti.experiments.runs import methods_as_variants, run_all

    variants = methods_as_variants(methods, mapping)
    recordings = Recordings(data_dir)
    results: list[dict[str, Any]] = []
    try:
        results.extend(run_all(cases, variants, recordings, out, Console(), threads, fresh, keep_recordings))
    finally:  # what there is before Ctrl-C, too
        if results:
            table = write_report(results, out, "Tracking")
            print(f"{table}: {len(results)} of {len(cases) * len(variants)} runs")


def ablations(
    scenes: tuple[str, ...] = ("office0", "room0", "wall"),
    seeds: tuple[int, ...] = (0,),
    out: Path = Path("results/ablations"),
    document: Path | None = None,
    fresh: bool = False,
    threads: int = 2,
) -> None:
    """Change one setting of the tracker at a time.

    `document` holds the lines `<!-- ablations -->` and `<!-- end ablations -->`.

    Args:
        scenes: built-in scenes, with Kinect-like depth at 20 Hz
        seeds: seeds of path and noise
        out: folder that receives ablations.md and one file per run
        document: Markdown file that gets the tables, too, between its marks for them
        fresh: run again what has a result already
        threads: CPU threads
    """
    from edslam_ti.experiments.ablations import ablation_cases, ablation_markdown, ablation_variants
    from edslam_ti.experiments.recordings import Recordings
    from edslam_ti.experiments.report import insert_into
    from edslam_ti.experiments.runs import run_all

    cases, recordings = ablation_cases(scenes, seeds), Recordings(Path())
    results = list(run_all(cases, ablation_variants(), recordings, out, Console(), threads, fresh))
    text = ablation_markdown(results)
    (out / "ablations.md").write_text(text)
    if document is not None:
        insert_into(document, "ablations", text)
    print(text)


def long_stream(
    recording: Path | None = None,
    scene: str = "office0",
    duration: float = 30.0,
    rounds: int = 2,
    width: int = 384,
    height: int = 240,
    config: Path | None = None,
    length: float = 5.0,
    out: Path = Path("results/long_stream"),
    threads: int = 2,
) -> None:
    """Measure time per frame, memory and size of the map along a recording, tracking and mapping.

    Args:
        recording: folder in EventReplica's layout; omitted: the loop through a built-in room
        scene: built-in room; 30 s of office0 take 4 GB at full size
        duration: seconds of the made recording
        rounds: how often a recording that ends where it began is played
        width: of the made recording, pixels
        height: of the made recording, pixels
        config: YAML file with settings that differ from the defaults
        length: seconds of data that a line of the table covers
        out: folder that receives long_stream.md, long_stream.png and frames.csv
        threads: CPU threads
    """
    from edslam_ti import kernels
    from edslam_ti.config import Config, read_differences
    from edslam_ti.datasets import EventDepthSequence
    from edslam_ti.datasets.altered import RepeatedSequence
    from edslam_ti.datasets.builtin import builtin_sequence_folder
    from edslam_ti.datasets.event_replica import EventReplicaSequence
    from edslam_ti.experiments.cases import Recording
    from edslam_ti.experiments.long_stream import measure

    kernels.init("cpu", threads=threads)
    if recording is None:
        loop = Recording(scene, "loop", duration=duration).settings
        recording = builtin_sequence_folder(scene, loop.model_copy(update={"width": width, "height": height}))
    sequence: EventDepthSequence = EventReplicaSequence(recording)
    if rounds > 1:
        sequence = RepeatedSequence(sequence, rounds)
    settings = Config(threads=threads).updated({} if config is None else read_differences(config))
    measure(sequence, settings, out, length, print)
    print((out / "long_stream.md").read_text())


COMMANDS: dict[str, Callable[..., None]] = {
    "tracking": tracking,
    "ablations": ablations,
    "long_stream": long_stream,
}
