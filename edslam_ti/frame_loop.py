"""One frame of a run, from its sample to what the log says: what recordings and fed data have in common."""

import traceback
from pathlib import Path

from edslam_ti.datasets import Sample
from edslam_ti.errors import EdSlamError
from edslam_ti.journal import Journal
from edslam_ti.memory import release_free_memory
from edslam_ti.results.run import Run
from edslam_ti.tracking.tracker import TrackingResult


def process_sample(run: Run, sample: Sample, journal: Journal | None, problem: str = "") -> TrackingResult:
    """Track and map the run's next sample, and write down what happened.

    Frames in `run.held_out` are kept from the map. With true poses, so is a frame where the truth has a hole.
    `problem` says what of the sample could not be read.
    """
    slam, k = run.slam, len(run.slam.results)
    has_no_pose = run.config.poses == "truth" and sample.T_world_camera is None
    result = slam.process(sample, is_held_out=has_no_pose or k in run.held_out)
    if slam.mapper is not None:
        release_free_memory()  # arrays of ever other sizes come and go while mapping
    run.num_events += len(sample.events)
    if not result.converged:
        run.note(f"frame {k} at {sample.timestamp:.3f} s lost: {result.message}")
    elif result.message:
        run.note(f"frame {k} at {sample.timestamp:.3f} s: {result.message}")
    if journal is not None:
        journal.add(slam.trajectory, result.converged, result.message or problem)
        if journal.problem:
            run.note_once(f"the journal cannot be written: {journal.problem}")
    return result


def is_held_out(number: int, every: int) -> bool:
    """Return whether the frame with the n-th depth image (from 0) measures the map instead of making it."""
    return number % every == every // 2


def speed_text(run: Run) -> str:
    """Return a run's frames per second and the state of its map, for a line of progress."""
    slam, mapper = run.slam, run.slam.mapper
    text = f"{len(slam.results) / (slam.tracking_seconds + slam.mapping_seconds):.1f} Hz"
    if mapper is not None:
        text += f"  {mapper.num_gaussians} Gaussians  loss {mapper.loss:.3f}"
    return text


def told(error: Exception, run: Run) -> Exception:
    """Return an exception to be told in one line; the log gets what shows where it comes from."""
    if isinstance(error, EdSlamError | OSError):
        run.note(f"ended by: {error}")
        return error
    for line in traceback.format_exception(error):
        run.note(line.rstrip())
    where = traceback.extract_tb(error.__traceback__)[-1]
    told = EdSlamError(
        f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno}); this is a defect of "
        "the program, please report it" + ("; log.txt says more" if len(run.slam.trajectory) > 0 else "")
    )
    told.__cause__ = error
    return told
