"""Runs jobs in turn, several side by side, or on a cluster through Ray; finished ones are not repeated."""

import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import TimeElapsedColumn

from edslam_ti.errors import ConfigError, MissingExtraError, plain
from edslam_ti.experiments.jobs import RESULT, Job, Outcome, job_of, kept, outcome_of, source_commit, start
from edslam_ti.output import atomic_file
from edslam_ti.patient_console import progress_bar

Work = tuple[Job, Path]  # a job and its folder
Finished = tuple[Job, Outcome]
Executor = Callable[[Sequence[Work], Callable[[str], None]], Iterator[Finished]]  # also reports what runs now
POLL = 0.1  # seconds between looks at running processes
ANSWER = 5.0  # seconds that a cluster may take to answer
MEMORY = 3 * 2**30  # bytes that a run may take
LOCAL = "local"  # address of a Ray that is started on this machine


def run_jobs(
    jobs: Sequence[Job], out: Path, executor: Executor, console: Console, fresh: bool = False
) -> Iterator[Outcome]:
    """Yield the result of every job, finished ones first, then each as it finishes.

    A job whose folder below `out` holds a result is not repeated, unless `fresh`. Failed and skipped ones
    are tried again.
    """
    jobs = list(dict.fromkeys(jobs))
    todo: list[Work] = []
    done, others = 0, 0
    for job in jobs:
        folder = out / "runs" / job.name
        if fresh:
            shutil.rmtree(folder, ignore_errors=True)
        outcome = kept(folder)
        if outcome is None:
            todo.append((job, folder))
        else:
            done += 1
            others += outcome.get("commit") != source_commit()
            yield outcome
    if others:
        console.print(
            f"{others} of {done} finished runs are of another version of the program; --fresh repeats all",
            highlight=False, soft_wrap=True,
        )  # fmt: skip
    if not todo:
        return
    with progress_bar(console, TimeElapsedColumn()) as bar:
        task = bar.add_task("runs", total=len(jobs), completed=done, status="")
        for _, outcome in executor(todo, lambda status: bar.update(task, status=status)):
            bar.advance(task)
            console.print(describe(outcome), highlight=False, markup=False, soft_wrap=True)
            yield outcome


def describe(outcome: Outcome) -> str:
    """Return a result in one line."""
    name = outcome["name"]
    for problem in ("error", "skipped"):
        if problem in outcome:
            return f"{name}: {problem}: {plain(outcome[problem], 400)}"
    metrics = outcome["metrics"]

    def show(key: str, unit: str, digits: int) -> str:
        value = metrics.get(key)
        return "-" if value is None else f"{value:.{digits}f} {unit}"

    return (
        f"{name}: ATE {show('ate_rmse_cm', 'cm', 3)}, PSNR {show('psnr_corrected_db', 'dB', 2)}, "
        f"{metrics['num_lost_frames']} of {metrics['num_frames']} frames lost, {outcome['seconds']:.0f} s"
    )


# --- on this machine ---


def in_processes(at_once: int) -> Executor:
    """Return an executor that keeps so many processes busy; they end when this one does."""
    return partial(_in_processes, at_once)


def _in_processes(at_once: int, todo: Sequence[Work], report: Callable[[str], None]) -> Iterator[Finished]:
    waiting = list(todo)
    running: list[tuple[Job, Path, subprocess.Popen[bytes], float]] = []
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                job, folder = waiting.pop(0)
                running.append((job, folder, start(job, folder, at_once), time.monotonic()))
            ended = [entry for entry in running if entry[2].poll() is not None]
            for entry in ended:
                running.remove(entry)
                job, folder, process, _ = entry
                yield job, outcome_of(job, folder, process.returncode)
            now = time.monotonic()
            report(", ".join(f"{job.scene} {job.method} {now - began:.0f} s" for job, _, _, began in running))
            if not ended:
                time.sleep(POLL)
    finally:  # Ctrl-C: what runs now starts again next time
        for _, _, process, _ in running:
            process.kill()
            process.wait()


# --- on a cluster ---


