"""The paper's tables: which runs they need, how runs are kept, and what the tables and the page say."""

import contextlib
import functools
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from apps import reproduce
from edslam_ti.arguments import UsageError
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.experiments import long_runs, paper, scheduler
from edslam_ti.experiments.documents import cell, report_tables
from edslam_ti.experiments.jobs import RECORDED, Job, Outcome, about, execute, job_of, kept, outcome_of, start
from edslam_ti.experiments.paper_options import LongOptions, PaperOptions
from edslam_ti.experiments.paper_plan import TABLES, Wanted, plan
from edslam_ti.experiments.paper_tables import several_programs, tables_of
from edslam_ti.experiments.paper_views import ShownRun
from edslam_ti.experiments.published import FULL, PAPER_SCENES, PUBLISHED, SLICES, best
from edslam_ti.experiments.scheduler import Work, in_processes, on_ray, resources, run_jobs
from edslam_ti.experiments.table_text import HIGH, LOW, Cell, Column, Row, Table, as_latex, as_markdown
from edslam_ti.methods import METHODS

QUIET = Console(quiet=True)
# A run of the tiny recording that takes about a second.
QUICK = json.dumps(
    {
        "mapping": {"iterations": 1, "final_iterations": 2},
        "evaluation": {"flythrough_frames": 1, "max_images": 3},
    }
)
COSTS = (
    *("tracking_hz", "tracking_s", "mapping_s", "refinement_s", "seconds_per_frame", "wall_s", "total_fps"),
    "peak_memory_mb",
)


# --- plans ---


def test_every_table_has_its_runs_and_tables_share_them() -> None:
    jobs = plan(Wanted(), TABLES)
    assert [len(jobs[t]) for t in ("table1", "table2")] == [5, 4]
    assert len(set(jobs["table1"]) & set(jobs["table2"])) == 1  # 9 x 9 and 400 patches are the defaults
    rooms = PAPER_SCENES[:5]
    assert {job.scene for job in jobs["table4"]} == set(rooms)
    assert len(jobs["table4"]) == len(rooms) * len(METHODS)  # a method that is added later runs, too
    assert jobs["table3"] == jobs["table4"] == jobs["runtime"]
    every = {job.name: job for table in TABLES for job in jobs[table]}
    assert len(every) == len({job for table in TABLES for job in jobs[table]})  # no two share a folder
    sizes = {job.settings(Path()).tracking.patch_size for job in jobs["table1"]}
    assert sizes == {5, 7, 9, 11, 13}


def test_recordings_run_as_they_are_beside_the_rooms(tiny_folder: Path) -> None:
    wanted = Wanted(
        ("office0", "tiny"), ("ed_slam",), (0, 1), ("exact", "kinect"), (20.0, 5.0),
        data_dir=tiny_folder.parent,
    )  # fmt: skip
    jobs = plan(wanted, ("table4",))["table4"]
    assert len(jobs) == 2 * 2 * 2 + 2  # seeds, depth and rates of the room; seeds of the recording
    recorded = [job for job in jobs if job.dataset == "event_replica"]
    assert {(job.scene, job.depth) for job in recorded} == {("tiny", RECORDED)}
    only = plan(replace(wanted, scenes=("tiny",), datasets=("event_replica",)), ("table4",))["table4"]
    assert only == recorded


def test_what_is_asked_for_must_exist(tmp_path: Path) -> None:
    for wanted, message in (
        (Wanted(scenes=("nowhere",)), "scenes: expected all, built-in rooms .* found no 'nowhere'"),
        (Wanted(methods=("orb",)), "methods: expected some of ed_slam, .* got 'orb'"),
        (Wanted(depth=("lidar",)), "depth: expected some of exact, kinect, got 'lidar'"),
        (Wanted(datasets=("kitti",)), "datasets: expected some of .* got 'kitti'"),
        (Wanted(rates=(40.0,)), "rates: expected above 0 and up to 20 Hz, got 40"),
        (Wanted(seeds=()), "seeds: expected at least one"),
    ):
        with pytest.raises(ConfigError, match=message):
            plan(wanted, TABLES)
    with pytest.raises(ConfigError, match="no recording passes the filters"):
        paper.reproduce_paper(("table4",), PaperOptions(datasets=("rpg",), data_dir=tmp_path), QUIET)
    with pytest.raises(UsageError, match="unknown option '--scene'"):
        reproduce.main(["table4", "--scene", "office0"])


