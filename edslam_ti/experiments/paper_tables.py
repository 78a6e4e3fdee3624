"""The paper's tables from finished runs, with published numbers beside ours, each with what data it is of."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from edslam_ti.experiments.jobs import Outcome
from edslam_ti.experiments.paper_plan import ABLATIONS
from edslam_ti.experiments.published import (
    ABLATION_MEASURES,
    ABLATION_SCENE,
    FULL,
    IMAGE_MEASURES,
    LOWER_IS_BETTER,
    PUBLISHED,
    REPLICA,
    SLICES,
    SPEEDS,
    TABLE_1,
    TABLE_2,
    Published,
    best,
)
from edslam_ti.experiments.table_text import HIGH, LOW, Cell, Column, Footnotes, Row, Table
from edslam_ti.methods import METHODS

OUR_METHOD = "ed_slam"
IMAGES, PATHS = IMAGE_MEASURES, ("ate_rmse_cm",)
OTHER_DATA = "† on other data than ours above; do not compare the digits"
ALIGNMENTS = {FULL: "SE(3)", SLICES: "Sim(3)"}
PATHS_OF = {
    FULL: "protocol `full`: whole run, rmse after SE(3) alignment",
    SLICES: "protocol `inceventgs`: IncEventGS's slices where the recording has them, rmse after Sim(3)",
}
VIEWS_OF = {
    FULL: "protocol `full`: held-out views, pixels with true depth, all after EventNeRF's fit",
    SLICES: "protocol `inceventgs`: held-out views of its slices, every pixel, SSIM and LPIPS before the fit",
}
# A measure's name in metrics.json, by protocol.
KEYS = {
    FULL: {
        "ate_rmse_cm": "ate_rmse_cm",
        "psnr_corrected_db": "psnr_corrected_db",
        "ssim": "ssim_corrected",
        "lpips": "lpips_corrected",
    },
    SLICES: {
        "ate_rmse_cm": "ate_rmse_sim3_cm",
        "psnr_corrected_db": "psnr_corrected_db",
        "ssim": "ssim",
        "lpips": "lpips",
    },
}
TITLES = {"ate_rmse_cm": "ATE cm", "psnr_corrected_db": "PSNR dB", "ssim": "SSIM", "lpips": "LPIPS"}
DECIMALS = {"psnr_corrected_db": 2, "ssim": 3, "lpips": 3, "ate_rmse_cm": 3}
PUBLISHED_DATASETS = {REPLICA: "event_replica", "VECtor": "vector"}
WHOLE_FROM = 10.0  # cm


def measure_of(outcome: Outcome, protocol: str, measure: str) -> float | None:
    """Return a run's number under a protocol; None where it was not measured."""
    value: float | None = outcome["metrics"]["protocols"][protocol].get(KEYS[protocol][measure])
    return value


def comparison(
    name: str, outcomes: Sequence[Outcome], scenes: Sequence[str], measures: tuple[str, ...]
) -> list[Table]:
    """Return Table III or IV: a row for each method and kind of data, columns by scene; one per protocol."""
    what, how = "Absolute trajectory error (Table IV)", PATHS_OF
    if name == "table3":
        what, how = "Novel view synthesis (Table III)", VIEWS_OF
    return [
        _comparison(name, f"{what}, {how[protocol]}", protocol, outcomes, scenes, measures)
        for protocol in (FULL, SLICES)
    ]


