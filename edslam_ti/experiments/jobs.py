"""A whole run of a method on a recording, as one job: it ends with a folder that holds its result.

A job runs in a process of its own, so that its memory is its own and what ends it ends nothing else. Its
folder holds result.json once it has finished; without that it starts again.
"""

import contextlib
import fcntl
import functools
import hashlib
import json
import os
import shutil
import subprocess
import sys
import textwrap
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import edslam_ti
from edslam_ti import __version__
from edslam_ti.cache import cached
from edslam_ti.config import Config, dataset_differences
from edslam_ti.errors import EdSlamError
from edslam_ti.methods import METHODS
from edslam_ti.output import atomic_file
from edslam_ti.sensor_config import (
    DEPTH_PRESETS,
    PRESETS,
    DepthSensorConfig,
    DepthSensorName,
    SensorConfig,
    SensorName,
)

EXACT, KINECT, RECORDED = "exact", "kinect", "recorded"  # kinds of depth; recorded: as it is in the data
BUILTIN_RATE = 20.0  # depth images per second of built-in recordings
RESULT, OUTPUT = "result.json", "output.txt"
WORK = "work"  # what a run writes before it is chosen from
KEPT = (
    *("metrics.json", "config.yaml", "log.txt", "poses.csv", "trajectory_tum.txt", "truth_tum.txt"),
    "trajectory_frontend_tum.txt",
    "trajectory.png",
)
ADDED = (
    "path",
    "moving_object",
    "size",
    "sensor",
    "depth_sensor",
)  # fields that were added when there were results already
KEPT_VIEWS = 3  # pictures of held-out views
MAPS = ("map.ply", "points.ply")  # the first that there is states the size of the map
LONGEST_MESSAGE = 300  # characters; compilers write long messages
CHILD = """
import sys
from edslam_ti.cold_start import load_kernels
load_kernels()
from edslam_ti.experiments.jobs import child
child(*sys.argv[1:])
"""

# What result.json holds: the job, and `metrics`, or an `error`, or why it was `skipped`.
Outcome = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """Everything that the numbers of a run depend on, but for the program and the machine."""

    dataset: str  # key of FORMATS
    scene: str
    method: str
    seed: int = 0  # of every random choice; of built-in recordings also of path and noise
    depth: str = EXACT
    rate: float = BUILTIN_RATE  # depth images per second; recorded data keep their own
    duration: float | None = None  # seconds; None: 2.5 of a built-in room, all of a recording
    differences: str = "{}"  # settings that differ from the method's own, as JSON
    data_dir: str = "data"  # folder of the recordings
    threads: int = 2
    device: str = "cpu"
    path: str = "hand_held"  # of a built-in recording; the following, too
    moving_object: bool = False
    size: tuple[int, int] | None = None  # pixels; None: the sensor's, 384 x 240 of most
    sensor: SensorName = "ideal"
    depth_sensor: DepthSensorName = "exact"  # another one measures at its own rate

    @property
    def data(self) -> str:
        """What the run's numbers are from, in words."""
        if self.dataset == "builtin":
            length = 2.5 if self.duration is None else self.duration
            words = ["simulated flat" if self.path == "tour" else "simulated room"]
            words.append(f"{self._depth_in_words} Hz, {length:g} s")
            if self.path not in ("hand_held", "tour"):
                words.append(self.path)
            if self.sensor != "ideal":
                words.append(f"sensor {self.sensor}")
            size = self.size or PRESETS[self.sensor].size
            if size is not None:
                words.append("{}x{}".format(*size))
            return ", ".join([*words, *(["moving object"] if self.moving_object else [])])
        length_text = "" if self.duration is None else f", first {self.duration:g} s"
        return f"recording ({self.dataset}){length_text}"

    @property
    def _depth_in_words(self) -> str:
        if self.depth_sensor != "exact":
            return f"{self.depth_sensor} depth {DEPTH_PRESETS[self.depth_sensor].rate or self.rate:g}"
        return f"{'exact' if self.depth == EXACT else 'Kinect-like'} depth {self.rate:g}"

    @property
    def name(self) -> str:
        """The job's folder, below the folder of all: readable, and another for every other job."""
        depth = self.depth if self.depth_sensor == "exact" else self.depth_sensor
        rate = DEPTH_PRESETS[self.depth_sensor].rate or self.rate
        kind = f"{depth}-{rate:g}hz" if self.dataset == "builtin" else RECORDED
        kind = kind if self.sensor == "ideal" else f"{self.sensor}-{kind}"
        facts = {name: value for name, value in asdict(self).items() if self._counts(name)}
        if self.dataset == "builtin":
            del facts["data_dir"]
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:8]
        return f"{self.dataset}-{self.scene}-{kind}/{self.method}-seed{self.seed}-{digest}"

    def _counts(self, name: str) -> bool:
        """Return whether a field is part of the name: those added later only where they differ."""
        return name not in ADDED or getattr(self, name) != type(self).__dataclass_fields__[name].default

    def settings(self, out: Path) -> Config:
        """Return the settings of the run, as the command `edslam slam` would make them."""
        is_builtin = self.dataset == "builtin"
        config = Config(
            scene=self.scene,
            dataset=self.dataset,
            data_dir=Path(self.data_dir),
            method=self.method,
            duration=None if is_builtin else self.duration,
            out=out,
            checkpoint=0.0,  # a run that was cut off starts again
            seed=self.seed,
            threads=self.threads,
            device=self.device,
            sensor=SensorConfig(preset=self.sensor),
            depth_sensor=DepthSensorConfig(preset=self.depth_sensor),
        )
        config = config.updated(dataset_differences(self.dataset))
        config = config.updated(dict(METHODS[self.method].overrides))
        return config.updated(json.loads(self.differences))


