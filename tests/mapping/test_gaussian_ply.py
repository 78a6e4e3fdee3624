"""Gaussians in a file are what splat viewers expect."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edslam_ti.errors import DataError
from edslam_ti.mapping.gaussian_ply import SPLAT_PROPERTIES, read_gaussian_ply, write_gaussian_ply
from edslam_ti.open3d_loader import load_open3d


def gaussians(count: int = 5, channels: int = 1) -> dict[str, Any]:
    random = np.random.default_rng(0)
    quats = random.normal(size=(count, 4))
    return {
        "means": random.normal(size=(count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": random.normal(size=(count, 3)) - 4,
        "logit_opacities": random.normal(size=count),
        "colors": random.random((count, channels)),
    }


def test_splat_file_reads_back_what_was_written(tmp_path: Path) -> None:
    written = gaussians(channels=3)
    write_gaussian_ply(tmp_path / "map.ply", **written)
    read = read_gaussian_ply(tmp_path / "map.ply")
    assert read.keys() == written.keys()
    for name, values in written.items():
        np.testing.assert_allclose(read[name], values, atol=1e-6, err_msg=name)


def test_splat_file_is_the_3dgs_layout_to_the_byte(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_gaussian_ply(path, **gaussians(count=2))
    header, body = path.read_bytes().split(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    assert names == list(SPLAT_PROPERTIES)
    assert len(body) == 2 * 17 * 4
    row = dict(zip(names, np.frombuffer(body, "<f4")[:17]))
    grey = gaussians(count=2)["colors"][0, 0]
    assert row["nx"] == row["ny"] == row["nz"] == 0
    # Viewers show 0.5 + 0.282 f_dc, exp(scale), sigmoid(opacity), and rot_0 is w.
    assert row["f_dc_0"] == row["f_dc_1"] == row["f_dc_2"]
    assert 0.5 + 0.28209479177387814 * row["f_dc_0"] == pytest.approx(grey, abs=1e-6)
    assert row["rot_0"] == pytest.approx(gaussians(count=2)["quats"][0, 0], abs=1e-6)


@pytest.mark.parametrize(("degree", "count"), [(1, 9), (2, 24), (3, 45)])
def test_higher_harmonics_are_zeros_in_the_order_that_readers_by_position_expect(
    tmp_path: Path, degree: int, count: int
) -> None:
    path, written = tmp_path / "map.ply", gaussians()
    write_gaussian_ply(path, **written, harmonics=degree)
    header, body = path.read_bytes().split(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    rest = [f"f_rest_{k}" for k in range(count)]
    assert names == [*SPLAT_PROPERTIES[:9], *rest, *SPLAT_PROPERTIES[9:]]
    assert not np.frombuffer(body, "<f4").reshape(5, -1)[:, 9 : 9 + count].any()
    np.testing.assert_allclose(read_gaussian_ply(path)["quats"], written["quats"], atol=1e-6)


def test_splat_file_is_a_point_cloud_to_open3d(tmp_path: Path) -> None:
    write_gaussian_ply(tmp_path / "map.ply", **gaussians())
    cloud = load_open3d().io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), gaussians()["means"], atol=1e-6)


def test_quaternions_are_normalised_in_the_file(tmp_path: Path) -> None:
    values = gaussians()
    values["quats"] = values["quats"] * 3
    write_gaussian_ply(tmp_path / "map.ply", **values)
    np.testing.assert_allclose(
        read_gaussian_ply(tmp_path / "map.ply")["quats"], gaussians()["quats"], atol=1e-6
    )


def test_empty_map_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no Gaussians"):
        write_gaussian_ply(tmp_path / "map.ply", **gaussians(count=0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "colors"])
def test_not_a_number_is_not_exported(tmp_path: Path, name: str) -> None:
    values = gaussians()
    values[name].reshape(-1)[3] = np.nan
    with pytest.raises(DataError, match=name):
        write_gaussian_ply(tmp_path / "map.ply", **values)
    assert list(tmp_path.iterdir()) == []


def test_wrong_shapes_are_named(tmp_path: Path) -> None:
    values = gaussians()
    values["quats"] = values["quats"][:, :3]
    with pytest.raises(DataError, match=r"quats: expected shape \(5, 4\), got \(5, 3\)"):
        write_gaussian_ply(tmp_path / "map.ply", **values)


@pytest.mark.parametrize(
    "content",
    [b"", b"not a ply", b"ply\nformat ascii 1.0\nend_header\n", b"ply\nformat binary_little_endian 1.0\n"],
)
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "map.ply").write_bytes(content)
    with pytest.raises(DataError, match="binary little endian"):
        read_gaussian_ply(tmp_path / "map.ply")


def test_truncated_and_incomplete_splat_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_gaussian_ply(path, **gaussians())
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    with pytest.raises(DataError, match="truncated"):
        read_gaussian_ply(path)
    path.write_bytes(whole.replace(b"property float rot_3", b"property float other"))
    with pytest.raises(DataError, match="rot_3"):
        read_gaussian_ply(path)
    with pytest.raises(FileNotFoundError):
        read_gaussian_ply(tmp_path / "absent.ply")