def _comparison(
    name: str,
    title: str,
    protocol: str,
    outcomes: Sequence[Outcome],
    scenes: Sequence[str],
    measures: tuple[str, ...],
) -> Table:
    columns = tuple(
        Column(
            f"{scene} {measure}", TITLES[measure], DECIMALS[measure], _best_of(measure), scene,
            WHOLE_FROM if measure == "ate_rmse_cm" else 1e9,
        )
        for scene in scenes
        for measure in measures
    )  # fmt: skip
    labels = ("data", "method", "alignment")[: 3 if PATHS[0] in measures else 2]
    rows = []
    for data in _unique(o["data"] for o in outcomes):
        here = [o for o in outcomes if o["data"] == data]
        for method in _unique(o["job"]["method"] for o in here):
            of_method = [o for o in here if o["job"]["method"] == method]
            cells = {}
            for scene in scenes:
                runs = [o for o in of_method if o["job"]["scene"] == scene]
                for measure in measures:
                    cells[f"{scene} {measure}"] = cell_of(
                        runs,
                        partial(measure_of, protocol=protocol, measure=measure),
                        measure == "ate_rmse_cm",
                    )
            has_truth = any(o.get("poses") == "truth" for o in of_method)
            label = method + (" (true poses)" if has_truth else "")
            words = (data, label, ALIGNMENTS[protocol])[: len(labels)]
            rows.append(Row(words, cells, data, commits(of_method)))
    sources = Footnotes()
    rows += _published_rows(protocol, outcomes, scenes, measures, sources)
    table = Table(name, title, labels, columns, tuple(rows), variant=protocol).with_best()
    notes = [*_spread_note(outcomes), *where_others_win(table), *without_result(outcomes)]
    notes += [*several_programs(outcomes), *_inputs(outcomes)]
    if any("†" in label for row in rows for label in row.labels):
        notes.append(OTHER_DATA)
        notes.append("bold: the best of our runs on the same data; of published numbers, the best we know")
    return replace(table, notes=(*notes, *sources.lines()))


def _published_rows(
    protocol: str,
    outcomes: Sequence[Outcome],
    scenes: Sequence[str],
    measures: tuple[str, ...],
    sources: Footnotes,
) -> list[Row]:
    """Return the rows of the paper, then those of others; the best of each column is bold."""
    chosen = [p for p in PUBLISHED if p.protocol == protocol and p.scene in scenes and p.measure in measures]
    rows: dict[tuple[str, ...], dict[str, Cell]] = {}
    for p in chosen:
        mark = "" if _is_our_data(p, outcomes) else " †"
        words = (p.data + mark, f"{p.system} {sources.cite(p.source)}", p.alignment)
        labels = words[: 3 if PATHS[0] in measures else 2]
        tops = p == best(protocol, p.scene, p.measure)
        rows.setdefault(labels, {})[f"{p.scene} {p.measure}"] = Cell(p.value, is_best=tops)
    return [Row(labels, cells) for labels, cells in rows.items()]


def _is_our_data(p: Published, outcomes: Sequence[Outcome]) -> bool:
    """Return whether one of our runs is of the recording that a published number is of."""
    wanted = next((key for name, key in PUBLISHED_DATASETS.items() if p.data.startswith(name)), "")
    return any(
        o["job"]["dataset"] == wanted
        and o["job"]["scene"] == p.scene
        and o["job"]["duration"] is None
        # A recording in that layout that describes itself is someone's own.
        and (wanted != "event_replica" or o["metrics"]["description"].startswith("EventReplica layout"))
        for o in outcomes
        if "metrics" in o
    )


def ablation(name: str, outcomes: Sequence[Outcome]) -> Table:
    """Return Table I or II: both protocols and the paper's numbers side by side."""
    setting, values = ABLATIONS[name]
    theirs: Mapping[int, tuple[float, ...]] = TABLE_1 if name == "table1" else TABLE_2
    groups = {FULL: "full", SLICES: "inceventgs"}
    columns = [
        Column(f"{protocol} {m}", TITLES[m], DECIMALS[m], _best_of(m), group)
        for protocol, group in groups.items()
        for m in ABLATION_MEASURES
    ]
    columns += [Column("lost", "lost frames", 0), Column("hz", "tracking Hz", 0)]
    columns += [Column(f"paper {m}", TITLES[m], 2, _best_of(m), "paper †") for m in ABLATION_MEASURES]
    rows = []
    for data, scene in _unique((o["data"], o["job"]["scene"]) for o in outcomes):
        for value in values:
            runs = [
                o
                for o in outcomes
                if (o["data"], o["job"]["scene"]) == (data, scene) and o["tracking"][setting] == value
            ]
            cells = {
                f"{protocol} {m}": cell_of(runs, partial(measure_of, protocol=protocol, measure=m))
                for protocol in groups
                for m in ABLATION_MEASURES
            }
            cells["lost"] = cell_of(runs, lambda o: o["metrics"]["num_lost_frames"])
            cells["hz"] = cell_of(runs, lambda o: o["metrics"]["tracking_hz"])
            if scene == ABLATION_SCENE:
                cells |= {f"paper {m}": Cell(x) for m, x in zip(ABLATION_MEASURES, theirs[value])}
            label = f"{value} x {value}" if setting == "patch_size" else str(value)
            rows.append(Row((data, scene, label), cells, f"{data} {scene}", commits(runs)))
    what, number = ("Patch size", "I") if setting == "patch_size" else ("Number of patches", "II")
    notes = (
        *(f"{PATHS_OF[p]}; {VIEWS_OF[p].partition(': ')[2]}" for p in groups),
        *_spread_note(outcomes),
        *without_result(outcomes),
        *several_programs(outcomes),
        f"paper: Table {number} of the ED-SLAM paper, EventReplica office0. {OTHER_DATA}",
    )
    return Table(
        name, f"{what} of `ed_slam_paper` (Table {number})",
        ("data", "scene", what.lower()), tuple(columns), tuple(rows), notes,
    ).with_best()  # fmt: skip


