"""The base of every stage's settings, and of every command's options."""

import difflib
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from edslam_ti.errors import ConfigError, plain, shown


class Stage(BaseModel):
    """Base of every stage's settings, and of every command's options: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
    shorthand: ClassVar[str | None] = None  # the field that `--STAGE VALUE` sets, too

    @classmethod
    def validated(cls, values: dict[str, Any], source: str) -> Self:
        """Return settings of these (nested) values; a ConfigError names the source and the wrong field."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError(f"{source}: {_first_problem(cls, error)}") from error


def _first_problem(model: type[BaseModel], error: ValidationError) -> str:
    """Return one line on the first problem; an unknown key comes with its nearest valid name."""
    problem = error.errors()[0]
    name = ".".join(str(part) for part in problem["loc"])
    if not name:  # of several fields together
        return str(problem["msg"]).removeprefix("Value error, ")
    if problem["type"] != "extra_forbidden":
        return f"{name}: {problem['msg']}, got {shown(problem['input'])}"
    stage: Any = model
    for part in problem["loc"][:-1]:
        stage = stage.model_fields[part].annotation
    close = difflib.get_close_matches(str(problem["loc"][-1]), stage.model_fields, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else f"; known: {', '.join(stage.model_fields)}"
    return f"unknown key '{plain(name, 60)}'{hint}"