def job_of(values: Outcome) -> Job:
    """Return a job from its fields as JSON has them."""
    size = values.get("size")
    return Job(**{**values, "size": None if size is None else (int(size[0]), int(size[1]))})


# --- one run ---


def execute(job: Job, folder: Path, at_once: int = 1) -> Outcome:
    """Run a job in this process; its folder receives what is kept of the run, and result.json at last.

    What keeps it from running is its result: `error`, or `skipped` where data or a library is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    outcome = _or_problem(partial(_run, job, folder))
    shutil.rmtree(folder / WORK, ignore_errors=True)
    outcome = {**about(job), **outcome, "seconds": round(time.perf_counter() - started, 2)}
    outcome["at_once"] = at_once  # runs that shared the machine
    with atomic_file(folder / RESULT) as temporary:
        temporary.write_text(json.dumps(outcome, indent=1) + "\n")
    return outcome


def about(job: Job) -> Outcome:
    """Return what is known of a job before it runs."""
    return {
        "job": asdict(job),
        "name": job.name,
        "data": job.data,
        "version": __version__,
        "commit": source_commit(),
        "tracking": job.settings(Path()).tracking.model_dump(mode="json"),
    }


@functools.cache
def source_commit() -> str:
    """Return the commit of the checkout that this program is; its version where it is an installed one."""
    source = Path(edslam_ti.__file__).parents[1]
    if not (source / ".git").exists():  # an installed package may lie in somebody else's checkout
        return f"version {__version__}"
    command = ["git", "-C", str(source), "rev-parse", "--short=7", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return f"version {__version__}"
    return done.stdout.strip()


def _run(job: Job, folder: Path) -> Outcome:
    from rich.console import Console

    from edslam_ti.experiments.kernel_times import processor
    from edslam_ti.pipeline import run

    config = job.settings(folder / WORK)
    path = run(config, Console(file=sys.stdout, width=110), partial(_opened, job))
    metrics = json.loads((path / "metrics.json").read_text())
    map_bytes = next(((path / name).stat().st_size for name in MAPS if (path / name).is_file()), None)
    for name in KEPT:
        if (path / name).is_file():
            (path / name).replace(folder / name)
    _keep_views(path / "renders", folder / "renders")
    return {
        "metrics": metrics,
        "poses": config.poses,
        "map_mb": None if map_bytes is None else round(map_bytes / 1e6, 2),
        "processor": processor(),
    }


def _keep_views(renders: Path, kept_in: Path) -> None:
    """Move the numbers of all views, and the pictures of a few held-out ones spread evenly over the run."""
    if not (renders / "views.csv").is_file():  # no map, or nothing to compare it with
        return
    kept_in.mkdir()
    held_out = sorted(path for path in renders.glob("*.png") if path.stem.isdigit())
    places = [round((k + 0.5) * len(held_out) / KEPT_VIEWS - 0.5) for k in range(KEPT_VIEWS)]
    chosen = {held_out[min(max(k, 0), len(held_out) - 1)] for k in places} if held_out else set()
    for path in (renders / "views.csv", *sorted(chosen)):
        path.replace(kept_in / path.name)


def _opened(job: Job, config: Config, console: Any) -> Any:
    """Open a job's recording, made first where it is a built-in room's that is not there yet."""
    from edslam_ti.datasets import open_sequence
    from edslam_ti.datasets.altered import AlteredSequence
    from edslam_ti.datasets.builtin import BuiltinSequence, builtin_sequence_folder
    from edslam_ti.simulation import SimulationConfig

    if job.dataset != "builtin":
        return open_sequence(config)
    differences: dict[str, Any] = {} if job.duration is None else {"duration": job.duration}
    if job.size is not None:
        differences |= {"width": job.size[0], "height": job.size[1]}
    settings = SimulationConfig(
        seed=job.seed, path=job.path, moving_object=job.moving_object, sensor=config.sensor,
        depth_sensor=config.depth_sensor, **differences,
    )  # fmt: skip
    with locked(cached(Path("sequences")) / f".{job.scene}.lock"):  # another job may be making it now
        made = builtin_sequence_folder(job.scene, settings, lambda share: None)
    sequence = BuiltinSequence(made)
    if job.depth == EXACT and job.rate == BUILTIN_RATE:
        return sequence
    noise = "kinect" if job.depth == KINECT else "none"
    return AlteredSequence(sequence, noise, job.rate, seed=job.seed)


def _or_problem(action: Callable[[], Outcome]) -> Outcome:
    try:
        return action()
    except (FileNotFoundError, ModuleNotFoundError) as missing:
        return {"skipped": textwrap.shorten(str(missing), LONGEST_MESSAGE)}
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = "" if isinstance(error, EdSlamError) else f" ({Path(where.filename).name}:{where.lineno})"
        kind = "" if isinstance(error, EdSlamError) else f"{type(error).__name__}: "
        return {"error": f"{kind}{textwrap.shorten(str(error), LONGEST_MESSAGE)}{place}"}


# --- finished runs ---


def kept(folder: Path) -> Outcome | None:
    """Return the result of a job that has finished; None: it has not, or it failed or was skipped."""
    try:
        outcome: Outcome = json.loads((folder / RESULT).read_text())
    except (OSError, ValueError):
        return None
    return outcome if "metrics" in outcome else None


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock file that one process has at a time; wait for it. A process that ends lets go of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


# --- a process of its own ---


def start(job: Job, folder: Path, at_once: int) -> "subprocess.Popen[bytes]":
    """Start a job in a new process, which ends when this one does.

    Threads are set by its environment, so that every way to run it gives the same bits.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    source = str(Path(edslam_ti.__file__).parents[1])
    paths = [source, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": str(job.threads)}
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, json.dumps(asdict(job)), str(folder), str(at_once)],
        env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is its parent's to handle
    )  # fmt: skip


