"""python apps/view.py RESULT [RESULT ...] [--save FILE.png]

Show finished runs: trajectories in colours, map points and mesh. A RESULT is a folder that apps/slam.py
made, for instance results/builtin/office0/ed_slam/latest. --save draws them into a picture and needs no
display.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from edslam_ti.command_line import UsageError, launch


def view(
    results: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULT [RESULT ...]")],
    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png")] = None,
) -> None:
    """Show finished runs.

    Args:
        results: Folders that apps/slam.py made.
        save: Draw into this PNG file instead of a window.
    """
    from edslam_ti.results.plots import draw_results  # after the arguments: slow to load
    from edslam_ti.results.window import show_results

    if not results:
        raise UsageError("RESULT: expected at least one results folder, got none")
    if save is None:
        show_results(results)
    elif save.suffix.lower() != ".png":
        raise UsageError(f"--save: expected a file name that ends in .png, got {save}")
    else:
        draw_results(results, save)
        print(f"saved {save}")


def main(argv: Sequence[str] | None = None) -> None:
    tyro.cli(view, args=argv, description=__doc__)


if __name__ == "__main__":
    launch(main)