RUNTIME: tuple[tuple[Column, Callable[[Outcome], float | None]], ...] = (
    (Column("frames", "frames", 0), lambda o: o["metrics"]["num_frames"]),
    (Column("tracking_hz", "tracking Hz", 1, HIGH), lambda o: o["metrics"]["tracking_hz"]),
    (Column("mapping_hz", "mapping Hz", 1, HIGH), lambda o: _per_second(o, "mapping_s")),
    (Column("refinement_s", "refinement s", 1), lambda o: o["metrics"]["refinement_s"]),
    (Column("wall_s", "total s", 1, LOW), lambda o: o["metrics"].get("wall_s")),
    (Column("fps", "frames / total s", 2, HIGH), lambda o: o["metrics"].get("total_fps")),
    (Column("memory", "peak memory MB", 0, LOW), lambda o: o["metrics"].get("peak_memory_mb")),
    (Column("gaussians", "Gaussians, 1000", 1), lambda o: o["metrics"]["num_gaussians"] / 1000),
    (Column("map_mb", "map MB", 1, LOW), lambda o: o["map_mb"]),
)  # fmt: skip


def runtime(outcomes: Sequence[Outcome]) -> Table:
    """Return the table that the paper lacks: speed, memory and size of the map, mean over all runs."""
    rows = []
    for data in _unique(o["data"] for o in outcomes):
        here = [o for o in outcomes if o["data"] == data]
        for method in _unique(o["job"]["method"] for o in here):
            runs = [o for o in here if o["job"]["method"] == method]
            good = [o for o in runs if "metrics" in o]
            device = ", ".join(_unique(f"{o['metrics']['device']}; {o['processor']}" for o in good))
            scenes = ", ".join(_unique(o["job"]["scene"] for o in runs))
            at_once = max((o.get("at_once", 1) for o in good), default=1)
            beside = f"; {at_once} runs at once" if at_once > 1 else ""
            cells = {column.key: cell_of(runs, value) for column, value in RUNTIME}
            labels = (f"{data}: {scenes}", method, device + beside)
            rows.append(Row(labels, cells, data, commits(runs)))
    sources = Footnotes()
    for speed in SPEEDS:
        cells = {
            "tracking_hz": Cell(speed.tracking_hz),
            "mapping_hz": Cell(speed.mapping_hz),
            "fps": Cell(speed.total_fps),
            "map_mb": Cell(speed.map_mb),
        }
        system = f"{speed.system} {sources.cite(speed.source)}"
        rows.append(Row(("published †", system, speed.device), cells))
    notes = (
        "mean ± standard deviation over scenes and seeds. Total: from opening the recording to the last "
        "file, with evaluation and pictures. Map: map.ply, or points.ply where the map is a volume",
        "tracking and mapping run in turn; every run is a process of its own",
        *without_result(outcomes),
        *several_programs(outcomes),
        "† on other data and other machines",
        *sources.lines(),
    )
    columns = tuple(column for column, _ in RUNTIME)
    title = "Speed, memory and size of the map"
    return Table("runtime", title, ("data", "method", "device"), columns, tuple(rows), notes).with_best()


def _per_second(outcome: Outcome, key: str) -> float | None:
    seconds = outcome["metrics"][key]
    return outcome["metrics"]["num_frames"] / seconds if seconds else None


# --- cells ---


