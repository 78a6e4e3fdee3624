"""Reads a command's arguments into the fields of a settings model, and makes the help from the same fields.

Every field is an option: `--stage.field VALUE` or `--stage.field=VALUE`. A tuple takes several values; a
boolean without a value is true. This module converts words by the field's type. The model itself checks
ranges, so a value out of range gives the same message from a file and from an option.
"""

import difflib
import shutil
import sys
import textwrap
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from edslam_ti.config import Stage, former_names
from edslam_ti.errors import EdSlamError

Options = TypeVar("Options", bound=Stage)
Values = dict[str, Any]  # of options that were given, by field; nested for stages
Notes = dict[str, list[str]]  # lines that help adds to an option, by field
HELP = ("-h", "--help")
MAX_WIDTH = 110  # columns of the help


class UsageError(EdSlamError):
    """The command line cannot be read: an unknown option, or a value of the wrong kind."""


@dataclass(frozen=True)
class Shown:
    """How help names a field's values, as in `Annotated[Path, Shown("FILE.png")]`."""

    metavar: str
    is_positional: bool = False  # given without a flag


@dataclass(frozen=True)
class Option:
    """A field of a settings model on the command line."""

    path: tuple[str, ...]  # the stages that lead to the field, and its name
    kind: Any  # type of its value
    field: FieldInfo
    is_shorthand: bool = False  # `--STAGE VALUE` sets it, too

    @property
    def shown(self) -> Shown | None:
        """How help shows the option, if the model says so."""
        return next((x for x in self.field.metadata if isinstance(x, Shown)), None)

    @property
    def is_positional(self) -> bool:
        """Whether the option is given without a flag."""
        return self.shown is not None and self.shown.is_positional

    @property
    def flags(self) -> list[str]:
        """The flag, then its former names."""
        *stages, name = self.path
        names = [name, *former_names(self.field)]
        paths = [[*stages, n] for n in names] + ([stages] if self.is_shorthand else [])
        return ["--" + ".".join(path).replace("_", "-") for path in paths]

    @property
    def label(self) -> str:
        """The option's name in messages."""
        return self.shown.metavar if self.shown is not None and self.is_positional else self.flags[0]

    @property
    def metavar(self) -> str:
        """The placeholder for the option's values in help."""
        return self.shown.metavar if self.shown is not None else _metavar(self.kind)


def options_of(model: type[BaseModel], stages: tuple[str, ...] = ()) -> list[Option]:
    """Return the options of a settings model, those of its stages after its own."""
    own, nested = [], []
    for name, field in model.model_fields.items():
        kind: Any = field.annotation
        if _is_model(kind):
            nested += options_of(kind, (*stages, name))
        else:
            is_shorthand = bool(stages) and getattr(model, "shorthand", None) == name
            own.append(Option((*stages, name), kind, field, is_shorthand))
    return own + nested


def read_options(
    model: type[Options], arguments: Sequence[str] | None, program: str, description: str | None
) -> Options:
    """Read a command's options from its arguments (None: those of the process), and check them."""
    given = read_given(model, arguments, program, description)
    missing = [option for option in options_of(model) if _is_missing(option, given)]
    if missing:
        raise UsageError(f"{missing[0].label}: expected a value, got none")
    return model.validated(given, source="command line")


def read_given(
    model: type[Stage],
    arguments: Sequence[str] | None,
    program: str,
    description: str | None,
    notes: Notes | None = None,
) -> Values:
    """Return the given values, converted to the fields' types but not checked.

    With -h or --help anywhere, print the help and exit. `notes` adds lines to the help of options.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    options = options_of(model)
    if any(word in HELP for word in words):
        print(help_text(model, program, description or "", notes or {}))
        sys.exit(0)
    by_flag = {flag: option for option in options for flag in option.flags}
    positional = next((option for option in options if option.is_positional), None)
    remaining = [option for option in options if option.is_positional]
    given: Values = {}
    loose: list[str] = []
    while words:
        word = words.pop(0)
        name, has_value, value = word.partition("=")
        flag = name.replace("_", "-")
        if flag in by_flag and not by_flag[flag].is_positional:
            option = by_flag[flag]
            taken = [value] if has_value else _take(option.kind, words)
            _put(given, option, _read(option, taken))
        elif word.startswith("-") or positional is None:
            known = [f for f, option in by_flag.items() if not option.is_positional]
            raise UsageError(_describe_unknown(word, known))
        else:
            loose.append(word)
    for option in remaining:
        taken = _take(option.kind, loose)
        if taken:
            _put(given, option, _read(option, taken))
    if loose:
        raise UsageError(f"unexpected argument '{loose[0]}'")
    return given


def nearest_name_hint(name: str, known: Sequence[str]) -> str:
    """Return `; did you mean 'scene'?` for a name that is close to a known one, else an empty string."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def _describe_unknown(word: str, known: list[str]) -> str:
    """Return a message that names the option that was probably meant."""
    if not word.startswith("-"):
        return f"unexpected argument '{word}'; options look like --scene office0"
    option = word.split("=")[0].replace("_", "-")
    hint = nearest_name_hint(option, known)
    if not hint:  # `--enabled` for `--mapping.enabled`
        ends = [name for name in known if name.endswith("." + option.lstrip("-"))]
        hint = f"; did you mean '{ends[0]}'?" if ends else ""
    return f"unknown option '{option}'{hint}"


# --- words to values ---


def _take(kind: Any, words: list[str]) -> list[str]:
    """Remove the words of one option's value from the front of `words`, at most up to the next option."""
    most = 1 if words[:1] == ["None"] else _num_words(kind)
    taken: list[str] = []
    while words and not words[0].startswith("--") and (most is None or len(taken) < most):
        taken.append(words.pop(0))
    return taken