def child(job_text: str, folder_text: str, at_once: str) -> None:
    """Run a job in this process, which ends with its parent: that has the other end of stdin."""
    job, folder = job_of(json.loads(job_text)), Path(folder_text)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with locked(folder.with_name(f".{folder.name}.lock")):
        if kept(folder) is not None:  # another process has finished it meanwhile
            return
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        output = (folder / OUTPUT).open("w", buffering=1)
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
        execute(job, folder, int(at_once))


def _end_with_parent() -> None:
    while os.read(0, 1):  # until the parent closes it or dies; sys.stdin would be locked at exit
        pass
    os._exit(1)


def outcome_of(job: Job, folder: Path, code: int) -> Outcome:
    """Return the result of a process that has ended with this exit code, also where it left none."""
    with contextlib.suppress(OSError, ValueError):
        outcome: Outcome = json.loads((folder / RESULT).read_text())
        return outcome
    lines = [""]
    with contextlib.suppress(OSError):
        lines = (folder / OUTPUT).read_text(errors="replace").strip().splitlines() or [""]
    how = f"signal {-code}" + (" (out of memory?)" if code == -9 else "") if code < 0 else f"exit code {code}"
    message = textwrap.shorten(f"the process ended with {how}; {lines[-1]}", LONGEST_MESSAGE)
    return {**about(job), "error": message.removesuffix(";")}