def cell_of(
    runs: Sequence[Outcome], value: Callable[[Outcome], float | None], is_of_path: bool = False
) -> Cell:
    """Return mean and standard deviation over runs, and in words how many failed or lost frames."""
    if not runs:
        return Cell()
    good = [o for o in runs if "metrics" in o]
    if not good:
        return Cell(words="failed" if any("error" in o for o in runs) else "skipped")
    if is_of_path and all(o.get("poses") == "truth" for o in good):
        return Cell(words="true poses")
    values = [x for x in map(value, good) if x is not None]
    if not values:
        return Cell()
    words = []
    lost = sum(o["metrics"]["num_lost_frames"] for o in good)
    if is_of_path and lost:
        words.append(f"{lost} lost")
    if len(good) < len(runs):
        words.append(f"{len(runs) - len(good)} of {len(runs)} without result")
    spread = statistics.stdev(values) if len(values) > 1 else None
    return Cell(statistics.fmean(values), spread, ", ".join(words))


def commits(runs: Sequence[Outcome]) -> str:
    """Return the commits of the program that runs were made with."""
    return ", ".join(_unique(o["commit"] for o in runs))


def where_others_win(table: Table) -> list[str]:
    """Return, for every kind of data, the columns in which another method is ahead of `ed_slam`."""
    lines = []
    for group in _unique(row.group for row in table.rows if row.group):
        rows = [row for row in table.rows if row.group == group]
        ours = next((row for row in rows if row.labels[1] == OUR_METHOD), None)
        if ours is None or len(rows) < 2:
            continue
        ahead = []
        for column in table.columns:
            mine = ours.cells[column.key]
            others = [row for row in rows if row is not ours and row.cells[column.key].value is not None]
            name, shown = f"{column.group} {column.title}", partial(Cell.text, column=column)
            if mine.value is None:  # it failed, or cannot work on this data
                if mine.words and others:
                    ahead.append(
                        f"{', '.join(row.labels[1] for row in others)} in {name} (ed_slam: {mine.words})"
                    )
                continue
            for row in others:
                other = row.cells[column.key]
                if other.is_best and not mine.is_best:
                    ahead.append(f"{row.labels[1]} in {name} ({shown(other)} against {shown(mine)})")
        text = "; ".join(ahead) if ahead else "no other method is best in any column"
        lines.append(f"{group}: ahead of {OUR_METHOD}: {text}")
    return lines


def without_result(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line for each reason that runs have no result."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for o in outcomes:
        for problem in ("error", "skipped"):
            if problem in o:
                name = f"{o['job']['scene']} seed {o['job']['seed']}"
                reasons.setdefault((o["job"]["method"], f"{problem}: {o[problem]}"), []).append(name)
    return [
        f"without a result: {method}, {', '.join(_unique(names))}: {reason}"
        for (method, reason), names in reasons.items()
    ]


def several_programs(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line where the runs were not all made by one version of the program."""
    commits = [o["commit"] for o in outcomes if "commit" in o]
    if len(set(commits)) < 2:
        return []
    counts = ", ".join(f"{commit} ({commits.count(commit)})" for commit in _unique(commits))
    return [f"runs by versions of the program: {counts}"]


def _inputs(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what each method is, in its own words: some are given images that others never see."""
    methods = _unique(o["job"]["method"] for o in outcomes)
    return [f"{name}: {METHODS[name].description}" for name in methods if name in METHODS]


def _spread_note(outcomes: Sequence[Outcome]) -> list[str]:
    seeds = sorted({o["job"]["seed"] for o in outcomes})
    if len(seeds) > 1:
        return [f"mean ± standard deviation over seeds {', '.join(map(str, seeds))}"]
    return [f"one seed ({seeds[0]})"] if seeds else []


def _best_of(measure: str) -> int:
    return LOW if measure in LOWER_IS_BETTER else HIGH


def _unique(values: Any) -> list[Any]:
    return list(dict.fromkeys(values))


def tables_of(name: str, outcomes: Sequence[Outcome], scenes: Sequence[str]) -> list[Table]:
    """Return the tables that a command of that name makes of its outcomes."""
    if name in ABLATIONS:
        return [ablation(name, outcomes)]
    if name == "runtime":
        return [runtime(outcomes)]
    return comparison(name, outcomes, scenes, IMAGES if name == "table3" else PATHS)
