"""Importing the package changes nothing in the process; a cold start harms no other user of Taichi."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from edslam_ti.cold_start import THREADS
from edslam_ti.kernels.engine import ENGINE, VERSION

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in (ROOT / "edslam_ti").rglob("*.py")
    }
    | {f"edslam_ti.kernels.{path.stem}" for path in (ROOT / "kernels").glob("[!_]*.py")}
)
OPTIONAL = "edslam_ti.baselines.kiss"  # its library need not be installed

EVERY_IMPORT = f"""
import gc, importlib, os, sys
import cv2, numpy, torch, {ENGINE}  # what they change themselves is not ours
from {ENGINE}.lang import expr, impl, kernel_impl
from {ENGINE}.lang.ast import ast_transformer_utils
context = getattr(ast_transformer_utils, "ASTTransformerContext", ast_transformer_utils)

def state():
    internals = [dict(vars(each)) for each in ({ENGINE}, expr, impl, kernel_impl, context)]
    collector = gc.isenabled(), gc.get_freeze_count(), gc.get_threshold(), list(gc.callbacks)
    return internals, collector, dict(os.environ), sys.stdout, sys.excepthook, torch.get_num_threads()

before = state()
for name in sys.argv[1:]:
    importlib.import_module(name)
after = state()
for a, b in zip(before, after, strict=True):
    assert a == b, (a, b)
"""

OTHERS_KERNEL = """
import {engine} as ti

@ti.data_oriented
class Doubler:
    def __init__(self, factor):
        self.factor = factor

    @ti.func
    def times(self, x):
        return self.factor * x

    @ti.kernel
    def double(self, x: ti.f32) -> ti.f32:
        return self.times(x)

@ti.kernel
def halve(x: ti.f32) -> ti.f32:
    return x / 2

ti.init(arch=ti.cpu, offline_cache=False)
assert Doubler(2.0).double(4.0) == 8.0
assert halve(4.0) == 2.0
"""


def run(code: str, folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a script of its own file, as the engine reads the source of kernels."""
    script = folder / "script.py"
    script.write_text(code)
    inherited = {name: value for name, value in os.environ.items() if name not in THREADS}
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return subprocess.run(
        [sys.executable, str(script), *arguments],
        capture_output=True, text=True, check=False, env=inherited | {"PYTHONPATH": paths} | environment,
    )  # fmt: skip


def test_importing_every_module_changes_nothing_in_the_process(tmp_path: Path) -> None:
    modules = [name for name in MODULES if name != OPTIONAL]
    assert len(modules) > 50
    done = run(EVERY_IMPORT, tmp_path, *modules)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") <= 1  # the engine's own banner


def test_imports_print_nothing(tmp_path: Path) -> None:
    done = run("import os; import edslam_ti.kernels.runtime; import edslam_ti.kernels.patch_warp", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_constants_are_imported_without_an_engine(tmp_path: Path) -> None:
    code = (
        "import sys; import edslam_ti.kernels; assert not {'taichi', 'quadrants', 'torch'} & set(sys.modules)"
    )
    assert run(code, tmp_path).returncode == 0


@pytest.mark.parametrize(
    "start",
    [
        "import edslam_ti, edslam_ti.kernels.rasterization\n",
        "import edslam_ti.cold_start\nedslam_ti.cold_start.load_kernels()\n"
        "import edslam_ti.kernels.rasterization\n",
    ],
    ids=["import", "cold start"],
)
def test_kernels_of_others_compile_and_run(start: str, tmp_path: Path) -> None:
    done = run(start + OTHERS_KERNEL.format(engine=ENGINE), tmp_path)
    assert done.returncode == 0, done.stderr


APPLIED = """
import gc
from edslam_ti.cold_start import load_kernels
load_kernels()
from edslam_ti.kernels import taichi_speedups
print(taichi_speedups.apply(), gc.isenabled(), gc.get_freeze_count() > 1000)
"""


@pytest.mark.parametrize("plain", ["0", "1"])
def test_replacements_depend_on_the_version_and_a_switch(plain: str, tmp_path: Path) -> None:
    done = run(APPLIED, tmp_path, EDSLAM_PLAIN_TAICHI=plain)
    is_replaced = plain == "0" and (ENGINE, VERSION) == ("taichi", "1.7.4")
    assert done.stdout.split() == [str(is_replaced), "True", "True"], done.stderr


def test_threads_of_libraries_are_set_unless_they_are_already(tmp_path: Path) -> None:
    code = (
        "import os\nfrom edslam_ti.cold_start import load_kernels\nload_kernels()\n"
        "print(os.environ['OMP_WAIT_POLICY'], os.environ['OPENBLAS_NUM_THREADS'])"
    )
    done = run(code, tmp_path, OMP_WAIT_POLICY="ACTIVE")
    assert done.stdout.split() == ["ACTIVE", "1"], done.stderr


@pytest.mark.parametrize(
    ("engine", "message"),
    [
        ("jax", "EDSLAM_ENGINE: expected 'taichi' or 'quadrants', got 'jax'"),
        ("quadrants", "quadrants is not installed; pip install 'edslam-ti[quadrants]'"),
    ],
)
def test_an_engine_that_is_unknown_or_missing_says_what_to_do(
    engine: str, message: str, tmp_path: Path
) -> None:
    code = (
        "import sys\nsys.modules['quadrants'] = None  # as if it were not installed\n"
        "from edslam_ti.command_line import launch\n"
        "from edslam_ti.cold_start import load_kernels\nlaunch(load_kernels)\n"
    )
    done = run(code, tmp_path, EDSLAM_ENGINE=engine)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
