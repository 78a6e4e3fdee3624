"""Benchmark: alternatives compute what the kernels compute; the app leaves its table."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from apps.benchmark import main
from kernels.benchmark import linearise_in_numpy, rasterize_pairs, room_scene, tracking_inputs
from kernels.patch_warp import ResidualModel, normal_equations
from kernels.rasterization import rasterize


def test_pair_list_renders_and_differentiates_like_the_kernel() -> None:
    inputs, intrinsics = room_scene(300, 40, 30)
    inputs = [x.requires_grad_() for x in inputs]
    view = rasterize(*inputs, intrinsics, (40, 30))
    ours, theirs = (view.image, view.depth, view.alpha), rasterize_pairs(*inputs, intrinsics, (40, 30))
    for a, b in zip(ours, theirs):
        assert float((a - b).abs().mean()) < 1e-5
    gradients = [torch.autograd.grad(sum(x.sin().sum() for x in images), inputs) for images in (ours, theirs)]
    for a, b in zip(*gradients):
        assert float((a - b).norm() / b.norm()) < 2e-3  # float32, cut-off flips included


@pytest.mark.parametrize("is_inverse", [False, True])
def test_numpy_linearises_like_the_kernel(is_inverse: bool) -> None:
    patches, surface, depth, T = tracking_inputs((64, 48))
    arguments = (patches, surface, depth, T, (50.0, 50.0, 32.0, 24.0), ResidualModel(), is_inverse)
    ours, (H, g) = normal_equations(*arguments), linearise_in_numpy(*arguments)
    assert np.linalg.norm(ours.H - H) / np.linalg.norm(H) < 1e-3  # float32 residuals at millimetres
    assert np.linalg.norm(ours.g - g) / np.linalg.norm(g) < 5e-3


def test_app_writes_a_table_and_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ("--sizes", "32", "24", "--gaussians", "50", "--events", "100")
    main([*size, "--rounds", "1", "--threads", "2", "--out", str(tmp_path)])
    table = (tmp_path / "benchmark.md").read_text()
    assert table == capsys.readouterr().out
    rows = json.loads((tmp_path / "benchmark.json").read_text())["rows"]
    assert {row["suite"] for row in rows} == {"rasterizer", "time_surface", "tracking"}
    assert {row["name"] for row in rows} >= {"Taichi", "torch pair list", "torch twin", "numpy"}
    assert all(row["wall_ms"] > 0 for row in rows)
