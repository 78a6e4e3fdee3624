"""Chooses one of several cameras in a file."""

from collections.abc import Iterable

from edslam_ti.errors import DataError, plain


def chosen(path: str, what: str, names: Iterable[str], wanted: str | None) -> tuple[str, list[str]]:
    """Return the name that is wanted, or the only one, or the left camera's, and notes for the user.

    A name is wanted as a whole, by some of its consecutive parts ("left" of "prophesee/left"), or by a piece
    of a part. Raises `DataError` where several or none fit.
    """
    names = list(names)
    there = plain(", ".join(names))
    key = wanted if wanted is not None else "left"
    fitting = names if len(names) == 1 and wanted is None else _fitting(names, key)
    if len(fitting) == 1:
        is_guess = wanted is None and len(names) > 1
        return fitting[0], [f"holds {what} {there}; {fitting[0]} is read"] if is_guess else []
    if wanted is None:
        raise DataError(f"{path}: expected one camera, got {what} {there}; choose one of them as the group")
    problem = "several" if fitting else "none"
    raise DataError(f"{path}: {problem} of its {what} fit '{plain(wanted, 80)}'; there are {there}")


def _fitting(names: list[str], wanted: str) -> list[str]:
    whole = wanted.strip("/").lower()
    plain_names = {name: name.strip("/").lower() for name in names}
    for fits in (
        lambda name: name == whole,
        lambda name: f"/{whole}/" in f"/{name}/",
        lambda name: whole in name,
    ):
        if found := [name for name, text in plain_names.items() if fits(text)]:
            return found
    return []
