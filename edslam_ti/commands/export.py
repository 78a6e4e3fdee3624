"""edslam export RESULT

Write a finished run for other programs, into RESULT/export or --out FOLDER:

    splat        map.splat, for web viewers of Gaussian splats (map.ply is in their layout, too)
    glb          mesh.glb, glTF with vertex colours, for browsers, Blender, phones
    kitti        trajectory_kitti.txt and times.txt (trajectory_tum.txt is TUM's)
    colmap       cameras.txt, images.txt, points3D.txt
    nerfstudio   transforms.json, also for instant-ngp

Without --formats, all that the run has. --images true also renders the map at every pose, as the images
that colmap and nerfstudio name.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from edslam_ti.arguments import Shown, read_options
from edslam_ti.cold_start import load_kernels
from edslam_ti.config import Stage
from edslam_ti.errors import plain


class ExportOptions(Stage):
    """What to write."""

    result: Annotated[Path, Shown("RESULT", is_positional=True)]
    """Folder that `edslam slam` made."""
    formats: tuple[Literal["splat", "glb", "kitti", "colmap", "nerfstudio"], ...] = ()
    """What to write; none given: all that the run has."""
    images: bool = False
    """Also render the map at every pose, into `images/`."""
    out: Path | None = None
    """Folder that receives the files; omitted: `export` in RESULT. Files of the same name are replaced."""


def main(argv: Sequence[str] | None = None) -> None:
    """Write a finished run in other formats."""
    options = read_options(ExportOptions, argv, "edslam export", __doc__)
    load_kernels()
    from rich.console import Console
    from rich.progress import Progress

    from edslam_ti import kernels
    from edslam_ti.results.other_formats import FORMATS, Exporter, export_all

    exporter = Exporter(options.result, options.out or options.result / "export")
    written: list[Path] = []
    if options.formats:
        for name in options.formats:
            written += FORMATS[name](exporter)
    else:
        for paths, problem in export_all(exporter):
            written += paths
            if problem:
                print(plain(problem, 1000))
    if options.images:
        kernels.init("cpu")
        with Progress(transient=True, console=Console(stderr=True)) as bar:
            task = bar.add_task("rendering", total=1.0)
            written += exporter.images(lambda share: bar.update(task, completed=share))
    for path in written:
        print(plain(path, 4096))
