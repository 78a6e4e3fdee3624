"""The package: what importing it loads, its public names, and what pyproject.toml says of it."""

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import edslam_ti
from edslam_ti.config import CONFIGS, Config, dataset_differences
from edslam_ti.datasets import FORMATS
from edslam_ti.methods import METHODS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_import_loads_neither_torch_nor_taichi() -> None:
    code = "import sys, edslam_ti, edslam_ti.config; print(*sys.modules); edslam_ti.Config()"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "edslam_ti.config" in loaded.stdout.split()
    assert not {"torch", "taichi", "cv2", "open3d"} & set(loaded.stdout.split())


def test_public_names_are_there() -> None:
    from edslam_ti.pipeline import run
    from edslam_ti.slam import Slam

    assert (edslam_ti.run, edslam_ti.Slam, edslam_ti.Config) == (run, Slam, Config)
    for name in edslam_ti.__all__:
        assert getattr(edslam_ti, name) is not None
        assert name in dir(edslam_ti)
    with pytest.raises(AttributeError, match="has no attribute 'runn'"):
        edslam_ti.runn  # noqa: B018


def test_entry_point_is_there() -> None:
    module, _, function = PROJECT["project"]["scripts"]["edslam"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_settings_of_data_sets_are_package_data() -> None:
    """They are found beside the code, as in an installed wheel."""
    assert CONFIGS.parent == Path(edslam_ti.__file__).parent
    assert "configs/*.yaml" in PROJECT["tool"]["setuptools"]["package-data"]["edslam_ti"]
    assert {path.name for path in CONFIGS.iterdir()} == {path.name for path in (ROOT / "configs").iterdir()}
    assert dataset_differences("rpg") != {}
    assert dataset_differences("builtin") == {}


def test_extras_that_messages_name_are_there() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    sources = [path.read_text() for path in (ROOT / "edslam_ti").rglob("*.py")]
    named = {name for text in sources for name in re.findall(r"edslam-ti\[(\w+)\]", text)}
    assert named
    assert named <= set(extras)


def test_help_names_every_data_set() -> None:
    description = Config.model_fields["dataset"].description or ""
    assert set(FORMATS) <= set(re.findall(r"\w+", description))


def test_every_method_has_a_description() -> None:
    assert all(method.description for method in METHODS.values())
