"""What the documents say is true: names run, links lead somewhere, commands parse, tables are current."""

import ast
import functools
import io
import json
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from rich.console import Console
from sequences import make_slam, settings, tracked

from edslam_ti.commands import COMMANDS
from edslam_ti.config import Config, MappingConfig
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence, open_sequence
from edslam_ti.errors import DataError
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.experiments.documents import (
    cell,
    documents_in,
    read_table,
    report_tables,
    table_names,
    write_tables,
)
from edslam_ti.frame import FrameBuilder
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.methods import METHODS
from edslam_ti.pipeline import run
from edslam_ti.slam import Slam

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs/datasets").glob("*.md")]),
]
SOURCES = {
    str(path.relative_to(ROOT)): path
    for folder in ("kernels", "edslam_ti", "apps")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
README_LINES = 120
COMPILING = "compile_kernels"  # the functions that compile kernels before they are needed


# --- equations ---


def equations() -> list[tuple[str, str, str, str]]:
    """Return equation, file, name and method of every row of the table."""
    rows = re.findall(
        r"^\| (\d[^|]*) \|[^|]*\| `(\S+\.py): ([\w.]+)` \| `?(\w+)`? \|$",
        (ROOT / "docs/equations.md").read_text(),
        re.MULTILINE,
    )
    return [(equation.strip(), file, name, method) for equation, file, name, method in rows]


@functools.cache
def definitions(file: str) -> dict[str, ast.AST]:
    """Return the functions of a file by name, methods as `Class.name`."""
    found: dict[str, ast.AST] = {}
    for node in ast.parse(SOURCES[file].read_text()).body:
        if isinstance(node, ast.ClassDef):
            found |= {
                f"{node.name}.{part.name}": part for part in node.body if isinstance(part, ast.FunctionDef)
            }
        elif isinstance(node, ast.FunctionDef):
            found[node.name] = node
    return found


def is_taichi(node: ast.AST) -> bool:
    """Return whether a function is compiled by Taichi, so that Python never enters it."""
    decorators = getattr(node, "decorator_list", [])
    return any(ast.unparse(d) in ("ti.func", "ti.kernel") for d in decorators)


def callers(file: str, name: str) -> Iterator[tuple[str, str]]:
    """Yield the functions that name a Taichi function: in its file, or where it is imported."""
    module = file.removesuffix(".py").replace("/", ".").replace("kernels.", "edslam_ti.kernels.", 1)
    for other, path in SOURCES.items():
        text = path.read_text()
        if name not in text:
            continue
        imported = [
            alias.asname or alias.name
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.ImportFrom) and node.module == module
            for alias in node.names
            if alias.name == name
        ]
        for local in [name] if other == file else imported:
            for caller, node in definitions(other).items():
                names = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
                if local in names and (other, caller) != (file, name) and caller != COMPILING:
                    yield other, caller


def is_reached(file: str, name: str, seen: set[tuple[str, str]]) -> bool:
    """Return whether a function ran: Python entered it, or what launches it."""
    if not is_taichi(definitions(file)[name]):
        return (file, name) in seen
    return any(is_reached(*caller, seen) for caller in callers(file, name))


def functions_entered(action: Callable[[], object]) -> set[tuple[str, str]]:
    """Return the file (from the repository's root) and the qualified name of every function that ran."""
    codes = set()
    compiling: list[FrameType] = []  # what a kernel is compiled with is not a use of it

    def note(frame: FrameType, event: str, _argument: Any) -> None:
        if event == "call":
            if frame.f_code.co_name == COMPILING:
                compiling.append(frame)
            elif not compiling:
                codes.add(frame.f_code)
        elif event == "return" and compiling and frame is compiling[-1]:
            compiling.pop()

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        action()
    finally:
        sys.setprofile(before)
    places = {path.resolve(): name for name, path in SOURCES.items()}
    entered = ((Path(code.co_filename).resolve(), code.co_qualname) for code in codes)
    return {(places[path], name) for path, name in entered if path in places}


