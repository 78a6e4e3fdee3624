"""Stores finished tables in docs/results of a checkout, from where `edslam reproduce report` shows them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edslam_ti import __version__
from edslam_ti.errors import DataError
from edslam_ti.experiments.paper_options import PaperOptions
from edslam_ti.experiments.table_text import EMPTY, Cell, Column, Row, Table, heading
from edslam_ti.output import atomic_file

PLACES = {"out", "store", "fresh", "jobs", "ray"}  # options that change no number
PUBLISHED = "published"  # stands for the commit of a number that others measured


def store_tables(root: Path, tables: Sequence[Table], options: PaperOptions) -> list[Path]:
    """Write docs/results/paper_NAME.json for each table, a second protocol's with its name behind it.

    Columns without any number are left out. Every row states the command and the commit that measured it.
    """
    results = root / "docs" / "results"
    if not results.is_dir():
        raise DataError(f"{results}: not found; give the checkout that contains docs/ (--store)")
    words = command_words(options)
    written, seen = [], set[str]()
    for table in tables:
        name = f"paper_{table.name}" + (f"_{table.variant}" if table.name in seen else "")
        seen.add(table.name)
        path = results / f"{name}.json"
        command = f"edslam reproduce {table.name} {words}".strip()
        with atomic_file(path) as temporary:
            temporary.write_text(_as_json(table, command))
        written.append(path)
    return written


def command_words(options: PaperOptions) -> str:
    """Return the options that differ from the defaults and change numbers, as on the command line."""
    words = []
    for name, value in options:
        if name in PLACES or value == type(options).model_fields[name].default:
            continue
        values = value if isinstance(value, tuple) else (value,)
        shown = [v.name if isinstance(v, Path) else str(v) for v in values]
        words.append(" ".join([f"--{name.replace('_', '-')}", *shown]))
    return " ".join(words)


def _as_json(table: Table, command: str) -> str:
    columns = [c for c in table.columns if any(_is_filled(row.cells.get(c.key, EMPTY)) for row in table.rows)]
    labels = [k for k, _ in enumerate(table.labels) if any(row.labels[k] for row in table.rows)]
    heads: list[dict[str, Any]] = [{"key": f"label{k}", "title": table.labels[k]} for k in labels]
    heads += [{"key": c.key, "title": heading(c), "decimals": c.decimals} for c in columns]
    rows = [_row(row, labels, columns, command) for row in table.rows]
    lines = ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in rows)
    about, notes = (json.dumps(x, ensure_ascii=False) for x in (table.title, table.notes))
    head = ",\n  ".join(json.dumps(column, ensure_ascii=False) for column in heads)
    parts = (f' "about": {about}', _block("columns", head), _block("rows", lines), f' "notes": {notes}')
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _block(name: str, lines: str) -> str:
    return f' "{name}": [\n  {lines}\n ]'


def _row(row: Row, labels: Sequence[int], columns: Sequence[Column], command: str) -> dict[str, Any]:
    is_ours = bool(row.group)
    values: dict[str, Any] = {f"label{k}": row.labels[k] for k in labels}
    values |= {c.key: _value(row.cells.get(c.key, EMPTY)) for c in columns}
    return {
        "command": command if is_ours else PUBLISHED,
        "commit": row.commit if is_ours else PUBLISHED,
        "version": __version__ if is_ours else PUBLISHED,
        "source": row.labels[0],
        "values": values,
    }


def _is_filled(cell: Cell) -> bool:
    return cell.value is not None or bool(cell.words)


def _value(cell: Cell) -> Any:
    """Return a cell as documents.py reads it."""
    if cell.value is None:
        return cell.words or None
    if cell.spread is None and not cell.words and not cell.is_best:
        return cell.value
    return {"mean": cell.value, "spread": cell.spread, "words": cell.words, "is_best": cell.is_best}
