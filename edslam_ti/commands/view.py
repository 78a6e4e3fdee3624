"""edslam view RESULT [RESULT ...] [--save FILE.png | --viewer]

Show finished runs: trajectories in colours, map points and mesh. A RESULT is a folder that `edslam slam`
made, for instance results/builtin/office0/ed_slam/latest. --save draws them into a picture and needs no
display. --viewer shows them on a page for the browser: side by side, as splats, mesh or points, along their
paths, to be measured and to be compared with the truth.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from edslam_ti.arguments import Shown, UsageError, read_options
from edslam_ti.config import Stage


class ViewOptions(Stage):
    """What to show."""

    results: Annotated[tuple[Path, ...], Shown("RESULT [RESULT ...]", is_positional=True)]
    """Folders that `edslam slam` made."""
    save: Annotated[Path | None, Shown("FILE.png")] = None
    """Draw into this PNG file instead of a window."""
    viewer: bool = False
    """Show them on a page for the browser (extra `viewer`) until Ctrl-C."""
    viewer_address: str = Field("127.0.0.1", min_length=1)
    """Address of the page. With any other one, other machines can see it."""
    viewer_port: int = Field(8080, ge=0, le=65535)
    """Port of the page; the next free one is taken where it is in use; 0: any."""


def main(argv: Sequence[str] | None = None) -> None:
    """Show finished runs in a window, or draw them into a picture."""
    options = read_options(ViewOptions, argv, "edslam view", __doc__)
    if options.save is not None and options.save.suffix.lower() != ".png":
        raise UsageError(f"--save: expected a file name that ends in .png, got {options.save}")
    if options.save is not None and options.viewer:
        raise UsageError("--save and --viewer: expected one of them, got both")
    from edslam_ti.results.plots import draw_results  # slow to load
    from edslam_ti.results.window import show_results

    if options.viewer:
        from edslam_ti.results.browse import show_in_browser

        address, port = options.viewer_address, options.viewer_port
        show_in_browser(options.results, address, port, lambda line: print(line, flush=True))
    elif options.save is None:
        show_results(options.results)
    else:
        draw_results(options.results, options.save)
        print(f"saved {options.save}")
