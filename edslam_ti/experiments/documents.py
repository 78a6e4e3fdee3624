"""Writes the tables of the documents, between marks, from the numbers in docs/results/NAME.json.

A document shows the table NAME between the lines `<!-- NAME -->` and `<!-- end NAME -->`. A file of numbers
contains the columns in order, and the rows; every row states the command and the commit that measured it:

    {"columns": [{"key": "scene", "title": "scene"}, {"key": "ate_cm", "title": "ATE cm", "decimals": 2}],
     "rows": [{"command": "edslam slam --scene office0", "commit": "d9f0d6c", "version": "0.1.0",
               "source": "README.md", "values": {"scene": "office0", "ate_cm": 0.02}}]}

A column of numbers states its "decimals" (with "whole_from_10": none from 10 on) or "significant" digits.
A value is a text, a number, a list of numbers (one per seed, shown as median and range), an object {"mean",
"worst", "lost"} over runs (shown as one number if they are equal), an object {"mean", "spread", "words",
"is_best"} (standard deviation over seeds, or null; the best is bold), or null if nothing was measured.
"notes" of a table stand below it.
"""

import json
import re
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edslam_ti.errors import DataError
from edslam_ti.experiments.report import inserted
from edslam_ti.output import atomic_file

MARK = re.compile(r"^<!-- (?!end )(\w+) -->$", re.MULTILINE)
PROVENANCE = ("command", "commit", "version", "source")  # every row must state these
WHOLE_FROM = 10.0  # larger values have no decimals in columns with "whole_from_10"


def report_tables(root: Path, check: bool) -> None:
    """Write the tables of all documents and print which changed; `check`: raise `DataError` instead."""
    if check:
        stale = differing_documents(root)
        if stale:
            names = ", ".join(str(path) for path in stale)
            raise DataError(f"tables differ from docs/results: {names}; run the command without --check")
        print("all tables agree with docs/results")
        return
    for document in write_tables(root):
        print(f"{document}: tables written")


def documents_in(root: Path) -> list[Path]:
    """Return the documents with tables, without the frozen ones in docs/log."""
    found = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    if not found[0].is_file():
        raise DataError(f"{root}: no README.md there; run this in a checkout, or name one with --root")
    return [path for path in found if path.is_file()]


def table_names(document: Path) -> list[str]:
    """Return the names of the tables that a document shows."""
    return MARK.findall(document.read_text())


def write_tables(root: Path) -> list[Path]:
    """Write every table of README and docs between its marks; return the documents that changed."""
    changed = differing_documents(root)
    for document in changed:
        with atomic_file(document) as temporary:
            temporary.write_text(with_tables(document, root))
    return changed


def differing_documents(root: Path) -> list[Path]:
    """Return the documents whose tables differ from the stored numbers."""
    return [path for path in documents_in(root) if with_tables(path, root) != path.read_text()]


def with_tables(document: Path, root: Path) -> str:
    """Return the text of a document with up-to-date tables."""
    text = document.read_text()
    for name in table_names(document):
        text = inserted(text, name, "\n".join(table_lines(read_table(root, name))), document)
    return text


def read_table(root: Path, name: str) -> dict[str, Any]:
    """Return a stored table after checking that every row has all columns and states its source."""
    path = root / "docs" / "results" / f"{name}.json"
    if not path.is_file():
        raise DataError(f"{path} not found; a document shows the table '{name}'")
    try:
        table: dict[str, Any] = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: not readable as JSON ({error})") from error
    keys = {column["key"] for column in table["columns"]}
    for number, row in enumerate(table["rows"], start=1):
        missing = [key for key in PROVENANCE if not row.get(key)]
        if missing:
            raise DataError(f"{path}: row {number} does not state its {missing[0]}; add it")
        if row["values"].keys() != keys:
            odd = ", ".join(sorted(row["values"].keys() ^ keys))
            raise DataError(f"{path}: row {number}: expected the values of all columns and no others; {odd}")
    return table


def table_lines(table: Mapping[str, Any]) -> list[str]:
    """Return a table in Markdown; columns of numbers are aligned on the right."""
    columns = table["columns"]
    lines = [_line([column["title"] for column in columns])]
    lines.append("|" + "|".join("--:" if is_number(column) else "---" for column in columns) + "|")
    for row in table["rows"]:
        lines.append(_line([cell(row["values"][column["key"]], column) for column in columns]))
    if table.get("notes"):
        lines += ["", *(f"- {note}" for note in table["notes"])]
    return lines


def is_number(column: Mapping[str, Any]) -> bool:
    """Return whether a column contains numbers: it states decimals or significant digits."""
    return "decimals" in column or "significant" in column


def cell(value: Any, column: Mapping[str, Any]) -> str:
    """Return the text of a table's cell, with the decimals of its column."""

    def shown(number: float) -> str:
        if "significant" in column:
            digits = f"{number:.{column['significant']}g}"
            return digits if "e" not in digits else f"{number:.0f}"
        is_whole = column.get("whole_from_10", False) and abs(number) >= WHOLE_FROM
        return f"{number:.{0 if is_whole else column.get('decimals', 0)}f}"

    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return f"{shown(statistics.median(value))} ({shown(min(value))} to {shown(max(value))})"
    if isinstance(value, dict) and "spread" in value:
        spread = "" if value["spread"] is None else f" ± {shown(value['spread'])}"
        text = shown(value["mean"]) + spread + (f", {value['words']}" if value["words"] else "")
        return f"**{text}**" if value["is_best"] else text
    if isinstance(value, dict):
        lost = value.get("lost")  # a number of frames, or true where the source gives none
        note = "" if not lost else ", lost frames" if lost is True else f", {lost} lost"
        mean, worst = shown(value["mean"]), shown(value["worst"])
        return (mean if mean == worst else f"{mean} / {worst}") + note
    return shown(value)


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
