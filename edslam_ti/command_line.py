"""From the command line to validated settings, and from errors to one line and an exit code.

Settings come from, each overriding the one before: defaults, configs/<dataset>.yaml, the method's preset,
--config FILE, flags. Every field of `Config` is a flag, `--stage.field VALUE` for nested ones.
"""

import contextlib
import dataclasses
import difflib
import functools
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from pydantic import BaseModel

from edslam_ti.config import Config, merged, read_differences
from edslam_ti.errors import ConfigError, EdSlamError

CONFIG_HELP = "YAML file of settings; only those that differ from the defaults need be there."
FAILED, USAGE, INTERRUPTED = 1, 2, 130  # exit codes; 130 is the shell's for Ctrl-C


Result = TypeVar("Result")


class UsageError(EdSlamError):
    """The command line cannot be read: an unknown option, or a value of the wrong kind."""


def parse_config(
    argv: Sequence[str] | None = None,
    configs: Path | None = None,
    description: str | None = None,
) -> Config:
    """Return the settings that the command line asks for; `configs` is the folder of <dataset>.yaml files."""
    arguments = _with_true(sys.argv[1:] if argv is None else list(argv))
    defaults = Config().model_dump()

    def parsed_over(values: dict[str, Any], source: str) -> dict[str, Any]:
        return _parse_flags(arguments, Config._validated(values, source).model_dump(), description)

    # The flags say what lies below them, so they are parsed again over each layer found.
    file = parsed_over(defaults, "defaults")["config"]
    differences = {} if file is None else read_differences(file)
    choices = parsed_over(merged(defaults, differences), str(file))
    values = merged(defaults, _dataset_differences(choices, configs))
    values = merged(values, _method_differences(choices["method"]))
    flags = parsed_over(merged(values, differences), "settings")
    del flags["config"]
    return Config._validated(flags, source="command line")


