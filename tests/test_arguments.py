"""Words on the command line become values by the type of the field they are for."""

import contextlib
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import AliasChoices, Field

from edslam_ti.arguments import Shown, UsageError, options_of, read_given, read_options
from edslam_ti.commands.benchmark import BenchmarkOptions
from edslam_ti.commands.evaluate import EvaluateOptions
from edslam_ti.commands.simulate import SimulateOptions
from edslam_ti.commands.view import ViewOptions
from edslam_ti.config import Config, Stage, merged, with_present_names
from edslam_ti.errors import ConfigError


class Inner(Stage):
    """A stage."""

    speed: float = Field(1.0, gt=0, validation_alias=AliasChoices("speed", "velocity"))
    """Metres per second."""


class Everything(Stage):
    """Options of every kind."""

    files: Annotated[tuple[Path, ...], Shown("FILE [FILE ...]", is_positional=True)]
    """Positional."""
    count: int
    """Required."""
    up: Literal["x", "-x"] = "x"
    """Choices."""
    point: tuple[float, float, float] | None = None
    """Three numbers."""
    gap: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(le=9)]] | None = None
    """Two numbers with bounds of their own."""
    sizes: tuple[tuple[int, int], ...] = ((1, 2),)
    """Pairs."""
    seeds: tuple[int, ...] = (0,)
    """Any number."""
    quick: bool = False
    """Switch."""
    inner: Inner = Inner()


def read(line: str) -> Everything:
    return read_options(Everything, line.split(), "edslam test", "A test.")


def test_a_stage_may_be_given_by_one_word() -> None:
    def read(line: str) -> SimulateOptions:
        return read_options(SimulateOptions, line.split(), "edslam simulate", "")

    options = read("--out x --sensor davis346 --sensor.dead-time 0")
    assert (options.sensor.preset, options.sensor.dead_time, options.width) == ("davis346", 0.0, 346)
    with pytest.raises(UsageError, match=r"--sensor\.preset: .* got 'davis34'; did you mean 'davis346'"):
        read("--out x --sensor davis34")


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        ("--up -x", "up", "-x"),
        ("--point -1 -1e-3 2", "point", (-1.0, -0.001, 2.0)),
        ("--point None", "point", None),
        ("--gap 0.1 2", "gap", (0.1, 2.0)),
        ("--sizes 320 240 640 480", "sizes", ((320, 240), (640, 480))),
        ("--seeds", "seeds", ()),
        ("--seeds 1 --seeds 2 3", "seeds", (2, 3)),  # the last one counts
        ("--quick", "quick", True),
        ("--quick FALSE", "quick", False),
        ("--quick=true", "quick", True),
        ("--inner.speed 2", "inner", Inner(speed=2.0)),
        ("--inner.velocity 3", "inner", Inner(speed=3.0)),  # its former name
    ],
)
def test_words_become_values(words: str, name: str, value: Any) -> None:
    assert getattr(read(f"a.txt --count 3 {words}"), name) == value


def test_positional_words_may_stand_anywhere() -> None:
    options = read("a.txt --count 3 b.txt --quick --up x c.txt")
    assert options.files == (Path("a.txt"), Path("b.txt"), Path("c.txt"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a --count", "--count: expected a value, got none"),
        ("a", "--count: expected a value, got none"),
        ("--count 3", r"FILE \[FILE ...\]: expected a value, got none"),
        ("a --count 1.5", "--count: expected a whole number, got '1.5'"),
        ("a --count 3 --up y", "--up: expected one of x, -x, got 'y'"),
        ("a --count 3 --point 1 2", "--point: expected 3 values, got 2"),
        ("a --count 3 --sizes 1 2 3", "--sizes: expected 2 values each, got 3 in all"),
        ("a --count 3 --quick maybe", "--quick: expected true or false, got 'maybe'"),
        ("a --count 3 --inner.sped 2", "unknown option '--inner.sped'; did you mean '--inner.speed'"),
        ("a --count 3 -x", "unknown option '-x'"),
    ],
)
def test_words_that_do_not_fit_are_named(words: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read(words)


def test_a_value_out_of_range_is_an_error_of_the_settings() -> None:
    with pytest.raises(ConfigError, match=r"inner\.speed: Input should be greater than 0, got -1"):
        read("a --count 3 --inner.speed -1")


def test_former_names_are_read_from_files_too() -> None:
    differences = with_present_names(Everything, {"inner": {"velocity": 4.0}, "count": 1})
    assert differences == {"inner": {"speed": 4.0}, "count": 1}
    base = {"files": ["a"], "inner": {"speed": 1.0}}
    assert Everything.validated(merged(base, differences), "test").inner.speed == 4.0


def test_help_shows_defaults_and_required_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        read("--help")
    assert stop.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for text in (
        "usage: edslam test [-h] FILE [FILE ...] [OPTIONS]",
        "A test.",
        "--count INT Required. (required)",
        "--up {x,-x} Choices. (default: x)",
        "--point {None}|FLOAT FLOAT FLOAT Three numbers. (default: None)",
        "--sizes [INT INT ...] Pairs. (default: 1 2)",
        "--quick {true,false} Switch. (default: false)",
        "inner: A stage. --inner.speed FLOAT Metres per second. (default: 1.0)",
    ):
        assert text in shown


@pytest.mark.parametrize("model", [Config, SimulateOptions, ViewOptions, EvaluateOptions, BenchmarkOptions])
def test_every_option_of_every_command_takes_a_word(model: type[Stage]) -> None:
    for option in options_of(model):
        words = [str(word) for word in ("0.5", "1", "2") for _ in range(2)]
        for count in (1, 2, 3):
            with contextlib.suppress(UsageError):  # a wrong number of words, or a value out of bounds
                read_given(model, [option.flags[0], *words[:count]], "edslam test", None)
