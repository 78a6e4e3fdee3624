"""Tables of numbers with their spread and where they come from, as Markdown and as LaTeX."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

LOW, HIGH = -1, 1  # which values are the best of a column
DASH = "-"


@dataclass(frozen=True)
class Column:
    """A column of numbers."""

    key: str
    title: str
    decimals: int = 2
    best: int = 0  # LOW, HIGH, or 0: none is better than others
    group: str = ""  # columns of one group stand under a common heading
    whole_from: float = math.inf  # larger values have no decimals


@dataclass(frozen=True)
class Cell:
    """A number with the standard deviation over seeds, or words in place of one."""

    value: float | None = None
    spread: float | None = None  # None: of one run
    words: str = ""  # after the number
    is_best: bool = False  # of the rows of its group

    def text(self, column: Column) -> str:
        """Return the cell in plain text."""
        if self.value is None:
            return self.words or DASH
        number = f"{self.value:.{0 if abs(self.value) >= column.whole_from else column.decimals}f}"
        spread = "" if self.spread is None else f" ± {self.spread:.{column.decimals}f}"
        return number + spread + (f", {self.words}" if self.words else "")


EMPTY = Cell()


@dataclass(frozen=True)
class Row:
    """One line: labels that say what it is of, and cells by column."""

    labels: tuple[str, ...]
    cells: dict[str, Cell]
    group: str = ""  # the best of each column is sought among rows of one group; "": in none of them
    commit: str = ""  # of the program that measured it; "": others did


@dataclass(frozen=True)
class Table:
    """A table with a name for files, and notes below it."""

    name: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    variant: str = ""  # the protocol, where there are several tables of one name

    def with_best(self) -> "Table":
        """Return the table with the best cell of every column and group of rows marked."""
        rows = list(self.rows)
        for column in self.columns:
            for group in {row.group for row in rows if column.best and row.group}:
                values = {
                    k: row.cells[column.key].value
                    for k, row in enumerate(rows)
                    if row.group == group and row.cells.get(column.key, EMPTY).value is not None
                }
                if len(values) < 2:
                    continue
                shown = {k: round(v, column.decimals) for k, v in values.items() if v is not None}
                top = max(shown.values(), key=lambda v: column.best * v)
                for k in (k for k, v in shown.items() if v == top):
                    cell = replace(rows[k].cells[column.key], is_best=True)
                    rows[k] = replace(rows[k], cells={**rows[k].cells, column.key: cell})
        return replace(self, rows=tuple(rows))


# --- Markdown ---


def as_markdown(tables: Iterable[Table]) -> str:
    """Return tables one below the other, each with its title and its notes; the best cells are bold."""
    lines: list[str] = []
    for table in tables:
        head = [*table.labels, *(heading(column) for column in table.columns)]
        rule = ["---"] * len(table.labels) + ["--:"] * len(table.columns)
        lines += [f"## {table.title}", "", _line(head), "|" + "|".join(rule) + "|"]
        for row in table.rows:
            cells = [_in_markdown(row.cells.get(column.key, EMPTY), column) for column in table.columns]
            lines.append(_line([*(_escaped(label) for label in row.labels), *cells]))
        lines += ["", *(f"- {note}" for note in table.notes), ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def heading(column: Column) -> str:
    """Return a column's title after that of its group."""
    return f"{column.group} {column.title}".strip()


def _in_markdown(cell: Cell, column: Column) -> str:
    text = _escaped(cell.text(column))
    return f"**{text}**" if cell.is_best else text


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


# --- LaTeX ---

SPECIAL = {
    "\\": r"\textbackslash{}",
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "†": r"\dag{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
}


def as_latex(tables: Iterable[Table]) -> str:
    """Return tables for booktabs (and `\\usepackage[utf8]{inputenc}`), each a `table*` with its notes."""
    return "\n".join(_latex(table) for table in tables)


def _latex(table: Table) -> str:
    first = len(table.labels)
    lines = [
        "\\begin{table*}",
        "\\centering",
        f"\\caption{{{tex(table.title)}}}",
        f"\\label{{tab:{table.name}{'-' + table.variant if table.variant else ''}}}",
        f"\\begin{{tabular}}{{{'l' * first}{'r' * len(table.columns)}}}",
        "\\toprule",
    ]
    groups = _spans(table.columns, first)
    if groups:
        spans = [f"\\multicolumn{{{n}}}{{c}}{{{tex(name)}}}" for name, _, n in groups]
        lines.append(" & ".join([*[""] * first, *spans]) + " \\\\")
        lines += [f"\\cmidrule(lr){{{start + 1}-{start + n}}}" for name, start, n in groups if name]
    lines.append(_tex_line([*table.labels, *(column.title for column in table.columns)]))
    lines.append("\\midrule")
    previous = table.rows[0].group if table.rows else ""
    for row in table.rows:
        if row.group != previous:
            lines.append("\\midrule")
        previous = row.group
        cells = [_in_latex(row.cells.get(column.key, EMPTY), column) for column in table.columns]
        lines.append(" & ".join([*(tex(label) for label in row.labels), *cells]) + " \\\\")
    lines += ["\\bottomrule", "\\end{tabular}"]
    if table.notes:
        lines += ["\\begin{flushleft}\\footnotesize", *(tex(note) + "\\\\" for note in table.notes)]
        lines.append("\\end{flushleft}")
    return "\n".join([*lines, "\\end{table*}", ""])


def _spans(columns: Sequence[Column], first: int) -> list[tuple[str, int, int]]:
    """Return name, first column and width of each run of columns of a group; none without groups."""
    spans: list[tuple[str, int, int]] = []
    for k, column in enumerate(columns):
        if spans and spans[-1][0] == column.group:
            spans[-1] = (column.group, spans[-1][1], spans[-1][2] + 1)
        else:
            spans.append((column.group, first + k, 1))
    return spans if any(name for name, _, _ in spans) else []


def _in_latex(cell: Cell, column: Column) -> str:
    text = tex(cell.text(column))
    return f"\\textbf{{{text}}}" if cell.is_best else text


def _tex_line(cells: Sequence[str]) -> str:
    return " & ".join(tex(cell) for cell in cells) + " \\\\"


def tex(text: str) -> str:
    """Return text with LaTeX's special characters escaped."""
    return "".join(SPECIAL.get(c, c) for c in text.replace("`", ""))


# --- sources ---


@dataclass
class Footnotes:
    """Numbers sources in the order in which they are cited."""

    texts: list[str] = field(default_factory=list)

    def cite(self, text: str) -> str:
        """Return a source's number in brackets."""
        if text not in self.texts:
            self.texts.append(text)
        return f"[{self.texts.index(text) + 1}]"

    def lines(self) -> list[str]:
        """Return all sources, numbered."""
        return [f"[{k}] {text}" for k, text in enumerate(self.texts, 1)]
