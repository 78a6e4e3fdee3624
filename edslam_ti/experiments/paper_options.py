"""Options of the commands that make the paper's tables."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from edslam_ti.config import Stage
from edslam_ti.sensor_config import DepthSensorName, SensorName


class LongOptions(Stage):
    """Walks through the flat, methods, and where they run."""

    cases: tuple[str, ...] = ("minute", "five_minutes", "moving")
    """minute, five_minutes, and moving: a minute with an object that moves in view."""
    methods: tuple[str, ...] = ("ed_slam", "open3d_icp")
    """Methods to compare."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of every random choice, of path and noise."""
    depth: str = "kinect"
    """Depth: exact or kinect."""
    duration: float | None = Field(None, gt=0)
    """Seconds of every case instead of its own."""
    width: int = Field(240, ge=80)
    """Of the images, pixels; 384 take four times as long to simulate."""
    height: int = Field(150, ge=60)
    """Of the images, pixels."""
    out: Path = Path("results/long")
    """Folder that receives long.md, long.tex, drift-CASE.png, report.html, and a folder per run."""
    jobs: int = Field(1, ge=1, le=256)
    """Runs side by side."""
    ray: str | None = None
    """Address of a Ray cluster to run on, or local to start one here; needs the extra ray."""
    config: Path | None = None
    """YAML file with settings that differ from every method's own."""
    fresh: bool = False
    """Repeat runs that have finished."""
    threads: int = Field(2, ge=1, le=256)
    """CPU threads of each run; results depend on their number."""


class PaperOptions(Stage):
    """Recordings, methods, and where they run."""

    scenes: tuple[str, ...] = ("all",)
    """all: the paper's nine, as built-in rooms and as recordings where they are there (of tables 1 and 2:
    office0); or names of rooms and recordings."""
    methods: tuple[str, ...] = ()
    """Methods to compare; none: all. Tables 1 and 2 are of ed_slam_paper."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of every random choice, in built-in rooms of path and noise, too."""
    depth: tuple[str, ...] = ("exact",)
    """Depth of built-in rooms: exact, kinect."""
    rates: tuple[float, ...] = (20.0,)
    """Depth images per second of built-in rooms."""
    sensor: tuple[SensorName, ...] = ("ideal",)
    """Event sensors of built-in rooms (docs/sensors.md); several are shown side by side."""
    depth_sensor: tuple[DepthSensorName, ...] = ("exact",)
    """Their depth sensors; any but exact measures at its own rate, whatever `depth` and `rates` say."""
    datasets: tuple[str, ...] = ()
    """Formats of recordings, builtin for the rooms; none: the rooms, and what lies in --data-dir."""
    duration: float | None = Field(None, gt=0)
    """Seconds of each; omitted: 2.5 of a room, all of a recording."""
    data_dir: Path = Path("data")
    """Folder that holds recordings: event_replica/NAME, vector/NAME or NAME."""
    out: Path = Path("results/paper")
    """Folder that receives the tables (.md, .tex), figures, report.html, and a folder per run. Runs that have
    finished there are not repeated."""
    jobs: int = Field(1, ge=1, le=256)
    """Runs side by side. They give the same numbers, but take time from each other."""
    ray: str | None = None
    """Address of a Ray cluster to run on, or local to start one here; needs the extra ray."""
    config: Path | None = None
    """YAML file with settings that differ from every method's own."""
    lpips_weights: Path | None = None
    """Weights for LPIPS, as --evaluation.lpips-weights of edslam slam."""
    fresh: bool = False
    """Repeat runs that have finished."""
    store: Path | None = None
    """Checkout whose docs/results also receives the tables; `edslam reproduce report` shows them in docs/."""
    threads: int = Field(2, ge=1, le=256)
    """CPU threads of each run; results depend on their number."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the kernels run."""
