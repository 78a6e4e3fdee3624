"""The command `edslam` and its subcommands: one file each, in the order of COMMANDS."""

import importlib
import sys
from collections.abc import Sequence

from edslam_ti import __version__
from edslam_ti.arguments import HELP, UsageError, nearest_name_hint
from edslam_ti.command_line import launch

COMMANDS = {
    "slam": "track an event camera and build a 3D Gaussian map",
    "live": "track data while they come: a camera, another process, a recording played",
    "view": "show finished runs in a window, or draw them into a picture",
    "export": "write a finished run for other programs: splats, glTF, KITTI, COLMAP, nerfstudio",
    "evaluate": "compare two trajectories, and a mesh with the true surfaces",
    "inspect": "check a recording: numbers, a picture, and what looks wrong in it",
    "convert": "write a recording in another layout, to the bit",
    "simulate": "write a simulated recording",
    "reproduce": "measure over many recordings: tracking, ablations, long_stream, report",
    "benchmark": "time the kernels against alternatives",
}


def main() -> None:
    """Run the subcommand that the process's arguments name; the entry point `edslam`."""
    launch(lambda: run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> None:
    """Run a subcommand with its arguments; only its own module is loaded."""
    name = arguments[0] if arguments else "--help"
    if name in HELP:
        print("usage: edslam COMMAND [OPTIONS]\n")
        print("\n".join(f"  {command:<10} {what}" for command, what in COMMANDS.items()))
        print("\n`edslam COMMAND --help` lists a command's options; `edslam --version` prints the version.")
    elif name == "--version":
        print(f"edslam {__version__}")
    elif name in COMMANDS:
        importlib.import_module(f"edslam_ti.commands.{name}").main(arguments[1:])
    else:
        hint = nearest_name_hint(name, list(COMMANDS))
        raise UsageError(f"expected a command first: {', '.join(COMMANDS)}; got '{name}'{hint}")
