"""Turns the command line into validated settings, and errors into one line and an exit code.

Settings come from, each overriding the one before: defaults, configs/<dataset>.yaml, the method's preset,
--config FILE, flags. Every field of `Config` is a flag, `--stage.field VALUE` for nested ones.
"""

import atexit
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydantic import Field

from edslam_ti.arguments import Shown, UsageError, nearest_name_hint, read_given
from edslam_ti.config import CONFIGS, Config, dataset_differences, merged, read_differences
from edslam_ti.errors import LONGEST_MESSAGE, ConfigError, EdSlamError, LostTrackError, plain
from edslam_ti.interruption import Stopped
from edslam_ti.methods import METHODS

# Exit codes. A command that a signal has ended adds the signal's number to SIGNALLED, as the shell does:
# 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP.
# Settings that change no result
WITH_RESUME = ("checkpoint", "visualize", "viewer", "viewer_address", "viewer_port", "log")
FAILED, USAGE, LOST, SIGNALLED = 1, 2, 3, 128


class _RunOptions(Config):
    """All settings of a run, and a file of them."""

    config: Annotated[Path | None, Shown("FILE")] = Field(None)
    """YAML file of settings that differ from the defaults."""
    resume: Annotated[Path | None, Shown("RUN")] = Field(None)
    """Results folder of a run that was cut off: go on with it, with its own settings."""


@dataclass(frozen=True)
class Choices:
    """What a command line asks for."""

    config: Config  # the defaults with the differences
    differences: dict[str, Any]  # what files and flags change
    resumed: Path | None  # folder of a run to go on with; None: a new run


def read_choices(
    argv: Sequence[str] | None = None, description: str | None = None, program: str = "edslam slam"
) -> Choices:
    """Return defaults with what --config FILE and the flags change; nothing heavy loads.

    `with_presets` puts what the data set and the method need below them. --resume RUN takes the settings of
    the run instead.
    """
    notes = {"method": [f"{name}: {method.description}" for name, method in METHODS.items()]}
    given = read_given(_RunOptions, argv, program, description, notes)
    file, resumed = given.pop("config", None), given.pop("resume", None)
    if resumed is not None:
        file = _settings_of(resumed, file, given)
    differences = merged({} if file is None else read_differences(file), given)
    choices = Config.validated(merged(Config().model_dump(), differences), source="command line")
    if choices.method not in METHODS:
        hint = nearest_name_hint(choices.method, list(METHODS))
        raise ConfigError(f"method: expected one of {', '.join(METHODS)}, got '{choices.method}'{hint}")
    return Choices(choices, differences, resumed)


def _settings_of(resumed: Path, file: Path | None, given: dict[str, Any]) -> Path:
    """Return the settings file of a run to go on with; flags that change its result are refused."""
    changing = ["config"] if file is not None else [name for name in given if name not in WITH_RESUME]
    if changing:
        allowed = ", ".join(f"--{name}" for name in WITH_RESUME)
        raise UsageError(
            f"--resume: goes on with the run's own settings, got --{changing[0].replace('_', '-')}; only "
            f"{allowed} can be given with it"
        )
    if not (resumed / "config.yaml").is_file():
        raise ConfigError(f"--resume: {resumed}: expected the folder of a run, found no config.yaml in it")
    return resumed / "config.yaml"


def with_presets(choices: Choices, configs: Path = CONFIGS) -> Config:
    """Return a run's settings; `configs` is the folder of <dataset>.yaml files.

    Without --dataset it detects the format from the data folder, which loads torch. A recording in one of our
    own layouts may state the data set whose settings fit it.
    """
    dataset = choices.config.dataset
    if dataset in (None, "event_replica", "generic"):
        from edslam_ti.datasets import preset_of

        dataset = preset_of(choices.config)
    values = merged(Config().model_dump(), dataset_differences(dataset, configs))
    values = merged(values, dict(METHODS[choices.config.method].overrides))
    return Config.validated(merged(values, choices.differences), source="command line")


def parse_config(
    argv: Sequence[str] | None = None, configs: Path = CONFIGS, description: str | None = None
) -> Config:
    """Return the settings that the command line asks for; `configs` is the folder of <dataset>.yaml files."""
    return with_presets(read_choices(argv, description), configs)


def launch(main: Callable[[], None]) -> None:
    """Run a command; errors that a user can fix print one line on stderr and no traceback."""
    try:
        os.getcwd()
    except OSError:  # libraries abort there
        _exit(FAILED, "the current folder no longer exists; change to another one")
    try:
        main()
    except UsageError as error:
        _exit(USAGE, f"{error} (--help lists the options)")
    except LostTrackError as error:
        _exit(LOST, str(error))
    except EdSlamError as error:
        _exit(FAILED, str(error))
    except BrokenPipeError:  # the reader of the output has ended, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except OSError as error:  # of the system: a full disk, say, which names no file
        reason = error.strerror or str(error)
        _exit(FAILED, f"{error.filename}: {reason}" if error.filename is not None else reason)
    except Stopped as stopped:
        _exit(
            SIGNALLED + stopped.number,
            "interrupted" if stopped.number == signal.SIGINT else f"stopped by {stopped}",
        )
    except KeyboardInterrupt:
        _exit(SIGNALLED + signal.SIGINT, "interrupted")
    finally:  # everything is done: Ctrl-C while the libraries end would only print their tracebacks
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


def _exit(code: int, message: str) -> NoReturn:
    with contextlib.suppress(OSError):  # nobody reads it any more
        print(f"error: {plain(' '.join(message.split()), LONGEST_MESSAGE)}", file=sys.stderr)
    sys.exit(code)
