"""Runs methods on the cases; each result has a file of its own, so that an interrupted run can continue."""

import itertools
import json
import textwrap
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import TimeElapsedColumn

from edslam_ti import __version__, kernels
from edslam_ti.config import Config, dataset_differences
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.datasets.altered import AlteredSequence
from edslam_ti.errors import ConfigError, EdSlamError
from edslam_ti.evaluation.trajectories import trajectory_errors
from edslam_ti.experiments.cases import MEASURED, Case, Recording
from edslam_ti.experiments.recordings import Recordings
from edslam_ti.methods import METHODS
from edslam_ti.output import atomic_file
from edslam_ti.patient_console import progress_bar
from edslam_ti.pipeline import contrast_of, make_slam
from edslam_ti.slam import Slam
from edslam_ti.trajectory import Trajectory
from edslam_ti.truth import true_poses_at

Report = Callable[[str, float], None]  # receives the present activity and the share of it that is done
Value = TypeVar("Value")
LONGEST_MESSAGE = 300  # characters; compilers write long messages


@dataclass(frozen=True)
class Variant:
    """A method with settings that differ from its preset; tables show the name."""

    name: str
    method: str
    differences: dict[str, Any]


def methods_as_variants(methods: Sequence[str], mapping: bool) -> list[Variant]:
    """Return methods with their presets, with or without mapping."""
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ConfigError(f"method: expected some of {', '.join(METHODS)}, got '{unknown[0]}'")
    suffix = "+mapping" if mapping else ""
    return [Variant(name + suffix, name, {"mapping": {"enabled": mapping}}) for name in methods]


def run_case(
    case: Case, variant: Variant, sequence: EventDepthSequence, threads: int, report: Callable[[float], None]
) -> dict[str, Any]:
    """Run a method on a case; return errors against the truth, lost frames, and speed.

    Errors are of SE(3)-aligned positions, over all frames and over frames with depth.
    """
    recording = case.recording
    config = Config(method=variant.method, scene=recording.scene, seed=recording.seed, threads=threads)
    config = config.updated(dataset_differences(sequence.preset or sequence.dataset))
    config = config.updated(dict(METHODS[variant.method].overrides)).updated(variant.differences)
    samples = SampledSequence(sequence, config.start, config.duration, config.max_interval)
    slam = make_slam(config, sequence, samples, contrast_of(config, sequence, samples))
    lost: dict[str, int] = {}
    for k, sample in enumerate(samples):
        result = slam.process(sample)
        if not result.converged:
            lost[result.message] = lost.get(result.message, 0) + 1
        report((k + 1) / len(samples))
    if slam.mapper is not None:
        slam.mapper.finish(slam.trajectory, lambda share: True)
    return {
        **_errors(slam, sequence, samples.timestamps[samples.has_depth]),
        "num_frames": len(slam.results),
        "num_lost_frames": sum(lost.values()),
        "lost": lost,
        "tracking_hz": round(len(slam.results) / slam.tracking_seconds, 2),
        "settings": config.model_dump(mode="json"),
    }


def _errors(slam: Slam, sequence: EventDepthSequence, depth_times: np.ndarray) -> dict[str, Any]:
    """Return the trajectory's errors (cm, degrees) and the aligned error along the path."""
    assert sequence.truth is not None
    estimate = slam.trajectory
    at_depth = np.isin(estimate.timestamps, depth_times)
    sparse = Trajectory(estimate.timestamps[at_depth], estimate.poses[at_depth])
    errors = trajectory_errors(estimate, sequence.truth)
    steps = np.linalg.norm(np.diff(errors.true_positions, axis=0), axis=1)  # metres
    drift = _drift_cm(estimate, sequence)
    values = {
        "ate_rmse_cm": errors.ate_rmse_cm,
        "ate_max_cm": errors.ate_max_cm,
        "ate_at_depth_rmse_cm": trajectory_errors(sparse, sequence.truth).ate_rmse_cm,
        "ate_frontend_rmse_cm": trajectory_errors(slam.frontend_trajectory, sequence.truth).ate_rmse_cm,
        "rpe_trans_cm": errors.rpe_trans_cm,
        "rpe_rot_deg": errors.rpe_rot_deg,
        "final_drift_cm": float(drift[-1]),
        "path_m": float(steps.sum()),
    }
    curve = {"path_m": np.concatenate([[0.0], np.cumsum(steps)]), "drift_cm": drift}
    return {
        **{name: round(value, 4) for name, value in values.items()},
        "curve": {name: [round(float(x), 4) for x in values] for name, values in curve.items()},
    }


def _drift_cm(estimate: Trajectory, sequence: EventDepthSequence) -> np.ndarray:  # [F]
    """Return the distance from the truth when both start at the same pose."""
    assert sequence.truth is not None
    true, is_known = true_poses_at(sequence.truth, estimate.timestamps)
    poses, truth = estimate.poses[is_known], true[is_known]
    moved = truth[0] @ np.linalg.inv(poses[0]) @ poses
    distances: np.ndarray = 100 * np.linalg.norm(moved[:, :3, 3] - truth[:, :3, 3], axis=1)
    return distances


