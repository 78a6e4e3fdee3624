"""Benchmark: alternatives compute what the kernels compute; the app leaves its table."""

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from patches import normal_equations

import edslam_ti.experiments.steps
from apps.benchmark import main
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import EdSlamError
from edslam_ti.experiments.front_end import front_end
from edslam_ti.experiments.kernel_times import (
    OURS,
    Row,
    Stopwatch,
    cold_start,
    count_pairs,
    linearise_in_numpy,
    linearise_in_torch,
    rasterize_pairs,
    room_scene,
    tracking_inputs,
)
from edslam_ti.experiments.steps import Curve, mapping_step, slam
from edslam_ti.kernels.engine import ENGINE, ENGINES, VERSION
from edslam_ti.kernels.patch_warp import ResidualModel
from edslam_ti.kernels.projection import MIN_ALPHA
from edslam_ti.kernels.rasterization import rasterize
from edslam_ti.kernels.reference import project
from edslam_ti.mapping.gaussians import GaussianMap

pytestmark = pytest.mark.slow

OTHER = next((e for e in ENGINES if e != ENGINE and importlib.util.find_spec(e)), None)


def test_pair_list_renders_and_differentiates_like_the_kernel() -> None:
    scene, intrinsics = room_scene(300, 40, 30)
    inputs = [x.requires_grad_() for x in scene]
    view = rasterize(*inputs, intrinsics, (40, 30))
    ours, theirs = (view.image, view.depth, view.alpha), rasterize_pairs(*inputs, intrinsics, (40, 30))
    for a, b in zip(ours, theirs):
        assert float((a - b).abs().mean()) < 1e-5
    gradients = [torch.autograd.grad(sum(x.sin().sum() for x in images), inputs) for images in (ours, theirs)]
    for a, b in zip(*gradients):
        assert float((a - b).norm() / b.norm()) < 2e-3  # float32, cut-off flips included


@pytest.mark.parametrize("linearise", [linearise_in_numpy, linearise_in_torch])
@pytest.mark.parametrize("is_inverse", [False, True])
def test_alternatives_linearise_like_the_kernel(linearise: Callable, is_inverse: bool) -> None:
    patches, surface, depth, T = tracking_inputs((64, 48))
    arguments = (patches, surface, depth, T, (50.0, 50.0, 32.0, 24.0), ResidualModel(), is_inverse)
    ours, (H, g) = normal_equations(*arguments), linearise(*arguments)
    assert np.linalg.norm(ours.H - H) / np.linalg.norm(H) < 1e-3  # float32 residuals at millimetres
    assert np.linalg.norm(ours.g - g) / np.linalg.norm(g) < 5e-3


def test_pairs_are_counted_as_the_pair_list_lists_them() -> None:
    inputs, intrinsics = room_scene(400, 64, 48)
    means, quats, scales, _, colors, pose = inputs
    opaque = torch.full((400,), 0.9)
    _, covariances, _ = project(means, quats, scales, pose, intrinsics)
    v, u = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    centres, _, depths = project(means, quats, scales, pose, intrinsics)
    d = torch.stack([u, v], -1).view(-1, 1, 2) - centres
    power = 0.5 * torch.einsum("pgi,gij,pgj->pg", d, torch.linalg.inv(covariances), d)
    listed = int(((0.9 * torch.exp(-power) >= MIN_ALPHA) & (depths > 0.05)).sum())
    counted = count_pairs([means, quats, scales, opaque, colors, pose], intrinsics, (64, 48))
    assert counted == pytest.approx(listed, rel=0.1)  # those cut by the border count whole


def test_ways_of_a_mapping_step_take_the_same_step(monkeypatch: pytest.MonkeyPatch) -> None:
    gradients: dict[str, dict[str, torch.Tensor]] = {}
    current = [""]

    def compare(suite: str, task: str, candidates: dict[str, Callable[[], None]]) -> list[Row]:
        for name, run in candidates.items():
            current[0] = name
            run()
        return []

    def recording(gaussians: GaussianMap) -> None:
        gradients[current[0]] = {k: v.grad.clone() for k, v in gaussians.raw.items() if v.grad is not None}
        for value in gaussians.raw.values():
            value.grad = None

    monkeypatch.setattr(GaussianMap, "step", recording)
    watch = Stopwatch(1)
    monkeypatch.setattr(watch, "compare", compare)
    list(mapping_step((40, 30), 200, watch))
    ours, *others = gradients.values()
    assert len(others) == 2
    for other in others:
        for name in ("means", "log_scales", "logit_opacities", "logit_colors"):
            assert float((ours[name] - other[name]).norm() / other[name].norm()) < 5e-3


