"""Who may import whom, read from the source: lower ranks, and what comes before in the same folder."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]

# Ranks from the bottom to the top. A name is a module of edslam_ti or a folder of it. Modules of one rank do
# not import each other, but for those in the order of ORDERS.
RANKS: list[list[str]] = [
    [
        *("kernels", "errors", "memory", "leftovers", "output", "cache"),
        *("open3d_loader", "ply_check", "mesh_reading", "cold_start", "interruption"),
        *("patient_console", "object_graph"),
    ],
    [
        "stage",
        "rgbd_config",
        "sensor_config",
        "config",
        "arguments",
        "geometry",
        "camera",
        "events",
        "tables",
    ],
    [
        *("trajectory", "truth", "journal", "depth_images", "lenses", "depth_reprojection", "ray_casting"),
        *("alignment", "simulation", "event_files"),
    ],
    ["datasets"],
    ["frame", "evaluation", "conversion"],
    ["event_images"],
    ["tracking", "mapping"],
    ["slam", "baselines", "viewer"],
    ["methods", "results"],
    ["inspection"],
    [
        *("frame_loop", "feeding", "session"),
        *("identity", "checkpoint", "pipeline", "command_line"),
    ],
    ["experiments", "live"],
    ["commands"],
    ["apps"],
]

# Inside a rank or a folder: files in the order of the data flow; each imports only those before it. Folders
# that are not listed may import freely inside, without a cycle.
ORDERS: dict[str, list[str]] = {
    "ranks": [
        *("errors", "memory", "leftovers", "output", "cache"),
        *("open3d_loader", "ply_check", "mesh_reading", "kernels", "cold_start", "interruption"),
        *("patient_console", "object_graph"),
        *(
            "stage",
            "rgbd_config",
            "sensor_config",
            "config",
            "arguments",
            "geometry",
            "camera",
            "events",
            "tables",
        ),
        *(
            "trajectory",
            "truth",
            "journal",
            "depth_images",
            "lenses",
            "depth_reprojection",
            "ray_casting",
            "alignment",
            "simulation",
            "event_files",
            "frame",
            "conversion",
        ),
        "evaluation",
        *("slam", "viewer", "baselines", "methods", "results", "frame_loop"),
        *("feeding", "session"),
        *("identity", "checkpoint", "pipeline"),
        "command_line",
    ],
    "event_images": [
        *("change", "noisy", "sums", "solve", "contrast", "sharp", "intervals", "dead_time", "sensor"),
        *("start_bias", "pixel_thresholds", "own_sensor"),
    ],
    "tracking": [
        *(
            "consistency",
            "tracker",
            "uncertainty",
            "surfaces",
            "patch_tracker",
            "keyframes",
            "segment",
            "depth_check",
            "first_image",
            "motion_prior",
            "smoothing",
            "gaps",
        ),
        *("place_recognition", "pose_graph", "loop_closure", "image_tracker"),
    ],
    "mapping": [
        *("gaussian_ply", "gaussians", "rendering", "losses", "volume", "mapper", "budget", "insertion"),
        *("keyframes", "densification", "recolouring", "targets", "poses", "shown_map", "gaussian_mapper"),
        *(
            "change_loss",
            "brightness_solve",
            "depth_solve",
            "pose_solve",
            "change_mapper",
            "paper_mapper",
            "event_only_mapper",
        ),
    ],
    "evaluation": ["trajectories", "conventions", "truth_notes", "lpips", "images", "meshes"],
    "results": [
        *("run", "trust", "run_folder", "reading", "export", "maps", "pictures", "page", "plots", "window"),
        *("views", "splat_file", "gltf", "camera_paths", "other_formats", "shown_run", "browse", "sensor"),
        *("metrics", "folder"),
    ],
    "feeding": ["intake", "cutter", "sequence", "inlet", "run"],
    "live": [
        *("items", "messages", "addresses", "recording", "connections", "folder", "cameras", "client"),
        *("warm_up", "loop"),
    ],
    "experiments": [
        *("cases", "selection", "recordings", "runs", "ablations", "report", "documents", "long_stream"),
        *("kernel_times", "front_end", "steps", "benchmark"),
        *("jobs", "scheduler", "published", "paper_options", "paper_plan", "table_text", "paper_tables"),
        *("paper_views", "paper_figures", "html_report", "paper_store", "paper", "long_runs"),
        *("sensor_statistics", "command"),
    ],
}

# Libraries that only some modules may import, besides numpy, torch and the standard library.
LIBRARIES: dict[str, list[str]] = {
    "taichi": ["kernels.engine", "kernels.taichi_speedups"],
    "open3d": ["open3d_loader"],
    "libusb_package": ["open3d_loader"],
    "pydantic": [
        *("experiments.paper_options", "commands"),
        *("stage", "rgbd_config", "sensor_config", "config"),
        "arguments",
        "checkpoint",
        "command_line",
        "simulation",
        "datasets",
        *("live", "commands.live"),
    ],
    "yaml": ["config", "datasets"],
    "scipy": [
        *("datasets", "trajectory", "truth", "journal", "simulation", "evaluation", "mapping", "results"),
        *("inspection", "viewer"),
    ],
    "cv2": [
        *(
            "alignment",
            "identity",
            "depth_images",
            "lenses",
            "event_files",
            "datasets",
            "conversion",
            *("feeding", "live"),
            "inspection",
            "simulation",
            "event_images",
            "tracking",
            "mapping",
        ),
        *("results", "viewer"),
    ],
    "OpenEXR": ["datasets"],
    "platformdirs": ["cache"],
    "evo": ["evaluation"],
    "skimage": ["evaluation"],
    "kiss_icp": ["baselines"],
    "small_gicp": ["baselines"],
    "lpips": ["evaluation"],
    "numba": ["experiments.kernel_times"],
    "dv_processing": ["experiments.kernel_times"],
    "matplotlib": ["results"],
    "h5py": ["event_files", "datasets", "experiments.front_end"],
    "hdf5plugin": ["event_files", "datasets", "experiments.front_end"],
    "rosbags": ["event_files"],
    "aedat": ["event_files"],
    "rich": [
        *("patient_console", "event_files", "datasets", "results", "feeding", "session", "pipeline"),
        *("experiments", "live", "commands"),
    ],
    "psutil": ["experiments.long_stream"],
    "ray": ["experiments.scheduler"],
    "viser": ["viewer.server"],
    "rerun": ["viewer.rerun_log"],
    "trimesh": ["results.shown_run"],
}
USES_OPEN3D = [
    "mesh_reading",
    *(
        "ray_casting",
        "simulation",
        "evaluation",
        "tracking.pose_graph",
        "mapping.insertion",
        "mapping.volume",
    ),
    *("baselines", "results", "viewer"),
]
# They take seconds to load, and a machine without a display or a GPU may lack what they need.
HEAVY = {
    "open3d",
    "kiss_icp",
    "small_gicp",
    "matplotlib",
    "evo",
    "skimage",
    "lpips",
    "rosbags",
    "h5py",
    "hdf5plugin",
    "aedat",
    "ray",
    "viser",
    "rerun",
    "trimesh",
}
DRAWERS = {"utils", "util", "helpers", "helper", "common", "core", "misc", "main"}
APP_LINES = 20  # a longer app is not thin any more


def source_files() -> dict[str, Path]:
    """Return our modules by name: edslam_ti's without `edslam_ti.`, apps as `apps.NAME`."""
    files = {}
    for path in sorted([*(ROOT / "edslam_ti").rglob("*.py"), *(ROOT / "kernels").glob("*.py")]):
        parts = list(path.relative_to(ROOT).with_suffix("").parts)
        parts = parts[1:] if parts[0] == "edslam_ti" else parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        files[".".join(parts) or "edslam_ti"] = path
    return files | {f"apps.{path.stem}": path for path in sorted((ROOT / "apps").glob("*.py"))}