# --- runs ---


def fake(todo: Sequence[Work], report: Callable[[str], None]) -> Iterator[tuple[Job, Outcome]]:
    """Finish every job at once, but fail for open3d_icp."""
    for job, folder in todo:
        folder.mkdir(parents=True, exist_ok=True)
        result = (
            {"error": "it broke"} if job.method == "open3d_icp" else {"metrics": metrics(0.1), "seconds": 1}
        )
        outcome = {**about(job), **result}
        (folder / "result.json").write_text(json.dumps(outcome))
        report(job.method)
        yield job, outcome


def test_finished_runs_are_not_repeated_and_failed_ones_are(tmp_path: Path) -> None:
    jobs = plan(Wanted(("office0",), ("ed_slam", "open3d_icp")), ("table4",))["table4"]
    asked: list[list[str]] = []

    def counting(todo: Sequence[Work], report: Callable[[str], None]) -> Iterator[tuple[Job, Outcome]]:
        asked.append([job.method for job, _ in todo])
        return fake(todo, report)

    for _ in range(2):
        outcomes = list(run_jobs([*jobs, *jobs], tmp_path, counting, QUIET))
        assert {o["job"]["method"] for o in outcomes} == {"ed_slam", "open3d_icp"}
    list(run_jobs(jobs, tmp_path, counting, QUIET, fresh=True))
    assert asked == [["ed_slam", "open3d_icp"], ["open3d_icp"], ["ed_slam", "open3d_icp"]]
    # What a killed run left is not a result.
    folder = tmp_path / "runs" / jobs[0].name
    for left in ("", '{"job": {}, "met'):
        (folder / "result.json").write_text(left)
        assert kept(folder) is None


def test_finished_runs_of_another_program_are_counted_and_named(tmp_path: Path) -> None:
    jobs = plan(Wanted(("office0", "room0"), ("ed_slam",)), ("table4",))["table4"]
    list(run_jobs(jobs, tmp_path, fake, QUIET))
    console = Console(file=io.StringIO(), width=200)
    list(run_jobs(jobs, tmp_path, fake, console))
    assert console.file.getvalue() == ""  # type: ignore[attr-defined]
    file = tmp_path / "runs" / jobs[0].name / "result.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"commit": "0ther00"}))
    outcomes = list(run_jobs(jobs, tmp_path, fake, console))
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert said.startswith("1 of 2 finished runs are of another version of the program; --fresh")
    now = about(jobs[1])["commit"]
    assert several_programs(outcomes) == [f"runs by versions of the program: 0ther00 (1), {now} (1)"]
    assert several_programs(outcomes[1:]) == []


def tiny_job(folder: Path, method: str = "ed_slam", **differences: Any) -> Job:
    return Job(
        "event_replica", folder.name, method, depth=RECORDED, rate=0.0, duration=0.3, differences=QUICK,
        data_dir=str(folder.parent), **differences,
    )  # fmt: skip


def comparable(outcome: Outcome) -> dict[str, Any]:
    """Return a run's numbers but for its costs and its mesh, which Open3D fuses in any order."""
    values = outcome["metrics"]
    return {k: v for k, v in values.items() if k not in COSTS and not k.startswith("mesh")}


@pytest.fixture(scope="module")
def one_by_one(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, Path, Outcome]:
    """Run the quick job in a process of its own."""
    job, folder = tiny_job(tiny_folder), tmp_path_factory.mktemp("alone")
    [outcome] = run_jobs([job], folder, in_processes(1), QUIET)
    return job, folder / "runs" / job.name, outcome