def test_exponent_is_the_slope_of_the_logarithms() -> None:
    sizes = [1e3, 1e4, 1e5]
    curve = Curve("render", "pixels", sizes, [1.0, 1.0, 1.0], [2 * s**0.8 for s in sizes])
    assert curve.exponent == pytest.approx(0.8)
    assert Curve("render", "threads", [1, 2], [8.0, 4.0], [8.0, 8.0]).exponent == pytest.approx(-1)


def read(folder: Path) -> dict:
    return json.loads((folder / "benchmark.json").read_text())


def test_app_writes_a_table_and_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ("--sizes", "32", "24", "--gaussians", "50", "--events", "100")
    main([*size, "--rounds", "1", "--threads", "2", "--out", str(tmp_path)])
    table = (tmp_path / "benchmark.md").read_text()
    assert table == capsys.readouterr().out
    rows = read(tmp_path)["rows"]
    assert {row["suite"] for row in rows} == {"rasterizer", "time_surface", "tracking", "mapping_step"}
    assert {row["name"] for row in rows} >= {OURS, "torch pair list", "torch twin", "numpy"}
    assert all(row["wall_ms"] > 0 for row in rows)
    assert all(row["limit_ms"] > 0 for row in rows if row["suite"] == "rasterizer")


def test_app_plots_how_the_cost_grows(tmp_path: Path) -> None:
    sizes = ("--sizes", "16", "12", "32", "24", "--gaussians", "20", "60", "--events", "50", "100")
    main(["--suites", "scaling", *sizes, "--rounds", "1", "--threads", "2", "--out", str(tmp_path)])
    curves = read(tmp_path)["curves"]
    assert {curve["against"] for curve in curves} == {"pixels", "Gaussians", "events", "threads"}
    assert all(np.isfinite(curve["exponent"]) for curve in curves)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    assert "| render and gradients | Gaussians | 20 | 60 |" in (tmp_path / "benchmark.md").read_text()


def test_frames_of_a_sequence_pass_through_every_method(
    tiny_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        edslam_ti.experiments.steps, "open_sequence", lambda config: EventReplicaSequence(tiny_folder)
    )
    rows = list(slam("tiny", 0.3))
    names = [row.name for row in rows]
    assert names[:2] == ["ed_slam, tracking", "ed_slam with time surfaces, tracking"]
    assert rows[-1].name == "ed_slam, tracking and mapping"
    assert rows[-1].cpu_ms > rows[0].cpu_ms


def test_cold_start_is_the_sum_of_its_parts() -> None:
    total, *parts = cold_start(threads=2, rounds=1)
    assert [row.name for row in parts] == ["import", f"start {OURS}", "compile every kernel"]
    assert total.cpu_ms == pytest.approx(sum(row.cpu_ms for row in parts))
    assert all(row.cpu_ms > 1 for row in parts)


@pytest.mark.slow
@pytest.mark.skipif(OTHER is None, reason="quadrants is not installed")
def test_another_engine_has_a_column(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert OTHER is not None
    size = ("--sizes", "32", "24", "--events", "100", "--rounds", "1", "--suites", "time_surface", "tracking")
    main([*size, "--engines", ENGINE, OTHER, "--out", str(tmp_path)])
    machine, _, header, _, *lines = capsys.readouterr().out.splitlines()
    assert f"by {ENGINE} {VERSION}" in machine
    assert header.endswith(f"| limit ms | {OTHER} wall ms |")
    ours = [line for line in lines if f"| {OURS}" in line]
    assert len(ours) == 5
    assert all(float(line.split("|")[-2]) > 0 for line in ours)
    assert all(line.endswith("|  |") for line in lines if line not in ours)
    assert {row["suite"] for row in read(tmp_path)["other_engines"][OTHER]} == {"time_surface", "tracking"}


def test_the_engine_of_a_running_process_stays() -> None:
    other = "taichi" if ENGINE == "quadrants" else "quadrants"
    with pytest.raises(EdSlamError, match=f"this process already runs {ENGINE}"):
        main(["--engines", other])


def test_missing_device_is_one_line() -> None:
    if not torch.cuda.is_available():
        with pytest.raises(EdSlamError, match="use --device cpu"):
            main(["--device", "cuda"])


def test_the_front_end_is_timed_in_a_cache_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EDSLAM_CACHE", str(tmp_path))
    monkeypatch.setattr("edslam_ti.experiments.front_end.IN_MEMORY", 10_000)
    monkeypatch.setattr("edslam_ti.event_files.checked.IN_MEMORY", 10_000)
    rows = list(front_end((64, 48), 5_000, Stopwatch(1)))
    assert [row.task.split(": ")[1] for row in rows] == ["check and copy", "read, count, time surface"]
    assert all(row.wall_ms > 0 for row in rows)
    assert not list(tmp_path.iterdir())