MODULES = source_files()
TREES = {module: ast.parse(path.read_text()) for module, path in MODULES.items()}


def is_in(module: str, patterns: list[str]) -> bool:
    return any(module == p or module.startswith(p + ".") for p in patterns)


def rank(module: str) -> int | None:
    found = [r for r, row in enumerate(RANKS) if is_in(module, row)]
    return found[0] if len(found) == 1 else None


def place(module: str, order: str) -> int | None:
    """Return the place of a module in an order, None where it has none."""
    parts = module.split(".")
    name = parts[0] if order == "ranks" else parts[1] if len(parts) > 1 else ""
    return ORDERS[order].index(name) if name in ORDERS[order] else None


def imports(module: str, is_module_level_only: bool = False) -> set[str]:
    """Return what a module imports, also inside functions and TYPE_CHECKING blocks, as absolute names."""
    tree = TREES[module]
    names: set[str] = set()
    for node in iter(tree.body) if is_module_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            ours = {name for name in submodules if name.removeprefix("edslam_ti.") in MODULES}
            names |= ours if len(ours) == len(submodules) else ours | {node.module or "."}
    return names


def our_imports(module: str) -> set[str]:
    """Return the modules of ours that a module imports, itself excepted."""
    ours = {name.removeprefix("edslam_ti.") for name in imports(module)}
    return {name for name in ours if name in MODULES and name not in (module, "edslam_ti")}


