"""edslam convert IN OUT

Write the recording IN, a folder of any layout or a file of events, to the folder OUT in one of our own
layouts. Events, stamps, depth, images and true poses are the same to the bit, so a run on OUT gives the same
trajectory. A lens is undistorted on the way.

    edslam convert data/slider_depth data/slider                       the layout generic
    edslam convert data/slider_depth data/slider --layout event_replica
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from edslam_ti.arguments import Shown, UsageError, read_options
from edslam_ti.cold_start import load_kernels
from edslam_ti.config import Config, Stage
from edslam_ti.errors import plain


class ConvertOptions(Stage):
    """What to convert."""

    source: Annotated[Path, Shown("IN", is_positional=True)]
    """Folder of a recording, or a file of events."""
    out: Annotated[Path, Shown("OUT", is_positional=True)]
    """New or empty folder that receives the conversion; an older conversion there is replaced."""
    layout: Literal["generic", "event_replica"] = "generic"
    """Layout of OUT."""
    dataset: str | None = None
    """Layout of IN; omitted: recognised from its files."""
    intrinsics: Annotated[tuple[float, float, float, float] | None, Shown("FX FY CX CY")] = None
    """Lens of a file of events, pixels, centres at integers."""


def main(argv: Sequence[str] | None = None) -> None:
    """Convert a recording."""
    options = read_options(ConvertOptions, argv, "edslam convert", __doc__)
    load_kernels()
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    from edslam_ti import kernels
    from edslam_ti.conversion import convert
    from edslam_ti.datasets import EventDepthSequence, open_folder
    from edslam_ti.datasets.event_recording import EventRecording

    kernels.init("cpu")  # some layouts draw depth into the event camera
    sequence: EventDepthSequence
    if options.source.is_file():
        sequence = EventRecording(options.source, options.intrinsics)
    else:
        if options.intrinsics is not None:
            raise UsageError("--intrinsics: expected with a file of events alone; a recording states its own")
        sequence = open_folder(options.source, Config(dataset=options.dataset))
    with Progress(transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task(f"converting {escape(plain(sequence.scene))}", total=1.0)
        written = convert(
            sequence, options.out, options.layout, lambda share: bar.update(task, completed=share)
        )
    print(
        f"{plain(written.folder, 4096)}: {written.num_events} events, "
        f"{written.num_depth_images} depth images, {written.num_images} images"
    )
    for note in [*sequence.notes, *written.notes]:
        print(plain(note))
