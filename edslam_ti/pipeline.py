"""A whole run: sequence in, results folder out, with progress, numbers and pictures on the way.

Nothing is lost on the way. The folder is made before the first frame, and every pose goes into its journal
at once, and its state into a checkpoint now and then. Whatever ends the run early, the path and the map so
far are saved.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import TimeRemainingColumn
from rich.text import Text

from edslam_ti import kernels
from edslam_ti.checkpoint import Keeper
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence, Sample, SampledSequence, find_sequence, open_sequence
from edslam_ti.errors import DataError, EdSlamError, plain
from edslam_ti.evaluation.lpips import load_lpips
from edslam_ti.evaluation.trajectories import ate_rmse_cm
from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.own_sensor import own_sensor
from edslam_ti.event_images.sensor import SensorEstimate
from edslam_ti.frame import FrameBuilder
from edslam_ti.frame_loop import is_held_out, process_sample, speed_text, told
from edslam_ti.identity import compare, identity_of
from edslam_ti.inspection.calibration import aligned, calibrate_depth
from edslam_ti.interruption import Interruption, Stopped, signals_handled
from edslam_ti.journal import JOURNAL, Journal
from edslam_ti.mapping.mapper import Mapper
from edslam_ti.mesh_reading import read_triangle_mesh
from edslam_ti.methods import METHODS
from edslam_ti.patient_console import patient_console, progress_bar, say
from edslam_ti.results.folder import save
from edslam_ti.results.run import Run
from edslam_ti.results.run_folder import FAILED, INTERRUPTED, RUNNING, SETTINGS, RunFolder, point_latest_to
from edslam_ti.slam import Slam
from edslam_ti.tracking.tracker import Tracker, TruePoses
from edslam_ti.truth import true_path
from edslam_ti.viewer import Moment, Viewer, make_viewers

ATE_EVERY = 10  # frames between updates of the error on the progress bar
Opener = Callable[[Config, Console], EventDepthSequence]
MOST_UNREADABLE = 10  # frames in a row of which something cannot be read: the recording is damaged


@dataclass
class _Session:
    """What a run writes to while it goes on."""

    folder: RunFolder
    journal: Journal
    keeper: Keeper
    interruption: Interruption
    viewer: Viewer
    console: Console


def run(config: Config, console: Console | None = None, open_with: Opener | None = None) -> Path:
    """Run a method on a sequence and return the results folder.

    `open_with` opens the recording in another way than by the settings' scene and data set.
    A signal (Ctrl-C, SIGTERM, SIGHUP) ends it early. What there is then, or when an exception ends it, is
    saved; then `Stopped`, which is a KeyboardInterrupt, or the exception is raised. An exception that is no
    input's fault becomes an `EdSlamError` of one line, and log.txt has its traceback.
    """
    config.require_device()
    console = console or patient_console()
    with signals_handled() as interruption:
        folder = RunFolder.make(_parent(config))
        state: Run | None = None
        try:
            folder.write(SETTINGS, config.to_yaml())
            folder.set_state(RUNNING)
            viewer, state = _prepare(config, console, open_with or open_recording)
            folder.identity = identity_of(config)
            folder.set_state(RUNNING)
            journal = Journal(folder.path / JOURNAL, state.sequence.time_offset)
            keeper = Keeper(state, folder.checkpoints, config.checkpoint)
            _run(state, _Session(folder, journal, keeper, interruption, viewer, console))
        finally:
            folder.close()
            if state is None or len(state.slam.trajectory) == 0:
                folder.discard()
    return folder.path


def resume(path: Path, config: Config, console: Console | None = None) -> Path:
    """Go on with a run that was cut off, in its folder, and return that.

    `config` holds the settings of its config.yaml; only those that change no result, as `checkpoint` and
    `viewer`, may differ. Trajectory and map come out as if the run had not been cut off: its last checkpoint
    is restored, and the frames since then are processed again. Raises what `run` raises, and DataError where
    the run has finished, where another process is at it, or where the recording or the program have changed.
    """
    console = console or patient_console()
    with signals_handled() as interruption:
        folder = RunFolder.reopen(path)
        try:
            viewer, state = _prepare(config, console, open_recording)
            identity, notes = identity_of(config), list[str]()
            if folder.identity:  # else it was cut off before there was anything to depend on
                notes += compare(folder.identity, identity, folder.path)
            folder.identity = folder.identity or identity
            if config.mapping.budget is not None:
                notes.append("mapping.budget depends on the machine's speed: results will differ")
            keeper = Keeper(state, folder.checkpoints, config.checkpoint)
            is_restored = keeper.restore()
            num_done = len(state.slam.results)
            where = f"frame {num_done + 1} of {len(state.samples)}" if is_restored else "the first frame"
            for line in (f"resumed from {where}", *notes):
                state.note(line)
                say(console, plain(line))
            folder.set_state(RUNNING)
            journal = Journal(folder.path / JOURNAL, state.sequence.time_offset)
            journal.begin_with(state.slam.trajectory)
            _run(state, _Session(folder, journal, keeper, interruption, viewer, console))
        finally:
            folder.close()
    return folder.path


def _parent(config: Config) -> Path:
    """Return the folder of all runs of a method on the scene that the settings name."""
    dataset, folder = find_sequence(config)
    scene = config.scene if folder is None else folder.resolve().name
    return config.out / dataset / scene / config.method


def _prepare(config: Config, console: Console, open_with: Opener) -> tuple[Viewer, Run]:
    """Start the kernels, open the recording and all that evaluation needs; say what is missing."""
    try:
        kernels.init(config.device, threads=config.threads)
    except RuntimeError as error:  # no such device
        raise EdSlamError(str(error)) from error
    viewer = make_viewers(config, lambda line: say(console, line))
    if config.mapping.enabled and config.evaluation.lpips_weights is not None:
        load_lpips(config.evaluation.lpips_weights)  # is it there, and what it should be?
    sequence = open_with(config, console)
    if config.calibrate == "depth":
        sequence = _with_calibrated_depth(sequence, config, console)
    samples = SampledSequence(sequence, config.start, config.duration, config.max_interval)
    contrast, sensor = _own_sensor(config, sequence, samples)
    slam = make_slam(config, sequence, samples, contrast)
    for text in contrast.notes:
        sequence.note(text)
    held_out = held_out_frames(samples, config.evaluation.hold_out_every)
    state = Run(config, sequence, samples, slam, held_out, contrast, sensor)
    camera, (first, last) = sequence.camera, samples.timestamps[[0, -1]]
    scene, description = plain(sequence.scene), plain(sequence.description)
    state.note(f"{scene}: {description}, method {config.method}")
    console.print(Text(scene, "bold") + Text(f": {description}"), soft_wrap=True)
    say(
        console,
        f"{camera.width}x{camera.height}, {last - first:.2f} s, {len(samples)} frames, "
        f"method {config.method} on {config.device}",
    )
    for text in sequence.notes:
        say(console, plain(text))
    if config.mapping.enabled:
        _check_truth_of_views(state, console)
    return viewer, state


def _with_calibrated_depth(
    sequence: EventDepthSequence, config: Config, console: Console
) -> EventDepthSequence:
    """Return the sequence with depth moved to where events show it; say by how much."""
    calibration = calibrate_depth(sequence, config, lambda what: say(console, what))
    sequence.note(f"calibrated: {calibration.text}")
    return aligned(sequence, calibration.delay, calibration.rotation)


def _check_truth_of_views(state: Run, console: Console) -> None:
    """Say now, not after the run, what of the truth cannot be read and will be left out of evaluation."""
    sequence = state.sequence
    try:
        sequence.novel_views()
        if sequence.surfaces_file is not None:
            read_triangle_mesh(sequence.surfaces_file)
    except (DataError, OSError) as error:
        line = f"left out of evaluation: {plain(error)}"
        state.note(line)
        say(console, line)


def _run(state: Run, session: _Session) -> None:
    """Process all frames, refine the map and save; whatever ends this early, save what there is."""
    interruption = session.interruption
    failure: Exception | None = None
    with interruption.deferred():
        try:
            _process(state, session)
            if interruption.requested and not interruption.is_urgent:
                session.keeper.keep()
            if state.slam.mapper is not None and not interruption.requested and not state.is_refined:
                _finish(state, state.slam.mapper, session)
        except Stopped:
            pass  # the signal is known, and that it is urgent
        except Exception as error:
            failure = told(error, state)
        if len(state.slam.trajectory) > 0:  # else there is nothing to save
            failure = _save(state, session, failure)
    session.viewer.close()
    if failure is not None:
        raise failure
    if interruption.number is not None:
        raise Stopped(interruption.number)  # everything is saved; the exit code still says what happened


def _save(state: Run, session: _Session, failure: Exception | None) -> Exception | None:
    """Save what there is; return what ended the run, or else what kept results from being saved."""
    folder, interruption, console = session.folder, session.interruption, session.console
    if interruption.requested or failure is not None:
        state.is_interrupted = True
        state.note("interrupted")
        say(console, "interrupted: saving what there is")
    keeper = session.keeper
    if keeper.num_written:
        state.note(f"checkpoints: {keeper.num_written}, {keeper.spent:.2f} s")
    try:
        session.journal.close(state.slam.trajectory)
        save(state, folder.path, console, interruption)
    except Exception as error:
        failure = failure or told(error, state)
    try:
        problem = point_latest_to(folder.path)
        if failure is None and not interruption.requested:
            folder.finish()
        else:
            folder.set_state(FAILED if failure is not None else INTERRUPTED)
    except OSError as error:
        failure, problem = failure or error, ""
    if problem:
        say(console, plain(problem))
    say(console, f"results: {plain(folder.path, 4096)}")
    return failure


def open_recording(config: Config, console: Console | None = None) -> EventDepthSequence:
    """Open the scene that the settings name; without --dataset, print which one that turned out to be."""
    if config.dataset is None:
        folder = find_sequence(config).folder
        where = (
            f"the recording in {folder}" if folder else f"none in {config.data_dir}, so the built-in stand-in"
        )
        line = f"scene {plain(config.scene)}: {plain(where, 4096)}"
        say(console or patient_console(), line)
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
        FrameBuilder(sequence.camera, contrast.dead_time),
        tracker,
        mapper if config.mapping.enabled else None,
        initial_pose=np.eye(4) if truth is None else truth,
    )


def contrast_of(config: Config, sequence: EventDepthSequence, samples: SampledSequence) -> ContrastThreshold:
    """Return the contrast threshold of a run, with its source."""
    return _own_sensor(config, sequence, samples)[0]


def _own_sensor(
    config: Config, sequence: EventDepthSequence, samples: SampledSequence
) -> tuple[ContrastThreshold, SensorEstimate | None]:
    first, last = (float(t) for t in samples.timestamps[[0, -1]])
    return own_sensor(config.contrast_threshold, config.dead_time, sequence, first, last)


def held_out_frames(samples: SampledSequence, every: int) -> set[int]:
    """Return the indices of every n-th frame with depth, from the middle of the first n on."""
    with_depth = np.nonzero(samples.has_depth)[0]
    return {int(k) for number, k in enumerate(with_depth) if is_held_out(number, every)}


# --- the loop ---


def _process(state: Run, session: _Session) -> None:
    """Process the frames that have not been processed yet, until a signal comes."""
    slam, mapper = state.slam, state.slam.mapper
    samples, num_unreadable = state.samples, 0  # in a row
    assert isinstance(samples, SampledSequence)  # others have been fed
    with progress_bar(session.console, TimeRemainingColumn()) as bar:
        first, total = len(slam.results), len(samples)
        task = bar.add_task("mapping" if mapper else "tracking", total=total, completed=first, status="")
        ate, error = "", None
        for k in range(first, total):
            if session.interruption.requested:
                break
            sample, problem = samples.as_far_as_readable(k)
            if not problem and samples.has_depth[k] and sample.depth is None:
                problem = "its depth image cannot be used"
            if problem:
                state.note(f"frame {k} at {sample.timestamp:.3f} s: {problem}")
            num_unreadable = num_unreadable + 1 if problem else 0
            if num_unreadable >= MOST_UNREADABLE:
                raise DataError(f"{num_unreadable} frames in a row cannot be read; the last: {problem}")
            process_sample(state, sample, session.journal, problem)
            if k % ATE_EVERY == 0 and state.sequence.truth is not None:
                error = ate_rmse_cm(slam.trajectory, state.sequence.truth)
                ate = "" if error is None else f"  ATE {error:.2f} cm"
            bar.update(task, advance=1, status=speed_text(state) + ate)
            session.keeper.keep_if_due()
            _show(state, session, sample, error)


def _show(state: Run, session: _Session, sample: Sample | None, error_cm: float | None = None) -> None:
    """Show how far the run is, and wait where somebody has paused it."""
    sequence = state.sequence
    num_frames = len(state.samples)
    moment = Moment(state.slam, sequence.camera, sample, num_frames, sequence.truth, error_cm)
    session.viewer.update(moment)
    session.viewer.wait(lambda: session.interruption.requested)


def _finish(state: Run, mapper: Mapper, session: _Session) -> None:
    """Refine the map, until a signal comes."""
    started, interruption = time.perf_counter(), session.interruption
    with progress_bar(session.console, TimeRemainingColumn()) as bar:
        task = bar.add_task("refining", total=100, status="")

        def report(fraction: float) -> bool:
            bar.update(task, completed=int(100 * fraction), status=f"loss {mapper.loss:.3f}")
            session.journal.correct(state.slam.trajectory)
            _show(state, session, None)
            if interruption.requested and not interruption.is_urgent:
                session.keeper.keep()
            elif not interruption.requested:
                session.keeper.keep_if_due()
            return not interruption.requested

        mapper.finish(state.slam.trajectory, report)
        bar.update(task, completed=100)
    state.finish_seconds += time.perf_counter() - started
    if not interruption.requested:
        state.is_refined = True
        session.keeper.keep_if_due()
