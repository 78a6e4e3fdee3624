"""edslam view RESULT [RESULT ...] [--save FILE.png]

Show finished runs: trajectories in colours, map points and mesh. A RESULT is a folder that `edslam slam`
made, for instance results/builtin/office0/ed_slam/latest. --save draws them into a picture and needs no
display.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from edslam_ti.arguments import Shown, UsageError, read_options
from edslam_ti.config import Stage


class ViewOptions(Stage):
    """What to show."""

    results: Annotated[tuple[Path, ...], Shown("RESULT [RESULT ...]", is_positional=True)]
    """Folders that `edslam slam` made."""
    save: Annotated[Path | None, Shown("FILE.png")] = None
    """Draw into this PNG file instead of a window."""


def main(argv: Sequence[str] | None = None) -> None:
    """Show finished runs in a window, or draw them into a picture."""
    options = read_options(ViewOptions, argv, "edslam view", __doc__)
    if options.save is not None and options.save.suffix.lower() != ".png":
        raise UsageError(f"--save: expected a file name that ends in .png, got {options.save}")
    from edslam_ti.results.plots import draw_results  # slow to load
    from edslam_ti.results.window import show_results

    if options.save is None:
        show_results(options.results)
    else:
        draw_results(options.results, options.save)
        print(f"saved {options.save}")
