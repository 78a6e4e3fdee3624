"""edslam inspect PATH

Say what a recording holds and what looks wrong in it, before a run: PATH is the folder of a recording in any
layout, or a file of events. Also writes one picture (--sheet, by default inspection.png in the current
folder): events, time surface, depth, image, and depth edges over events, at a few times; and, beside it,
inspection_sensor.png: intervals between events of a pixel, and hot pixels.

    edslam inspect data/my_room
    edslam inspect recording.h5 --sheet recording.png

Exit codes: 0 nothing looks wrong, 4 something does.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from edslam_ti.arguments import Shown, UsageError, read_options
from edslam_ti.cold_start import load_kernels
from edslam_ti.config import Config, Stage
from edslam_ti.errors import plain

FAULTY = 4  # exit code


class InspectOptions(Stage):
    """What to inspect."""

    path: Annotated[Path, Shown("PATH", is_positional=True)]
    """Folder of a recording, or a file of events."""
    sheet: Annotated[Path, Shown("FILE.png")] = Path("inspection.png")
    """Picture to write; an existing one is replaced."""
    dataset: str | None = None
    """Layout of the recording; omitted: recognised from its files."""
    threads: int = 2
    """CPU threads."""


def main(argv: Sequence[str] | None = None) -> None:
    """Inspect a recording."""
    options = read_options(InspectOptions, argv, "edslam inspect", __doc__)
    if options.sheet.suffix.lower() != ".png":
        raise UsageError(f"--sheet: expected a file name that ends in .png, got {options.sheet}")
    load_kernels()
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from edslam_ti import kernels
    from edslam_ti.inspection.opening import open_path
    from edslam_ti.inspection.report import inspect
    from edslam_ti.inspection.sheet import write_sheet
    from edslam_ti.inspection.summary import lines
    from edslam_ti.results.sensor import plot_sensor

    kernels.init("cpu", threads=options.threads)
    config = Config(dataset=options.dataset, threads=options.threads)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task("opening", total=None)
        sequence, refusal = open_path(options.path, config)
        report = of_sensor = None
        if sequence is not None:
            report = inspect(sequence, config, lambda what: bar.update(task, description=what))
            write_sheet(report, options.sheet)
            if report.sensor is not None:
                of_sensor = options.sheet.with_name(f"{options.sheet.stem}_sensor.png")
                plot_sensor(report.sensor, None, of_sensor)
    for line in lines(report, refusal):
        print(plain(line, 1000))
    if report is not None:
        print(f"picture: {plain(options.sheet, 4096)}")
        if of_sensor is not None:
            print(f"picture: {plain(of_sensor, 4096)}")
    if refusal is not None or (report is not None and report.findings):
        sys.exit(FAULTY)