def _bare(kind: Any) -> Any:
    """Return T of `Annotated[T, ...]`; the bounds in it are pydantic's to check."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _num_words(kind: Any) -> int | None:
    """Return how many words a value of this type takes, None for any number."""
    kind = _bare(kind)
    if get_origin(kind) in (Union, types.UnionType):
        return _num_words(_without_none(kind))
    if get_origin(kind) is not tuple:
        return 1
    items = get_args(kind)
    return None if items[-1] is ... else len(items)


def _read(option: Option, words: list[str]) -> Any:
    """Return an option's value; raises UsageError where the words do not fit its type."""
    try:
        return _value(option.kind, words)
    except ValueError as error:
        raise UsageError(f"{option.label}: {error}") from None


def _value(kind: Any, words: list[str]) -> Any:
    kind = _bare(kind)
    origin, items = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return None if words == ["None"] else _value(_without_none(kind), words)
    if origin is tuple:
        return _tuple(items, words)
    if kind is bool and not words:
        return True
    if len(words) != 1:
        raise ValueError("expected a value, got none" if not words else f"expected one value, got {words}")
    word = words[0]
    if origin is Literal:
        if word not in items:
            hint = nearest_name_hint(word, items)
            raise ValueError(f"expected one of {', '.join(items)}, got '{word}'{hint}")
        return word
    reader, expected = _READERS[kind]
    try:
        return reader(word)
    except (ValueError, KeyError):
        raise ValueError(f"expected {expected}, got '{word}'") from None


def _tuple(items: tuple[Any, ...], words: list[str]) -> tuple[Any, ...]:
    if items[-1] is not ...:
        if len(words) != len(items):
            raise ValueError(f"expected {len(items)} values, got {len(words)}")
        return tuple(_value(item, [word]) for item, word in zip(items, words))
    size = _num_words(items[0]) or 1
    if len(words) % size:
        raise ValueError(f"expected {size} values each, got {len(words)} in all")
    return tuple(_value(items[0], words[k : k + size]) for k in range(0, len(words), size))


def _boolean(word: str) -> bool:
    """Read true or false in upper or lower case, as YAML does."""
    return {"true": True, "false": False}[word.lower()]


_READERS: dict[Any, tuple[Callable[[str], Any], str]] = {
    bool: (_boolean, "true or false"),
    int: (int, "a whole number"),
    float: (float, "a number"),
    str: (str, "text"),
    Path: (Path, "a path"),
}


def _without_none(kind: Any) -> Any:
    """Return T of `T | None`; settings have no other unions."""
    (one,) = [item for item in get_args(kind) if item is not type(None)]
    return one


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _put(given: Values, option: Option, value: Any) -> None:
    for stage in option.path[:-1]:
        given = given.setdefault(stage, {})
    given[option.path[-1]] = value


def _is_missing(option: Option, given: Values) -> bool:
    return option.field.is_required() and len(option.path) == 1 and option.path[0] not in given


# --- help ---


def help_text(model: type[BaseModel], program: str, description: str, notes: Notes) -> str:
    """Return a command's help: description, then every option with its default, stage by stage."""
    options = options_of(model)
    positional = [option for option in options if option.is_positional]
    width = min(shutil.get_terminal_size().columns, MAX_WIDTH) - 2
    words = [program, "[-h]", *(option.metavar for option in positional), "[OPTIONS]"]
    lines = [f"usage: {' '.join(words)}", "", description.strip(), ""]
    for option in positional:
        lines += _describe(option, notes, width)
    lines += ["options:", "  -h, --help", "      show this help and exit"]
    stage: tuple[str, ...] = ()
    for option in options:
        if option.is_positional:
            continue
        if option.path[:-1] != stage:
            stage = option.path[:-1]
            lines += ["", f"{'.'.join(stage)}: {_summary(_stage_model(model, stage))}"]
        lines += _describe(option, notes, width)
    return "\n".join(lines)


def _stage_model(model: Any, stages: tuple[str, ...]) -> Any:
    for stage in stages:
        model = model.model_fields[stage].annotation
    return model


def _summary(model: Any) -> str:
    return (model.__doc__ or "").strip().splitlines()[0]


def _describe(option: Option, notes: Notes, width: int) -> list[str]:
    name = option.metavar if option.is_positional else f"{option.flags[0]} {option.metavar}"
    text = " ".join((option.field.description or "").split())
    if not option.field.is_required():
        text += f" (default: {_shown_value(option.field.get_default(call_default_factory=True))})"
    elif not option.is_positional:
        text += " (required)"
    lines = ["  " + name, *textwrap.wrap(text, width, initial_indent=" " * 6, subsequent_indent=" " * 6)]
    for note in notes.get(".".join(option.path), []):
        lines += textwrap.wrap(note, width, initial_indent=" " * 8, subsequent_indent=" " * 10)
    return lines


def _shown_value(value: Any) -> str:
    """Return a default as it would be written on the command line."""
    if isinstance(value, tuple):
        return " ".join(_shown_value(item) for item in value) or "none"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _metavar(kind: Any) -> str:
    kind = _bare(kind)
    origin, items = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return "{None}|" + _metavar(_without_none(kind))
    if origin is Literal:
        return "{" + ",".join(items) + "}"
    if origin is tuple:
        words = [_metavar(item) for item in items if item is not ...]
        return f"[{words[0]} ...]" if items[-1] is ... else " ".join(words)
    return "{true,false}" if kind is bool else str(kind.__name__).upper()