def is_relative(module: str) -> bool:
    return any(isinstance(node, ast.ImportFrom) and node.level for node in ast.walk(TREES[module]))


def wrong_imports(module: str) -> Iterator[str]:
    """Yield which imports of ours break the ranks."""
    if is_relative(module):
        yield f"{module}: relative import; write the full name"
    own = rank(module)
    if module == "edslam_ti":  # its public names are loaded on demand
        return
    if own is None:
        yield f"{module} has no place in RANKS; decide its rank there and in the documents"
        return
    for name in our_imports(module):
        other = rank(name)
        if other is None or other > own:
            yield f"{module} (rank {own}) imports {name} (rank {other})"
        elif module.split(".")[0] != name.split(".")[0] and other == own:
            yield from _out_of_order(module, name, "ranks")
        elif module.split(".")[0] == name.split(".")[0] and module.split(".")[0] in ORDERS:
            yield from _out_of_order(module, name, module.split(".")[0])


def _out_of_order(module: str, name: str, order: str) -> Iterator[str]:
    own, other = place(module, order), place(name, order)
    if own is None or other is None:
        yield f"{module} imports {name}; ORDERS[{order!r}] does not say which comes first"
    elif other >= own:
        yield f"{module} imports {name}, which comes after it in ORDERS[{order!r}]"


def wrong_libraries(module: str) -> Iterator[str]:
    for name in imports(module):
        library = name.split(".")[0]
        if library in sys.stdlib_module_names or library in ("edslam_ti", "apps", "numpy", "torch", "."):
            continue
        if library not in LIBRARIES:
            yield f"{module} imports {library}, which has no place in LIBRARIES"
        elif not is_in(module, LIBRARIES[library]):
            yield f"{module} must not import {library}"
    if "open3d_loader" in our_imports(module) and not is_in(module, USES_OPEN3D):
        yield f"{module} must not use Open3D"
    heavy = {name.split(".")[0] for name in imports(module, is_module_level_only=True)} & HEAVY
    if heavy and module != "open3d_loader":
        yield f"{module} imports {heavy} at module level; import it where it is used"


def wrong_kernels(module: str) -> Iterator[str]:
    if not is_in(module, ["kernels"]):
        return
    if not all(is_in(name, ["kernels", "cache", "leftovers"]) for name in our_imports(module)):
        yield f"{module}: kernels know nothing of SLAM"
    if "__future__" in imports(module):
        yield f"{module}: Taichi rejects annotations that are strings"


def wrong_apps(module: str) -> Iterator[str]:
    if not is_in(module, ["apps"]):
        return
    source = MODULES[module].read_text()
    if len(source.splitlines()) >= APP_LINES:
        yield f"{module} is not thin any more: move what it does to edslam_ti"
    docstring = ast.get_docstring(TREES[module]) or ""
    if not docstring.startswith(f"python {module.replace('.', '/')}.py"):
        yield f"{module}: begin with the command"


def cycles() -> Iterator[str]:
    graph = {module: our_imports(module) for module in MODULES}
    while graph:
        leaves = {module for module, needed in graph.items() if not needed & graph.keys()}
        # Packages re-export their own parts, so a part may name its package in a cycle with itself only.
        leaves |= {
            m for m, needed in graph.items() if all(n.startswith(m + ".") for n in needed & graph.keys())
        }
        if not leaves:
            yield f"import cycle among {sorted(graph)}"
            return
        graph = {module: needed for module, needed in graph.items() if module not in leaves}


def test_house_is_in_order() -> None:
    problems = [
        problem
        for module in MODULES
        for check in (wrong_imports, wrong_libraries, wrong_kernels, wrong_apps)
        for problem in check(module)
    ]
    problems += cycles()
    problems += [
        f"{m} does not say what it is for" for m, tree in TREES.items() if not ast.get_docstring(tree)
    ]
    problems += [f"{m} is a drawer" for m in MODULES if DRAWERS & set(m.split("."))]
    assert problems == []


def test_a_module_without_a_place_is_found() -> None:
    assert rank("something_new") is None
    assert rank("mapping.something") == rank("tracking.something")