@pytest.mark.slow
def test_runs_side_by_side_give_the_numbers_of_one(
    one_by_one: tuple[Job, Path, Outcome], tmp_path: Path
) -> None:
    job, folder, alone = one_by_one
    assert "metrics" in alone, alone
    assert alone["metrics"]["num_frames"] == 6
    assert {"result.json", "trajectory_tum.txt", "truth_tum.txt", "output.txt"} <= {
        path.name for path in folder.iterdir()
    }
    assert not (folder / "work").exists()  # maps are measured, not kept
    assert alone["map_mb"] > 0
    assert len(list((folder / "renders").glob("*.png"))) == 1  # one view was held out
    other = replace(job, method="no_such_method")
    with pytest.raises(KeyError):  # a job that cannot be is found before it starts
        about(other)
    unable = replace(job, scene="absent")
    outcomes = {o["name"]: o for o in run_jobs([job, unable], tmp_path, in_processes(2), QUIET)}
    beside = outcomes[job.name]
    assert comparable(beside) == comparable(alone)
    assert (alone["at_once"], beside["at_once"]) == (1, 2)
    paths = [f / "trajectory_tum.txt" for f in (folder, tmp_path / "runs" / job.name)]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert "absent" in outcomes[unable.name]["error"]


@pytest.mark.slow
def test_ray_gives_the_numbers_of_one(one_by_one: tuple[Job, Path, Outcome], tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (extra ray)")
    job, folder, alone = one_by_one
    unable = replace(job, scene="absent")
    outcomes = {o["name"]: o for o in run_jobs([job, unable], tmp_path, on_ray("local"), QUIET)}
    assert comparable(outcomes[job.name]) == comparable(alone)
    gathered = tmp_path / "runs" / job.name
    assert (gathered / "trajectory_tum.txt").read_bytes() == (folder / "trajectory_tum.txt").read_bytes()
    assert {p.name for p in gathered.rglob("*")} == {p.name for p in folder.rglob("*")}
    assert "absent" in outcomes[unable.name]["error"]


def test_a_task_states_what_it_takes_and_one_that_fits_nowhere_is_refused() -> None:
    job = Job("builtin", "office0", "ed_slam", threads=8, device="cuda")
    assert resources(job)["num_cpus"] == 8
    assert resources(job)["num_gpus"] == 1
    nodes = [{"Alive": True, "Resources": {"CPU": 16.0, "memory": 1e12}}]
    with pytest.raises(ConfigError, match=r"no worker can run ed_slam: .*GPU 1 \(at most 0 there\)"):
        scheduler._check_resources(nodes, [job])
    scheduler._check_resources(nodes, [replace(job, device="cpu")])


def test_a_cluster_that_is_not_there_is_missed_at_once(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (extra ray)")
    job = Job("builtin", "office0", "ed_slam")
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1"):
        with pytest.raises(ConfigError, match=f"--ray {address}: nothing answers there"):
            list(run_jobs([job], tmp_path, on_ray(address), QUIET))


@pytest.mark.slow
def test_a_run_ends_with_the_process_that_started_it(tiny_folder: Path, tmp_path: Path) -> None:
    job = tiny_job(tiny_folder)
    starter = (
        "import sys, json, time\nfrom pathlib import Path\n"
        "from edslam_ti.experiments.jobs import Job, start\n"
        "p = start(Job(**json.loads(sys.argv[1])), Path(sys.argv[2]), 1)\nprint(p.pid, flush=True)\n"
        "time.sleep(60)"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", starter, json.dumps(asdict(job)), str(tmp_path / "run")],
        stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    for _ in range(300):
        if not is_alive(pid):
            break
        time.sleep(0.1)
    assert not is_alive(pid)
    assert kept(tmp_path / "run") is None  # it starts again next time


def is_alive(pid: int) -> bool:
    """Return whether a process runs; one that has ended and that nobody has waited for does not."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    return False


def test_a_process_that_dies_is_a_failure_with_its_last_words(tmp_path: Path) -> None:
    job = Job("builtin", "office0", "ed_slam")
    (tmp_path / "output.txt").write_text("one\nterminate called after throwing\n")
    assert outcome_of(job, tmp_path, -9)["error"] == (
        "the process ended with signal 9 (out of memory?); terminate called after throwing"
    )
    process = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])
    assert outcome_of(job, tmp_path / "none", process.wait())["error"] == "the process ended with exit code 3"


def test_a_failure_in_this_process_becomes_a_row(tiny_folder: Path, tmp_path: Path) -> None:
    job = replace(tiny_job(tiny_folder), scene="absent")
    outcome = execute(job, tmp_path / "run")
    assert "scene 'absent' not found" in outcome["error"]
    assert json.loads((tmp_path / "run/result.json").read_text()) == outcome


# --- tables ---


def metrics(ate: float | None, psnr: float | None = 20.0, lost: int = 0) -> dict[str, Any]:
    return {
        "ate_rmse_cm": ate,
        "num_frames": 10,
        "num_lost_frames": lost,
        "tracking_hz": 50.0,
        "mapping_s": 2.0,
        "refinement_s": 1.0,
        "num_gaussians": 1000,
        "device": "cpu (x86_64, 2 threads)",
        "description": "built-in simulated room",
        "protocols": {
            FULL: {
                "ate_rmse_cm": ate,
                "psnr_corrected_db": psnr,
                "ssim_corrected": 0.9,
                "lpips_corrected": None,
            },
            SLICES: {
                "ate_rmse_sim3_cm": None if ate is None else ate / 2,
                "psnr_corrected_db": psnr,
                "ssim": 0.8,
                "lpips": None,
            },
        },
    }


def finished(method: str, seed: int, ate: float | None, psnr: float | None = 20.0, **more: Any) -> Outcome:
    job = Job(
        "builtin", more.pop("scene", "office0"), method, seed, differences=more.pop("differences", "{}")
    )
    lost = more.pop("lost", 0)
    result = {
        "metrics": metrics(ate, psnr, lost),
        "seconds": 1.0,
        "map_mb": 3.0,
        "processor": "a CPU, 2 cores",
    }
    return {**about(job), **result, **more}


def broken(method: str, seed: int, **problem: str) -> Outcome:
    return {**about(Job("builtin", "office0", method, seed)), **problem}


RUNS = [
    finished("ed_slam", 0, 0.02, 33.0),
    finished("ed_slam", 1, 0.04, 31.0, lost=3),
    finished("open3d_rgbd", 0, 0.01, 24.0),
    broken("open3d_rgbd", 1, error="it | broke"),
    broken("kiss_icp", 0, skipped="not installed"),
    broken("kiss_icp", 1, skipped="not installed"),
]


def test_table_4_shows_both_protocols_spread_failures_and_who_is_ahead() -> None:
    full, slices = tables_of("table4", RUNS, ["office0"])
    text = as_markdown([full])
    data = "simulated room, exact depth 20 Hz, 2.5 s"
    assert f"| {data} | ed_slam | SE(3) | 0.030 ± 0.014, 3 lost |" in text
    assert f"| {data} | open3d_rgbd | SE(3) | **0.010, 1 of 2 without result** |" in text
    assert f"| {data} | kiss_icp | SE(3) | skipped |" in text
    assert "| EventReplica † | ED-SLAM [1] | not stated | **0.350** |" in text
    assert f"- {data}: ahead of ed_slam: open3d_rgbd in office0 ATE cm (" in text
    assert "(0.010, 1 of 2 without result against 0.030 ± 0.014, 3 lost)" in text
    assert "- without a result: open3d_rgbd, office0 seed 1: error: it | broke" in text
    assert "- [1] ED-SLAM paper, Table IV" in text
    text = as_markdown([slices])
    assert f"| {data} | ed_slam | Sim(3) | 0.015 ± 0.007, 3 lost |" in text
    assert "| EventReplica, slices of 5 s † | IncEventGS [1] | Sim(3) | **0.045** |" in text


def test_a_method_that_failed_is_behind_those_that_did_not() -> None:
    runs = [broken("ed_slam", 0, error="no events"), finished("open3d_icp", 0, 0.5)]
    [full, _] = tables_of("table4", runs, ["office0"])
    assert "ahead of ed_slam: open3d_icp in office0 ATE cm (ed_slam: failed)" in as_markdown([full])


def test_numbers_on_our_own_recording_of_that_data_are_not_marked() -> None:
    job = Job("event_replica", "office0", "ed_slam", depth=RECORDED, rate=0.0)
    values = metrics(0.3) | {"description": "EventReplica layout, data/event_replica/office0"}
    run = {**about(job), "metrics": values, "seconds": 1.0, "map_mb": None, "processor": "a CPU"}
    [full, _] = tables_of("table4", [run], ["office0"])
    assert ("EventReplica", "ED-SLAM [1]", "not stated") in [row.labels for row in full.rows]
    own = {**run, "metrics": values | {"description": "my office"}}  # in that layout, and another recording
    for other in (own, {**run, "job": asdict(replace(job, duration=1.0))}):
        [full, _] = tables_of("table4", [other], ["office0"])
        assert ("EventReplica †", "ED-SLAM [1]", "not stated") in [row.labels for row in full.rows]


def test_true_poses_are_no_trajectory_error() -> None:
    [full, _] = tables_of("table4", [finished("ed_slam", 0, 0.0, poses="truth")], ["office0"])
    assert full.rows[0].labels[1] == "ed_slam (true poses)"
    assert full.rows[0].cells["office0 ate_rmse_cm"].text(full.columns[0]) == "true poses"
    [views, _] = tables_of("table3", [finished("ed_slam", 0, 0.0, poses="truth")], ["office0"])
    assert views.rows[0].cells["office0 psnr_corrected_db"].value == 20.0


def test_tables_1_and_2_stand_beside_the_paper_s() -> None:
    jobs = plan(Wanted(), ("table1",))["table1"]
    runs = [finished(j.method, 0, 0.1 * k, differences=j.differences) for k, j in enumerate(jobs, 1)]
    [table] = tables_of("table1", runs, [])
    assert [row.labels[2] for row in table.rows] == ["5 x 5", "7 x 7", "9 x 9", "11 x 11", "13 x 13"]
    assert [round(row.cells["full ate_rmse_cm"].value or 0, 3) for row in table.rows] == [
        0.1,
        0.2,
        0.3,
        0.4,
        0.5,
    ]
    assert table.rows[2].cells["paper psnr_corrected_db"] == Cell(27.85, is_best=True)
    assert "paper † PSNR dB" in as_markdown([table])


def test_runtime_states_device_and_what_ran_beside_it() -> None:
    [table] = tables_of("runtime", [finished("ed_slam", 0, 0.1, at_once=2)], [])
    ours = table.rows[0]
    assert ours.labels[2] == "cpu (x86_64, 2 threads); a CPU, 2 cores; 2 runs at once"
    assert ours.cells["mapping_hz"].value == 5.0
    assert any(row.labels[1].startswith("IncEventGS") for row in table.rows)


def test_published_numbers_are_the_paper_s() -> None:
    row = [p.value for p in PUBLISHED if p.system == "ED-SLAM" and p.measure == "ate_rmse_cm"]
    assert row == [0.18, 0.45, 0.35, 0.26, 0.66, 0.91, 0.94, 3.00, 1.02]
    assert all(p.source and p.data and p.alignment for p in PUBLISHED)
    top = best(FULL, "desk_normal", "ate_rmse_cm")
    assert top is not None
    assert (top.system, top.value) == ("SplaTAM", 0.75)  # not ED-SLAM
    psnr = best(SLICES, "office0", "psnr_corrected_db")
    assert psnr is not None
    assert psnr.system == "E2EGS"
    assert best(FULL, "nowhere", "ssim") is None


def test_the_best_is_bold_within_its_group_and_ties_share_it() -> None:
    columns = (Column("a", "a", 1, HIGH), Column("b", "b", 1, LOW), Column("c", "c", 0))
    rows = [
        Row(("x",), {"a": Cell(1.04), "b": Cell(2.0), "c": Cell(1.0)}, "g"),
        Row(("y",), {"a": Cell(1.0), "b": Cell(1.0), "c": Cell(2.0)}, "g"),
        Row(("z",), {"a": Cell(9.0), "b": Cell()}, ""),
    ]
    table = Table("t", "T", ("name",), columns, tuple(rows)).with_best()
    assert [[r.cells[k].is_best for k in "ab"] for r in table.rows[:2]] == [[True, False], [True, True]]
    assert not any(cell.is_best for cell in table.rows[2].cells.values())
    assert not table.rows[1].cells["c"].is_best


def test_latex_has_as_many_cells_in_every_row_and_escapes_what_is_special() -> None:
    text = as_latex([*tables_of("table3", RUNS, ["office0", "room0"]), *tables_of("runtime", RUNS, [])])
    tables = re.findall(r"\\begin\{tabular\}\{(l+)(r+)\}(.*?)\\end\{tabular\}", text, re.DOTALL)
    assert len(tables) == 3
    for left, right, body in tables:
        for line in re.findall(r"^(.*&.*) \\\\$", body, re.MULTILINE):
            spans = sum(int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line))
            assert len(re.findall(r"(?<!\\)&", line)) + 1 + spans == len(left) + len(right), line
    assert r"ed\_slam" in text
    assert not re.search(r"(?<!\\)[_%#]", re.sub(r"\\label\{.*?\}", "", text))
    assert "±" not in text
    assert "†" not in text


# --- all of it ---


class Page(HTMLParser):
    """Collects what a page links to and its data."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.data = ""
        self._is_data = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = dict(attributes)
        self.links += [v for k in ("src", "href") if (v := values.get(k))]
        self._is_data = values.get("id") == "data"

    def handle_data(self, data: str) -> None:
        if self._is_data:
            self.data += data

    def handle_endtag(self, tag: str) -> None:
        self._is_data = False


@pytest.mark.slow
def test_one_page_holds_tables_paths_errors_views_and_failures(
    one_by_one: tuple[Job, Path, Outcome],
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, folder, alone = one_by_one

    def copying(at_once: int, todo: Sequence[Work], report: Any) -> Iterator[tuple[Job, Outcome]]:
        for job, place in todo:
            if job.method == "open3d_icp":
                yield job, {**about(job), "error": "</script><b>broke"}
                continue
            place.parent.mkdir(parents=True, exist_ok=True)
            place.symlink_to(folder)
            yield job, {**alone, **about(job)}

    monkeypatch.setattr(paper, "in_processes", lambda at_once: functools.partial(copying, at_once))
    options = PaperOptions(
        scenes=("tiny",), methods=("ed_slam", "open3d_icp"), data_dir=tiny_folder.parent, out=tmp_path
    )
    paper.reproduce_paper(TABLES, options, QUIET)
    made = {path.name for path in tmp_path.iterdir()}
    assert {f"{t}{s}" for t in TABLES for s in (".md", ".tex")} <= made
    assert {"fig4.png", "fig5.png", "report.html", "results.json"} <= made
    text = (tmp_path / "report.html").read_text()
    page = Page()
    page.feed(text)
    assert page.links == []  # nothing to fetch
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    data = json.loads(page.data)
    assert {t["name"] for t in data["tables"]} == set(TABLES)
    [group] = data["groups"]
    [run] = group["runs"]
    truth = EventReplicaSequence(tiny_folder).truth
    assert truth is not None
    assert len(run["errors"]) == len(run["times"]) == len(run["path"]) == len(group["truth"]) == 6
    assert np.sqrt(np.mean(np.square(run["errors"]))) == pytest.approx(
        alone["metrics"]["ate_rmse_cm"], abs=1e-3
    )
    assert run["stages"]["tracking"] > 0
    [view] = group["views"]
    assert view["truth"].startswith("data:image/jpeg;base64,")
    assert view["renders"][0]["method"] == "ed_slam"
    assert any("</script><b>broke" in line for line in data["failures"])  # shown, and it ended nothing


def test_long_cases_are_walks_of_a_minute_and_five() -> None:
    jobs = long_runs.plan_long(LongOptions(methods=("ed_slam",)))
    assert [(j.duration, j.moving_object) for j in jobs] == [(60.0, False), (300.0, False), (60.0, True)]
    assert {(j.scene, j.path, j.depth, j.size) for j in jobs} == {("flat", "tour", "kinect", (240, 150))}
    assert len({j.name for j in jobs}) == len({j.data for j in jobs}) == 3
    assert job_of(json.loads(json.dumps(asdict(jobs[0])))) == jobs[0]
    with pytest.raises(ConfigError, match="cases: expected some of minute, five_minutes, moving, got 'hour'"):
        long_runs.plan_long(LongOptions(cases=("hour",)))


def test_fields_that_were_added_leave_the_names_of_finished_runs() -> None:
    job = Job("builtin", "office0", "ed_slam")
    assert job.name == "builtin-office0-exact-20hz/ed_slam-seed0-ddba9915"
    assert replace(job, moving_object=True).name != job.name


@pytest.mark.slow
def test_drift_is_the_distance_from_the_truth_with_both_at_the_same_start(
    one_by_one: tuple[Job, Path, Outcome], tmp_path: Path
) -> None:
    job, folder, outcome = one_by_one
    run = ShownRun(outcome, folder)
    curve = long_runs.drift_of(run, "trajectory_tum.txt")
    assert curve is not None
    travelled, drift = curve
    assert travelled[-1] == pytest.approx(outcome["metrics"]["path_length_m"], abs=1e-3)
    assert drift[0] == pytest.approx(0, abs=1e-9)
    assert outcome["metrics"]["ate_rmse_cm"] / 2 < drift.max() < 20 * outcome["metrics"]["ate_rmse_cm"]
    place = tmp_path / "runs" / job.name
    place.parent.mkdir(parents=True)
    place.symlink_to(folder)
    failed = {**about(replace(job, method="open3d_icp")), "error": "it broke"}
    long_runs.write_long([outcome, failed], tmp_path)
    text = (tmp_path / "long.md").read_text()
    assert f"| {drift[-1]:.2f} |" in text
    assert "| recording (event_replica), first 0.3 s | open3d_icp | failed |" in text
    [picture] = tmp_path.glob("drift-*.png")
    assert picture.stat().st_size > 5000
    assert (tmp_path / "report.html").is_file()


def test_stored_tables_are_shown_by_report(tmp_path: Path) -> None:
    (tmp_path / "docs/results").mkdir(parents=True)
    options = PaperOptions(scenes=("office0",), seeds=(0, 1), store=tmp_path, out=tmp_path / "out")
    jobs = plan(Wanted(("office0",), ("ed_slam", "open3d_rgbd", "kiss_icp"), (0, 1)), ("table4",))
    outcomes = {o["name"]: o for o in RUNS}
    nowhere = options.model_copy(update={"store": tmp_path / "none"})
    with pytest.raises(DataError, match="give the checkout that contains docs/"):
        paper.write_all(("table4",), jobs, outcomes, nowhere)
    paper.write_all(("table4",), jobs, outcomes, options)
    stored = json.loads((tmp_path / "docs/results/paper_table4.json").read_text())
    assert stored["rows"][0]["command"] == "edslam reproduce table4 --scenes office0 --seeds 0 1"
    assert re.fullmatch("[0-9a-f]{7,}|version .*", stored["rows"][0]["commit"])
    assert stored["rows"][-1]["commit"] == "published"
    names = ("paper_table4", "paper_table4_inceventgs")
    (tmp_path / "README.md").write_text("".join(f"<!-- {n} -->\n<!-- end {n} -->\n" for n in names))
    report_tables(tmp_path, check=False)
    report_tables(tmp_path, check=True)
    text = (tmp_path / "README.md").read_text()
    assert "| ed_slam | SE(3) | 0.030 ± 0.014, 3 lost |" in text
    assert "| open3d_rgbd | SE(3) | **0.010, 1 of 2 without result** |" in text
    assert "- [1] ED-SLAM paper, Table IV" in text


def test_a_cell_of_a_document_shows_spread_words_and_the_best() -> None:
    column = {"decimals": 2}
    value = {"mean": 0.5, "spread": None, "words": "", "is_best": True}
    assert cell(value, column) == "**0.50**"
    assert cell(value | {"spread": 0.1, "words": "2 lost", "is_best": False}, column) == "0.50 ± 0.10, 2 lost"


def test_start_needs_only_the_package(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker starts in a folder of its own, without the checkout on its path."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    job = replace(tiny_job(tiny_folder), scene="absent")
    process = start(job, tmp_path / "run", 1)
    assert process.wait(60) == 0
    assert "not found" in outcome_of(job, tmp_path / "run", 0)["error"]