def result_file(out: Path, case: Case, variant: Variant) -> Path:
    """Return the path of a result's file."""
    return out / "cases" / case.name / f"{variant.name}.json"


def run_all(
    cases: Sequence[Case],
    variants: Sequence[Variant],
    recordings: Recordings,
    out: Path,
    console: Console,
    threads: int = 2,
    fresh: bool = False,
    keep_recordings: bool = True,
) -> Iterator[dict[str, Any]]:
    """Run all cases without a result in `out`; yield all results, in the order of cases and variants.

    A case that fails is recorded with its `error`, a case whose data or library is missing as `skipped`. The
    other cases still run, and the next call tries the failed and skipped ones again.
    """
    is_started = False
    with progress_bar(console, TimeElapsedColumn()) as bar:
        task = bar.add_task("bench", total=len(cases) * len(variants), status="")

        def report(what: str, share: float) -> None:
            bar.update(task, status=f"{what} {share:.0%}")

        for recording, group in itertools.groupby(cases, key=lambda case: case.recording):
            opened: EventDepthSequence | dict[str, Any] | None = None
            for case, variant in itertools.product(group, variants):
                file = result_file(out, case, variant)
                result = None if fresh else _kept(file)
                if result is None:
                    if not is_started:  # without a run no kernels are needed
                        kernels.init("cpu", threads=threads)
                        is_started = True
                    if opened is None:
                        opened = _opened(recordings, recording, report)
                    if isinstance(opened, dict):
                        result = _about(case, variant) | opened
                    else:
                        result = _attempted(case, variant, opened, threads, report)
                    file.parent.mkdir(parents=True, exist_ok=True)
                    with atomic_file(file) as temporary:
                        temporary.write_text(json.dumps(result, indent=1) + "\n")
                    console.print(describe(result), highlight=False, markup=False, soft_wrap=True)
                    console.file.flush()
                bar.advance(task)
                yield result
            if not keep_recordings:
                recordings.discard(recording)


def describe(result: dict[str, Any]) -> str:
    """Return a result in one line."""
    name = f"{result['case']} {result['variant']}"
    for problem in ("error", "skipped"):
        if problem in result:
            return f"{name}: {problem}: {result[problem]}"
    return (
        f"{name}: ATE {result['ate_rmse_cm']:.3f} cm ({result['ate_at_depth_rmse_cm']:.3f} at depth frames), "
        f"{result['num_lost_frames']} of {result['num_frames']} frames lost, {result['tracking_hz']:.1f} Hz"
    )


def _opened(
    recordings: Recordings, recording: Recording, report: Report
) -> EventDepthSequence | dict[str, Any]:
    """Return a recording, or the problem that prevented reading it."""
    what = f"simulating {recording.scene}"
    return _or_problem(lambda: recordings.open(recording, lambda share: report(what, share)))


def _attempted(
    case: Case, variant: Variant, sequence: EventDepthSequence, threads: int, report: Report
) -> dict[str, Any]:
    """Return the result of a run, or the problem that ended it."""

    def run() -> dict[str, Any]:
        noise = case.depth if case.depth == "kinect" else "none"
        rate = None if case.depth == MEASURED else case.rate
        gaps = (case.event_gap, case.depth_gap)
        altered = AlteredSequence(sequence, noise, rate, *gaps, seed=case.recording.seed)
        what = f"{case.name} {variant.name}"
        return run_case(case, variant, altered, threads, lambda share: report(what, share))

    return _about(case, variant) | _or_problem(run)


def _about(case: Case, variant: Variant) -> dict[str, Any]:
    return {
        "case": case.name,
        "row": case.row,
        "group": case.group,
        "seed": case.recording.seed,
        "variant": variant.name,
        "version": __version__,
    }


def _or_problem(action: Callable[[], Value]) -> Value | dict[str, Any]:
    """Return an action's result, or the problem that ended it, so that other cases still run."""
    try:
        return action()
    except (FileNotFoundError, ModuleNotFoundError) as missing:
        return {"skipped": " ".join(str(missing).split())}
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = "" if isinstance(error, EdSlamError) else f" ({Path(where.filename).name}:{where.lineno})"
        message = textwrap.shorten(str(error), LONGEST_MESSAGE)
        return {"error": f"{type(error).__name__}: {message}{place}"}


def _kept(file: Path) -> dict[str, Any] | None:
    """Return the result of an earlier call; None: there is none, or it failed or was skipped."""
    if not file.is_file():
        return None
    result: dict[str, Any] = json.loads(file.read_text())
    return None if "error" in result or "skipped" in result else result
