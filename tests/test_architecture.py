"""Who may import whom, read from the source: lower ranks, and what comes before in the same rank."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# One row per rank: modules in the order of the data flow, "package.*" for all of a package.
RANKS: list[list[str]] = [
    [
        "kernels.*",
        "edslam_ti",
        "edslam_ti.errors",
        "edslam_ti.memory",
        "edslam_ti.output",
        "edslam_ti.open3d_loader",
    ],
    ["edslam_ti.config", "edslam_ti.geometry", "edslam_ti.camera", "edslam_ti.events"],
    ["edslam_ti.trajectory", "edslam_ti.simulation.*", "edslam_ti.datasets.*"],
    [
        "edslam_ti.pointcloud",
        "edslam_ti.volume",
        "edslam_ti.gaussians",
        "edslam_ti.rendering",
        "edslam_ti.losses",
        "edslam_ti.brightness",
        "edslam_ti.brightness_image",
        "edslam_ti.motion_prior",
    ],
    [
        *(
            "edslam_ti.contrast",
            "edslam_ti.frame",
            "edslam_ti.surface_frame",
            "edslam_ti.tracking",
            "edslam_ti.keyframes",
            "edslam_ti.sharp_images",
            "edslam_ti.event_images",
        ),
        *(
            "edslam_ti.keyframe_alignment",
            "edslam_ti.place_recognition",
            "edslam_ti.pose_graph",
            "edslam_ti.brightness_tracking",
            "edslam_ti.densification",
            "edslam_ti.map_alignment",
            "edslam_ti.mapping",
        ),
    ],
    ["edslam_ti.slam"],
    [
        *("edslam_ti.baselines.*", "edslam_ti.evaluation", "edslam_ti.surface_errors", "edslam_ti.export"),
        *("edslam_ti.pictures", "edslam_ti.visualization"),
    ],
    ["edslam_ti.command_line", "edslam_ti.results", "edslam_ti.pipeline", "edslam_ti.benchmark"],
    [
        *("edslam_ti.reproduce", "edslam_ti.reproduce.cases", "edslam_ti.reproduce.altered"),
        *("edslam_ti.reproduce.recordings", "edslam_ti.reproduce.runs", "edslam_ti.reproduce.ablations"),
        *("edslam_ti.reproduce.report", "edslam_ti.reproduce.long_stream", "edslam_ti.reproduce.command"),
    ],
    ["apps.*"],
]

# Libraries that only some modules may import, besides numpy, torch and the standard library.
LIBRARIES: dict[str, list[str]] = {
    "taichi": ["kernels.*"],
    "open3d": ["edslam_ti.open3d_loader"],
    "libusb_package": ["edslam_ti.open3d_loader"],
    "pydantic": [
        "edslam_ti.config",
        "edslam_ti.command_line",
        "edslam_ti.simulation.*",
        "edslam_ti.datasets.*",
    ],
    "yaml": ["edslam_ti.config"],
    "scipy": [
        *("edslam_ti.trajectory", "edslam_ti.simulation.*", "edslam_ti.gaussians", "edslam_ti.brightness"),
        *("edslam_ti.pointcloud", "edslam_ti.pictures"),
    ],
    "cv2": [
        *("edslam_ti.datasets.*", "edslam_ti.simulation.*", "edslam_ti.surface_frame", "edslam_ti.pictures"),
        *("edslam_ti.brightness", "edslam_ti.contrast", "edslam_ti.event_images"),
        *("edslam_ti.keyframe_alignment", "edslam_ti.place_recognition"),
        "edslam_ti.pointcloud",
    ],
    "OpenEXR": ["edslam_ti.datasets.*"],
    "platformdirs": ["edslam_ti.datasets.*"],
    "evo": ["edslam_ti.evaluation"],
    "skimage": ["edslam_ti.evaluation"],
    "kiss_icp": ["edslam_ti.baselines.*"],
    "lpips": ["edslam_ti.evaluation"],
    "numba": ["kernels.benchmark"],
    "dv_processing": ["kernels.benchmark"],
    "matplotlib": ["edslam_ti.pictures", "edslam_ti.visualization", "edslam_ti.benchmark"],
    "rich": [
        "edslam_ti.datasets.*",
        "edslam_ti.results",
        "edslam_ti.pipeline",
        "edslam_ti.reproduce.*",
        "apps.*",
    ],
    "psutil": ["edslam_ti.reproduce.long_stream"],
    "tyro": ["edslam_ti.command_line", "edslam_ti.reproduce.*", "apps.*"],
}
USES_OPEN3D = [
    "edslam_ti.surface_errors",
    "edslam_ti.pose_graph",
    *("edslam_ti.simulation.*", "edslam_ti.pointcloud", "edslam_ti.volume"),
    *("edslam_ti.baselines.*", "edslam_ti.export", "edslam_ti.visualization"),
]


def source_files() -> dict[str, Path]:
    """Return our modules by dotted name."""
    files = {}
    for folder in ("kernels", "edslam_ti", "apps"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


MODULES = source_files()


def matches(module: str, pattern: str) -> bool:
    package = pattern.removesuffix(".*")
    return module == package or (pattern.endswith(".*") and module.startswith(package + "."))


def rank(module: str) -> tuple[int, int]:
    """Return (rank, place within the rank); an unknown module fails the test that asks."""
    found = [
        (r, place)
        for r, row in enumerate(RANKS)
        for place, pattern in enumerate(row)
        if matches(module, pattern)
    ]
    assert len(found) == 1, f"{module} has no place in RANKS; decide its rank there and in the documents"
    return found[0]


def imports(module: str, is_module_level_only: bool = False) -> set[str]:
    """Return the dotted names that a module imports, also inside functions and TYPE_CHECKING blocks."""
    tree = ast.parse(MODULES[module].read_text())
    nodes = ast.walk(tree) if not is_module_level_only else iter(tree.body)
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import; write the full name"
            assert node.module is not None
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            ours = submodules & MODULES.keys()
            names |= ours if len(ours) == len(submodules) else ours | {node.module}
    return names


def our_imports(module: str) -> set[str]:
    return {name for name in imports(module) if name.split(".")[0] in ("kernels", "edslam_ti", "apps")}


@pytest.mark.parametrize("module", MODULES)
def test_module_imports_only_from_lower_ranks(module: str) -> None:
    own_rank, own_place = rank(module)
    for name in our_imports(module) - {module}:
        other_rank, other_place = rank(name)
        assert other_rank <= own_rank, f"{module} (rank {own_rank}) imports {name} (rank {other_rank})"
        if other_rank == own_rank:
            assert other_place <= own_place, f"{module} imports {name}, which comes after it"


@pytest.mark.parametrize("module", MODULES)
def test_libraries_stay_where_they_belong(module: str) -> None:
    for name in imports(module):
        library = name.split(".")[0]
        if library in sys.stdlib_module_names or library in (
            "kernels",
            "edslam_ti",
            "apps",
            "numpy",
            "torch",
        ):
            continue
        assert library in LIBRARIES, f"{module} imports {library}, which has no place in LIBRARIES"
        assert any(matches(module, p) for p in LIBRARIES[library]), f"{module} must not import {library}"
    if "edslam_ti.open3d_loader" in imports(module):
        assert any(matches(module, p) for p in USES_OPEN3D), f"{module} must not use Open3D"


def test_imports_have_no_cycle() -> None:
    graph = {module: our_imports(module) & MODULES.keys() - {module} for module in MODULES}
    while graph:
        leaves = {module for module, needed in graph.items() if not needed & graph.keys()}
        # Packages re-export their own parts, so a part may name its package in a cycle with itself only.
        leaves |= {
            m for m, needed in graph.items() if all(n.startswith(m + ".") for n in needed & graph.keys())
        }
        assert leaves, f"import cycle among {sorted(graph)}"
        graph = {module: needed for module, needed in graph.items() if module not in leaves}


def test_kernels_know_nothing_of_slam() -> None:
    for module in (m for m in MODULES if matches(m, "kernels.*")):
        assert all(name.startswith("kernels") for name in our_imports(module)), module


@pytest.mark.parametrize("module", [m for m in MODULES if matches(m, "kernels.*")])
def test_kernel_annotations_stay_real_types(module: str) -> None:
    assert "__future__" not in imports(module)  # Taichi rejects annotations that are strings


@pytest.mark.parametrize("module", [m for m in MODULES if matches(m, "apps.*")])
def test_apps_are_thin(module: str) -> None:
    source = MODULES[module].read_text()
    assert len(source.splitlines()) < 100, f"{module} is not thin any more: move what it does to edslam_ti"
    used = {name.split(".")[0] for name in imports(module)} - set(sys.stdlib_module_names)
    assert used <= {"edslam_ti", "tyro", "rich"} | (
        {"kernels", "numpy", "torch"} if "benchmark" in module else set()
    )
    docstring = ast.get_docstring(ast.parse(source)) or ""
    assert docstring.startswith(f"python {module.replace('.', '/')}.py"), "begin with the command"


# They take seconds to load, and a machine without a display or a GPU may lack what they need.
HEAVY = {"open3d", "kiss_icp", "matplotlib", "evo", "skimage", "lpips", "rosbags", "h5py"}


@pytest.mark.parametrize("module", [m for m in MODULES if m != "edslam_ti.open3d_loader"])
def test_heavy_libraries_are_imported_where_they_are_used(module: str) -> None:
    loaded = {name.split(".")[0] for name in imports(module, is_module_level_only=True)}
    assert not loaded & HEAVY


def test_every_module_says_what_it_is_for() -> None:
    missing = [m for m, path in MODULES.items() if not ast.get_docstring(ast.parse(path.read_text()))]
    assert missing == []


def test_no_module_is_a_drawer() -> None:
    drawers = {"utils", "util", "helpers", "helper", "common", "core", "misc", "main"}
    assert [m for m in MODULES if drawers & set(m.split("."))] == []


def test_rank_of_an_unknown_module_is_an_error() -> None:
    with pytest.raises(AssertionError, match="no place"):
        rank("edslam_ti.something_new")
