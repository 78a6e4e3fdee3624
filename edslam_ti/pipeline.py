"""A whole run: sequence in, results folder out, with progress, numbers and pictures on the way."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from edslam_ti import kernels
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, SampledSequence, find_sequence, open_sequence
from edslam_ti.errors import DataError, EdSlamError
from edslam_ti.evaluation.trajectories import ate_rmse_cm
from edslam_ti.event_images.contrast import ContrastThreshold, contrast_threshold
from edslam_ti.frame import FrameBuilder
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.memory import release_free_memory
from edslam_ti.methods import METHODS
from edslam_ti.results.folder import save
from edslam_ti.results.run import Run
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import Tracker, TruePoses
from edslam_ti.truth import true_path
from edslam_ti.viewer import VIEWERS, Viewer

ATE_EVERY = 10  # frames between updates of the error on the progress bar


def run(config: Config, console: Console | None = None) -> Path:
    """Run a method on a sequence and return the results folder.

    Ctrl-C ends the loop early; what there is, is saved, then KeyboardInterrupt is raised.
    """
    config.require_device()
    console = console or Console()
    try:
        kernels.init(config.device, threads=config.threads)
    except RuntimeError as error:  # no such device
        raise EdSlamError(str(error)) from error
    viewer = VIEWERS["open3d" if config.visualize else "none"]()
    state = _prepare(config)
    camera, (first, last) = state.sequence.camera, state.samples.timestamps[[0, -1]]
    state.note(f"{state.sequence.scene}: {state.sequence.description}, method {config.method}")
    console.print(
        f"[bold]{state.sequence.scene}[/bold]: {state.sequence.description}\n"
        f"{camera.width}x{camera.height}, {last - first:.2f} s, {len(state.samples)} frames, "
        f"method {config.method} on {config.device}"
    )
    with _deferred_interrupt() as interrupt:
        _process(state, interrupt, viewer, console)
        if state.slam.mapper is not None and not interrupt.requested:
            _finish(state, state.slam.mapper, interrupt, console)
        state.is_interrupted = interrupt.requested
    if state.is_interrupted and len(state.slam.trajectory) == 0:
        raise KeyboardInterrupt  # there is nothing to save
    if state.is_interrupted:
        console.print("interrupted: saving what there is")
        state.note("interrupted")
    folder = save(state, console)
    viewer.close()
    console.print(f"results: {folder}")
    if state.is_interrupted:
        raise KeyboardInterrupt  # everything is saved; the exit code still says what happened
    return folder


def _prepare(config: Config) -> Run:
    sequence = open_recording(config)
    samples = SampledSequence(sequence, config.start, config.duration, config.max_interval)
    contrast = contrast_of(config, sequence, samples)
    return Run(
        config,
        sequence,
        samples,
        make_slam(config, sequence, samples, contrast),
        held_out_frames(samples, config.evaluation.hold_out_every),
        contrast,
    )


def open_recording(config: Config) -> EventDepthSequence:
    """Open the scene that the settings name; without --dataset, print which one that turned out to be."""
    if config.dataset is None:
        folder = find_sequence(config).folder
        where = (
            f"the recording in {folder}" if folder else f"none in {config.data_dir}, so the built-in stand-in"
        )
        print(f"scene {config.scene}: {where}", flush=True)
    return open_sequence(config)


def make_slam(
    config: Config, sequence: EventDepthSequence, samples: SampledSequence, contrast: ContrastThreshold
) -> Slam:
    """Return the method that the settings name, ready to start at the first sample's true pose."""
    tracker: Tracker
    tracker, mapper = METHODS[config.method].build(sequence, contrast, config)
    if config.poses == "truth":
        if sequence.truth is None:
            raise DataError(f"{sequence.scene}: --poses truth needs true poses, and this sequence has none")
        tracker = TruePoses(sequence.true_pose, true_path(sequence.truth).likely_pose_at)
    truth = sequence.true_pose(float(samples.timestamps[0]))
    return Slam(
        FrameBuilder(sequence.camera),
        tracker,
        mapper if config.mapping.enabled else None,
        initial_pose=np.eye(4) if truth is None else truth,
    )


def contrast_of(config: Config, sequence: EventDepthSequence, samples: SampledSequence) -> ContrastThreshold:
    """Return the contrast threshold of a run, with its source."""
    first, last = (float(t) for t in samples.timestamps[[0, -1]])
    return contrast_threshold(config.contrast_threshold, sequence, first, last)


def held_out_frames(samples: SampledSequence, every: int) -> set[int]:
    """Return the indices of every n-th frame with depth, from the middle of the first n on."""
    with_depth = np.nonzero(samples.has_depth)[0]
    return {int(k) for k in with_depth[every // 2 :: every]}


# --- the loop ---


class _Interrupt:
    requested = False


@contextmanager
def _deferred_interrupt() -> Iterator[_Interrupt]:
    """Let Ctrl-C end the loop between two steps, so that nothing half-done is saved; twice: at once."""
    interrupt = _Interrupt()

    def request(number: int, frame: FrameType | None) -> None:
        if interrupt.requested:
            raise KeyboardInterrupt
        interrupt.requested = True

    try:
        previous = signal.signal(signal.SIGINT, request)
    except ValueError:  # not the main thread: Ctrl-C is someone else's
        yield interrupt
        return
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, previous)


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[status]}"),
        console=console,
    )


def _process(state: Run, interrupt: _Interrupt, viewer: Viewer, console: Console) -> None:
    slam, mapper = state.slam, state.slam.mapper
    with _progress(console) as bar:
        task = bar.add_task("mapping" if mapper else "tracking", total=len(state.samples), status="")
        ate = ""
        for k, sample in enumerate(state.samples):
            if interrupt.requested:
                break
            # With true poses, a frame where the truth has a hole is kept from the map.
            has_no_pose = state.config.poses == "truth" and sample.T_world_camera is None
            result = slam.process(sample, is_held_out=has_no_pose or k in state.held_out)
            if mapper is not None:
                release_free_memory()  # arrays of ever other sizes come and go while mapping
            state.num_events += len(sample.events)
            if not result.converged:
                state.note(f"frame {k} at {sample.timestamp:.3f} s lost: {result.message}")
            elif result.message:
                state.note(f"frame {k} at {sample.timestamp:.3f} s: {result.message}")
            if k % ATE_EVERY == 0 and state.sequence.truth is not None:
                error = ate_rmse_cm(slam.trajectory, state.sequence.truth)
                ate = "" if error is None else f"  ATE {error:.2f} cm"
            hertz = len(slam.results) / (slam.tracking_seconds + slam.mapping_seconds)
            status = f"{hertz:.1f} Hz"
            if mapper is not None:
                status += f"  {mapper.num_gaussians} Gaussians  loss {mapper.loss:.3f}"
            bar.update(task, advance=1, status=status + ate)
            viewer.update(slam.trajectory, mapper, state.sequence.camera)


def _finish(state: Run, mapper: Mapper, interrupt: _Interrupt, console: Console) -> None:
    started = time.perf_counter()
    with _progress(console) as bar:
        task = bar.add_task("refining", total=100, status="")

        def report(fraction: float) -> bool:
            bar.update(task, completed=int(100 * fraction), status=f"loss {mapper.loss:.3f}")
            return not interrupt.requested

        mapper.finish(state.slam.trajectory, report)
        bar.update(task, completed=100)
    state.finish_seconds = time.perf_counter() - started