def parse_arguments(
    function: Callable[..., Result], argv: Sequence[str] | None, description: str | None = None
) -> Result:
    """Call a function with the arguments on the command line (tyro); for the apps without a `Config`."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    parsed: list[Callable[[], Result]] = []

    @functools.wraps(function)
    def remember(*args: Any, **kwargs: Any) -> None:
        parsed.append(functools.partial(function, *args, **kwargs))

    with _one_line_errors():
        tyro.cli(
            remember,
            args=arguments,
            description=description,
            config=(tyro.conf.FlagConversionOff,),
            registry=_REGISTRY,
        )
    return parsed[0]()  # outside: what the function raises is its own


def launch(main: Callable[[], None]) -> None:
    """Run an app: what a user can mend ends in one line on stderr and an exit code, not in a traceback."""
    try:
        main()
    except UsageError as error:
        _exit(USAGE, f"{error} (--help lists the options)")
    except EdSlamError as error:
        _exit(FAILED, str(error))
    except BrokenPipeError:  # the reader of our output is gone, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except OSError as error:
        if error.filename is None and not isinstance(error, FileNotFoundError | PermissionError):
            raise
        reason = error.strerror or str(error)
        _exit(FAILED, f"{error.filename}: {reason}" if error.filename is not None else str(error))
    except KeyboardInterrupt:
        _exit(INTERRUPTED, "interrupted")


def _exit(code: int, message: str) -> None:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)


def _dataset_differences(choices: dict[str, Any], configs: Path | None) -> dict[str, Any]:
    """Return what configs/<dataset>.yaml changes, for the data set asked for or found."""
    if configs is None:
        return {}
    name = choices["dataset"]
    if name is None:
        from edslam_ti.datasets import find_sequence

        name, _ = find_sequence(Config(scene=choices["scene"], data_dir=choices["data_dir"]))
    path = configs / f"{name}.yaml"
    return read_differences(path) if path.is_file() else {}


def _method_differences(name: str) -> dict[str, Any]:
    from edslam_ti.methods import METHODS

    if name not in METHODS:
        close = difflib.get_close_matches(name, METHODS, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise ConfigError(f"method: expected one of {', '.join(METHODS)}, got '{name}'{hint}")
    return dict(METHODS[name].overrides)


# -- tyro ---------------------------------------------------------------------------------------------------
# tyro fills plain dataclasses made after the models: it reads types, the models check values, so that a
# value out of range is reported in one place and in one line, whether it came from a file or a flag.


def _parse_flags(arguments: list[str], base: dict[str, Any], description: str | None) -> dict[str, Any]:
    """Return the value of every setting, and of `config`; what no flag sets is taken from the base."""
    settings = _plain_class(Config)
    command_line = dataclasses.make_dataclass(
        "CommandLine",
        [
            (
                "config",
                Annotated[
                    Path | None,
                    tyro.conf.arg(
                        metavar="FILE", help="YAML file of settings that differ from the defaults."
                    ),
                ],
                None,
            ),
            ("settings", Annotated[settings, tyro.conf.arg(name="")], dataclasses.field()),
        ][::-1],
        kw_only=True,
    )
    default = command_line(config=None, settings=_filled(settings, base))
    with _one_line_errors():
        parsed, unknown = tyro.cli(
            command_line,
            args=arguments,
            default=default,
            description=description,
            config=(tyro.conf.FlagConversionOff,),
            registry=_REGISTRY,
            return_unknown_args=True,
        )
    if unknown:
        raise UsageError(_describe_unknown(unknown[0], ["--config", *_options(Config)]))
    return {**dataclasses.asdict(parsed.settings), "config": parsed.config}


def _plain_class(model: type[BaseModel]) -> type:
    """Return a dataclass with the fields of a settings model: types and help, no defaults, no checks."""
    fields: list[tuple[str, Any]] = []
    for name, field in model.model_fields.items():
        kind: Any = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            fields.append((name, _plain_class(kind)))
        else:
            fields.append((name, Annotated[kind, tyro.conf.arg(help=field.description)]))
    result = dataclasses.make_dataclass(model.__name__, fields)
    result.__doc__ = model.__doc__
    return result


def _filled(kind: type, values: dict[str, Any]) -> Any:
    """Return an instance of a plain class with the (nested) values."""
    filled = {}
    for field in dataclasses.fields(kind):
        value = values[field.name]
        nested = dataclasses.is_dataclass(field.type) and isinstance(field.type, type)
        filled[field.name] = _filled(field.type, value) if nested else value  # type: ignore[arg-type]
    return kind(**filled)


_REGISTRY = tyro.constructors.ConstructorRegistry()


@_REGISTRY.primitive_rule
def _boolean(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """Read `true` and `false` in any case, as YAML has them; tyro alone takes only True and False."""
    if info.type is not bool:
        return None
    names = {"true": True, "false": False}

    def read(words: list[str]) -> bool:
        if words[0].lower() not in names:
            raise ValueError(f"expected true or false, got '{words[0]}'")
        return names[words[0].lower()]

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="{true,false}",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, bool),
        str_from_instance=lambda value: [str(value).lower()],
    )


@contextlib.contextmanager
def _one_line_errors() -> Iterator[None]:
    """Turn tyro's boxed message and exit into a `UsageError` of one line; --help passes."""
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            yield
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        lines = []
        for line in captured.getvalue().splitlines():
            text = re.sub(r"\x1b\[[0-9;]*m", "", line).strip().strip("│").strip()
            if text.startswith("╭"):
                continue
            if not text.strip("─╰╯"):  # the rule under the message: help texts follow
                break
            lines.append(text)
        raise UsageError(" ".join(lines) or "the command line cannot be read") from None


def _describe_unknown(word: str, known: list[str]) -> str:
    """Say which option was probably meant."""
    if not word.startswith("-"):
        return f"unexpected argument '{word}'; options look like --scene office0"
    option = word.split("=")[0].replace("_", "-")
    close = difflib.get_close_matches(option, known, n=1)
    if not close:  # `--enabled` for `--mapping.enabled`
        close = [name for name in known if name.endswith("." + option.lstrip("-"))][:1]
    return f"unknown option '{option}'" + (f"; did you mean '{close[0]}'?" if close else "")


def _with_true(arguments: list[str]) -> list[str]:
    """Return the arguments with `true` behind every bare switch: `--visualize` is `--visualize true`."""
    switches = _options(Config, of_type=bool)
    result = []
    for word, following in zip(arguments, [*arguments[1:], "--"]):
        result += [word, "true"] if word in switches and following.startswith("--") else [word]
    return result


def _options(model: type[BaseModel], prefix: str = "--", of_type: type | None = None) -> list[str]:
    """Return the flags of a settings model, all or those of one type."""
    result = []
    for name, field in model.model_fields.items():
        flag = prefix + name.replace("_", "-")
        kind: Any = field.annotation
        nested = isinstance(kind, type) and issubclass(kind, BaseModel)
        if nested:
            result += _options(kind, flag + ".", of_type)
        elif of_type is None or kind is of_type:
            result.append(flag)
    return result