def on_ray(address: str) -> Executor:
    """Return an executor that makes each job a task of a Ray cluster; "local" starts one on this machine.

    The package must be installed on every worker, and recorded data must be there under the same path;
    recordings of built-in rooms are made there on first use. Raises MissingExtraError without Ray.
    """
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("--ray: Ray is not installed; pip install 'edslam-ti[ray]'") from error
    return partial(_on_ray, address)


def _on_ray(address: str, todo: Sequence[Work], report: Callable[[str], None]) -> Iterator[Finished]:
    import ray

    _check_address(address)
    try:
        ray.init(address=None if address == LOCAL else address, include_dashboard=False, log_to_driver=False)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise ConfigError(f"--ray {address}: no cluster there ({error}); 'local' starts one") from error
    try:
        _check_resources(ray.nodes(), [job for job, _ in todo])
        task = ray.remote(_task)
        cores = max(node.get("Resources", {}).get("CPU", 1) for node in ray.nodes())
        pending: dict[Any, Work] = {}
        for job, folder in todo:
            wanted = resources(job)
            pending[task.options(**wanted).remote(asdict(job), max(1, int(cores // job.threads)))] = (
                job,
                folder,
            )
        while pending:
            report(f"{len(pending)} tasks on {len(ray.nodes())} nodes")
            ready, _ = ray.wait(list(pending), timeout=1.0)
            for reference in ready:
                job, folder = pending.pop(reference)
                get: Callable[[], Any] = partial(ray.get, reference)
                yield job, _gathered(job, folder, get)
    finally:
        ray.shutdown()


def _check_address(address: str) -> None:
    """Refuse an address at which nothing answers: Ray would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():  # local, auto, or what Ray knows
        return
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"--ray {address}: nothing answers there ({error}); start a cluster with `ray start --head`, or "
            "use --ray local"
        ) from error


def resources(job: Job) -> dict[str, float]:
    """Return what a job takes of a worker, as Ray's options of a task."""
    return {"num_cpus": job.threads, "num_gpus": 1 if job.device == "cuda" else 0, "memory": MEMORY}


def _check_resources(nodes: Sequence[dict[str, Any]], jobs: Sequence[Job]) -> None:
    """Refuse jobs that no worker could ever run: Ray would wait for one without end."""
    offered = [node.get("Resources", {}) for node in nodes if node.get("Alive", True)]
    names = {"num_cpus": "CPU", "num_gpus": "GPU", "memory": "memory"}
    for job in jobs:
        wanted = {names[key]: value for key, value in resources(job).items()}
        if not any(all(node.get(key, 0) >= value for key, value in wanted.items()) for node in offered):
            best = {key: max((node.get(key, 0) for node in offered), default=0) for key in wanted}
            what = ", ".join(
                f"{key} {value:g} (at most {best[key]:g} there)" for key, value in wanted.items()
            )
            raise ConfigError(f"--ray: no worker can run {job.method}: expected one with {what}")


def _task(values: dict[str, Any], at_once: int) -> dict[str, bytes]:
    """Run a job on a worker, in a process of its own; return the files of its folder."""
    job = job_of(values)
    with tempfile.TemporaryDirectory(prefix="edslam-") as parent:
        folder = Path(parent) / job.name
        process = start(job, folder, at_once)
        try:
            code = process.wait()
        finally:
            process.kill()
        files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        return {**files, "exit_code": str(code).encode()}


def _gathered(job: Job, folder: Path, get: Callable[[], dict[str, bytes]]) -> Outcome:
    """Write the files that a task returned into the job's folder; return its result, or what ended it."""
    import ray

    shutil.rmtree(folder, ignore_errors=True)
    try:
        files = get()
    except ray.exceptions.RayError as error:
        first = str(error).strip().splitlines() or [type(error).__name__]
        return outcome_of(job, folder, 1) | {"error": plain(f"Ray: {first[0]}", 300)}
    code = int(files.pop("exit_code"))
    # The result comes last: a folder with a result is a finished one.
    for name, content in sorted(files.items(), key=lambda item: item[0] == RESULT):
        with atomic_file(folder / name) as temporary:
            temporary.write_bytes(content)
    return outcome_of(job, folder, code)