@pytest.fixture(scope="module")
def entered(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> dict[str, set[tuple[str, str]]]:
    """What each method enters on the tiny room, from the first frame to the refined map."""

    def run(method: str) -> None:
        config = settings(method, mapping={"iterations": 1, "final_iterations": 4})
        slam = make_slam(tiny_sequence, tiny_samples, config)
        for sample in tiny_samples[:10]:
            slam.process(sample)
        assert slam.mapper is not None
        slam.mapper.finish(slam.trajectory, lambda share: True)

    return {m: functions_entered(functools.partial(run, m)) for m in ("ed_slam", "ed_slam_paper")}


@pytest.mark.slow
def test_every_equation_names_a_function_that_runs(entered: dict[str, set[tuple[str, str]]]) -> None:
    problems = []
    for equation, file, name, method in equations():
        if file not in SOURCES or name not in definitions(file):
            elsewhere = [other for other in SOURCES if name in definitions(other)]
            problems.append(
                f"Eq. {equation}: no {name} in {file}; it is in {', '.join(elsewhere) or 'no file'}"
            )
            continue
        for runs in entered if method == "both" else [method]:
            if not is_reached(file, name, entered[runs]):
                problems.append(f"Eq. {equation}: {runs} does not reach {file}: {name}")
    assert problems == []


def test_all_equations_are_in_the_table() -> None:
    numbers = {int(n) for equation, *_ in equations() for n in re.findall(r"\d+", equation)}
    assert numbers == set(range(1, 17))


def test_a_function_that_does_not_run_is_noticed(entered: dict[str, set[tuple[str, str]]]) -> None:
    seen = entered["ed_slam"]
    assert not is_reached("kernels/reference.py", "rasterize", seen)  # the twins are for tests
    assert not is_reached("kernels/texture.py", "_shade", seen)  # a kernel of the simulator, never launched
    assert is_reached("kernels/view_losses.py", "composite", seen)  # a Taichi function inside a kernel
    assert not is_reached(
        "edslam_ti/event_images/solve.py", "solve_log_brightness_image", entered["ed_slam_paper"]
    )


# --- links and names ---


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (document.parent / path).resolve() if path else document
        assert linked.exists(), f"{document.name}: no {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", linked.read_text(), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings]
            assert anchor in anchors, f"{document.name}: no heading for {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_files_that_are_named_exist(document: Path) -> None:
    for name in re.findall(r"`((?:[\w.\-]+/)*[\w\-]+\.py)(?::[^`]*)?`", without_code(document.read_text())):
        assert (ROOT / name).is_file(), f"{document.name} names {name}"
    for folder in re.findall(
        r"`((?:kernels|edslam_ti|apps|docs|tests|configs|examples)/(?:\w+/)*)`", document.read_text()
    ):
        assert (ROOT / folder).is_dir(), f"{document.name} names {folder}"


def test_every_format_is_described() -> None:
    from edslam_ti.datasets import FORMATS

    described = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/data.md").read_text(), re.MULTILINE)
    assert FORMATS.keys() <= set(described)


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= README_LINES


