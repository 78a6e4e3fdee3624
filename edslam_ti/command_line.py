"""Turns the command line into validated settings, and errors into one line and an exit code.

Settings come from, each overriding the one before: defaults, configs/<dataset>.yaml, the method's preset,
--config FILE, flags. Every field of `Config` is a flag, `--stage.field VALUE` for nested ones.
"""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydantic import Field

from edslam_ti.arguments import Shown, UsageError, nearest_name_hint, read_given
from edslam_ti.config import CONFIGS, Config, dataset_differences, merged, read_differences
from edslam_ti.errors import ConfigError, EdSlamError
from edslam_ti.methods import METHODS

FAILED, USAGE, INTERRUPTED = 1, 2, 130  # exit codes; shells use 130 for Ctrl-C


class _RunOptions(Config):
    """All settings of a run, and a file of them."""

    config: Annotated[Path | None, Shown("FILE")] = Field(None)
    """YAML file of settings that differ from the defaults."""


def read_choices(
    argv: Sequence[str] | None = None, description: str | None = None, program: str = "edslam slam"
) -> tuple[Config, dict[str, Any]]:
    """Return the defaults changed by --config FILE and the flags, and these changes; loads no heavy library.

    `with_presets` adds the presets of the data set and the method, which these changes override.
    """
    notes = {"method": [f"{name}: {method.description}" for name, method in METHODS.items()]}
    given = read_given(_RunOptions, argv, program, description, notes)
    file = given.pop("config", None)
    differences = merged({} if file is None else read_differences(file), given)
    choices = Config.validated(merged(Config().model_dump(), differences), source="command line")
    if choices.method not in METHODS:
        hint = nearest_name_hint(choices.method, list(METHODS))
        raise ConfigError(f"method: expected one of {', '.join(METHODS)}, got '{choices.method}'{hint}")
    return choices, differences


def with_presets(choices: Config, differences: dict[str, Any], configs: Path = CONFIGS) -> Config:
    """Return a run's settings; `configs` is the folder of <dataset>.yaml files.

    Without --dataset it detects the format from the data folder, which loads torch.
    """
    dataset = choices.dataset
    if dataset is None:
        from edslam_ti.datasets import find_sequence

        dataset, _ = find_sequence(choices)
    values = merged(Config().model_dump(), dataset_differences(dataset, configs))
    values = merged(values, dict(METHODS[choices.method].overrides))
    return Config.validated(merged(values, differences), source="command line")


def parse_config(
    argv: Sequence[str] | None = None, configs: Path = CONFIGS, description: str | None = None
) -> Config:
    """Return the settings of the command line; `configs` is the folder of <dataset>.yaml files."""
    return with_presets(*read_choices(argv, description), configs)


def launch(main: Callable[[], None]) -> None:
    """Run a command; errors that a user can fix print one line on stderr and no traceback."""
    try:
        main()
    except UsageError as error:
        _exit(USAGE, f"{error} (--help lists the options)")
    except EdSlamError as error:
        _exit(FAILED, str(error))
    except BrokenPipeError:  # the reader of the output has ended, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except OSError as error:
        if error.filename is None and not isinstance(error, FileNotFoundError | PermissionError):
            raise
        reason = error.strerror or str(error)
        _exit(FAILED, f"{error.filename}: {reason}" if error.filename is not None else str(error))
    except KeyboardInterrupt:
        _exit(INTERRUPTED, "interrupted")


def _exit(code: int, message: str) -> NoReturn:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)