def without_code(text: str) -> str:
    """Return a document without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


# --- commands ---


def commands(document: Path) -> list[list[str]]:
    """Return the words of every `edslam NAME` and `python apps/NAME.py` in a document, the name first."""
    text = document.read_text()
    blocks = re.findall(r"^```bash\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    lines += re.findall(r"`((?:edslam|python apps/)[^`\n]*)`", without_code(text))
    parts = [part.strip() for line in lines for part in line.split("#")[0].split("&&")]
    found = [re.match(r"(?:edslam (?=[a-z])|python apps/)([a-z]+)(?:\.py)?(.*)", part) for part in parts]
    return [[m[1], *shlex.split(m[2])] for m in found if m]


@functools.cache
def options(command: str) -> str:
    """Return the help of a command, or of a subcommand of `reproduce`."""
    name, *subcommand = command.split()
    output = io.StringIO()
    with redirect_stdout(output), pytest.raises(SystemExit):
        import_module(f"edslam_ti.commands.{name}").main([*subcommand, "--help"])
    return output.getvalue()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_parse(document: Path) -> None:
    for name, *words in commands(document):
        assert name in COMMANDS, f"{document.name}: no command {name}"
        command = f"{name} {words[0]}" if name == "reproduce" and words else name
        for word in words:
            if word.startswith("--") and word != "--help":
                assert re.search(rf"(?<![\w-]){re.escape(word)}\b", options(command)), (
                    f"{name}: no option {word}"
                )


# --- recipes ---

RECIPES = ROOT / "docs/extending.md"


@contextmanager
def restored(registry: dict[str, Any]) -> Iterator[None]:
    """Take out again what a recipe adds to a dictionary."""
    before = dict(registry)
    try:
        yield
    finally:
        registry.clear()
        registry.update(before)


def recipe(title: str) -> dict[str, Any]:
    """Run the Python blocks of a section of docs/extending.md; return the names they define."""
    section = RECIPES.read_text().split(f"\n## {title}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"^```python\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    assert blocks, title
    names: dict[str, Any] = {"__name__": f"recipe for {title}"}
    for block in blocks:
        exec(compile(block, f"{RECIPES.name}: {title}", "exec"), names)
    return names


def test_recipe_for_a_data_set(
    tmp_path: Path, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    from edslam_ti.datasets import FORMATS

    with restored(FORMATS):
        recipe("A data set")
        first, last = tiny_samples[0].timestamp - 0.1, tiny_samples[-1].timestamp
        events, camera = tiny_sequence.events(first, last), tiny_sequence.camera
        (tmp_path / "mine").mkdir()
        np.savez(
            tmp_path / "mine/recording.npz",
            size=(camera.width, camera.height),
            intrinsics=camera.intrinsics,
            depth_times=[sample.timestamp for sample in tiny_samples],
            depth=np.array([sample.depth for sample in tiny_samples]),
            x=events.x,
            y=events.y,
            t=events.t,
            p=events.polarity,
        )
        sequence = open_sequence(Config(scene="mine", data_dir=tmp_path))  # recognised
        assert (sequence.dataset, sequence.scene) == ("npz", "mine")
        samples = list(SampledSequence(sequence, 0.0, None, 0.1))
        np.testing.assert_array_equal(samples[3].depth, tiny_samples[3].depth)
        start = tiny_samples[0].T_world_camera
        assert start is not None
        config = settings(mapping={"enabled": False})
        tracker, _ = METHODS["ed_slam"].build(sequence, ContrastThreshold(0.1, "data"), config)
        slam = Slam(FrameBuilder(sequence.camera), tracker, None, start)
        assert all(slam.process(sample).converged for sample in samples[:6])


def test_recipe_for_a_tracker(tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]) -> None:
    with restored(METHODS):
        recipe("A tracker")
        slam = tracked(tiny_sequence, tiny_samples[:4], settings("constant_velocity"))
        np.testing.assert_array_equal(slam.trajectory.pose(3), tiny_samples[0].T_world_camera)


def test_recipe_for_a_mapper(
    tmp_path: Path, tiny_sequence: EventDepthSequence, tiny_samples: list[Sample]
) -> None:
    with restored(METHODS):
        names = recipe("A mapper")
        members = {name for name in vars(Mapper) if not name.startswith("_")}
        assert members <= set(dir(names["PointMapper"]())), "the recipe lacks a part of the protocol"
        slam = make_slam(tiny_sequence, tiny_samples, settings("points", poses="truth"))
        for k, sample in enumerate(tiny_samples[:4]):
            slam.process(sample, is_held_out=k == 2)
        mapper = slam.mapper
        assert mapper is not None
        mapper.finish(slam.trajectory, lambda share: True)
        assert len(mapper.points()[0]) == 3 * (80 // 8) * (120 // 8)  # every eighth pixel of three images
        pose, depth = tiny_samples[2].T_world_camera, tiny_samples[2].depth
        assert pose is not None
        assert depth is not None
        view = mapper.render(tiny_sequence.camera, pose)
        error = np.abs(view.depth - depth)[view.alpha > 0]
        assert np.median(error) < 0.02  # metres; a point falls half a pixel beside a centre
        names["PointMapper"]().save(tmp_path)
        assert (tmp_path / "points.npy").is_file()


def test_recipe_for_a_loss() -> None:
    loss = recipe("A loss")["opacity_loss"]
    gaussians = GaussianMap(MappingConfig())
    gaussians.add(torch.rand(5, 3), torch.rand(5, 4), 0.01 * torch.ones(5, 3), 0.7, 0.5 * torch.ones(5, 1))
    values = []
    for _ in range(20):
        value = loss(gaussians.raw["logit_opacities"])
        value.backward()
        gaussians.step()
        values.append(float(value))
    assert values[0] == pytest.approx(0.7 * 0.3)
    assert values[-1] < 0.8 * values[0]
    losses = (ROOT / "edslam_ti/mapping/losses.py").read_text()
    line = r"total = total \+ config\.scale_weight \* scale_loss\("  # after which the recipe adds its own
    assert re.search(line, losses.split("def map_loss(")[1].split("\ndef ")[0])


@pytest.mark.slow
def test_recipe_for_a_viewer(tmp_path: Path, tiny_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:

    from edslam_ti.viewer import VIEWERS

    with restored(VIEWERS):
        recipe("A viewer")
        config = settings(
            scene=tiny_folder.name,
            dataset="event_replica",
            data_dir=tiny_folder.parent,
            duration=0.2,
            visualize=True,
            out=tmp_path,
            mapping={"enabled": False},
        )
        run(config, Console(quiet=True))
        printed = capsys.readouterr().out
        assert "frame 2: camera at [" in printed
        assert printed.rstrip().endswith("the run is saved")


@pytest.mark.slow
def test_recipe_for_a_live_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from edslam_ti.live import loop
    from edslam_ti.viewer import NoViewer

    monkeypatch.setattr(loop, "warm_up", lambda config: None)
    source = recipe("A live source")["Noise"](0.4)
    config = settings(out=str(tmp_path), mapping={"enabled": False})
    folder = loop.run_live(source, config, loop.LiveSettings(), Console(quiet=True), NoViewer())
    assert json.loads((folder / "metrics.json").read_text())["num_frames"] >= 6


@pytest.mark.slow
def test_programs_in_live_md_run(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs/live.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "live.md", "exec"), {"__name__": "a program in live.md"})
    assert capsys.readouterr().out.strip() == "5 ()"


# --- tables ---


def test_tables_agree_with_the_stored_numbers() -> None:
    report_tables(ROOT, check=True)


def test_every_stored_table_is_shown_and_every_column_filled() -> None:
    shown = {name for document in documents_in(ROOT) for name in table_names(document)}
    stored = {path.stem for path in (ROOT / "docs/results").glob("*.json")}
    assert shown == stored
    for name in stored:
        table = read_table(ROOT, name)
        for column in table["columns"]:
            assert any(row["values"][column["key"]] is not None for row in table["rows"]), (name, column)


def test_cells_show_values_as_their_columns_say() -> None:
    column = {"decimals": 2, "whole_from_10": True}
    for value, expected in (
        (None, "-"),
        ("text", "text"),
        (0.4, "0.40"),
        (154, "154"),
        ([0.40, 0.42, 1.34, 0.61, 0.57], "0.57 (0.40 to 1.34)"),
        ({"mean": 2.6, "worst": 7.13}, "2.60 / 7.13"),
        ({"mean": 14, "worst": 124, "lost": True}, "14 / 124, lost frames"),
        ({"mean": 0.6, "worst": 0.6, "lost": 3}, "0.60, 3 lost"),
        ({"mean": 0.8, "worst": 1.2, "lost": 3}, "0.80 / 1.20, 3 lost"),
    ):
        assert cell(value, column) == expected
    assert cell(7930.0, {"significant": 3}) == "7930"
    assert cell(0.00468, {"significant": 2}) == "0.0047"


def test_a_new_number_appears_in_the_document(tmp_path: Path) -> None:
    (tmp_path / "docs/results").mkdir(parents=True)
    readme, numbers = tmp_path / "README.md", tmp_path / "docs/results/speed.json"
    readme.write_text("before\n<!-- speed -->\nold\n<!-- end speed -->\nafter\n")
    row = {"command": "c", "commit": "abc", "version": "1", "source": "s", "values": {"hz": 3}}
    table = {"columns": [{"key": "hz", "title": "Hz", "decimals": 0}], "rows": [row]}
    numbers.write_text(json.dumps(table))
    with pytest.raises(DataError, match=r"README.md; run the command without --check"):
        report_tables(tmp_path, check=True)
    assert write_tables(tmp_path) == [readme]
    assert readme.read_text() == ("before\n<!-- speed -->\n| Hz |\n|--:|\n| 3 |\n<!-- end speed -->\nafter\n")
    report_tables(tmp_path, check=True)
    del row["commit"]
    numbers.write_text(json.dumps(table))
    with pytest.raises(DataError, match=r"speed.json: row 1 does not state its commit"):
        write_tables(tmp_path)
    row |= {"commit": "abc", "values": {"hz": 3, "fps": 4}}
    numbers.write_text(json.dumps(table))
    with pytest.raises(DataError, match=r"row 1: .*fps"):
        write_tables(tmp_path)


# --- files for other tools ---


def test_citation_and_workflows_are_well_formed() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert [a["family-names"] for a in citation["preferred-citation"]["authors"]] == [
        *("Huang", "Shen", "Lou", "Liu")
    ]
    assert citation["license"] == "Apache-2.0"
    ci = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    assert ci["jobs"]["ci"]["strategy"]["matrix"]["python"] == ["3.11", "3.13"]
    assert any(step.get("run") == ".ci/run" for step in ci["jobs"]["ci"]["steps"])
    for path in (ROOT / ".github").rglob("*.yml"):
        assert yaml.safe_load(path.read_text()), path
