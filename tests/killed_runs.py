"""python tests/killed_runs.py [--kills 50]: kill -9 small runs at random moments, resume them, compare.

Each run is killed once to three times: at the start, while frames are processed, while a checkpoint is
written, while the map is refined, and while results are saved. Trajectory and map of the resumed run must be
those of an uninterrupted one, to the bit. Exits with 1 where they are not.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMPARED = ("trajectory_tum.txt", "trajectory_frontend_tum.txt", "map.ply")
MOMENTS = ("start", "frames", "checkpoint", "refining", "saving")
LONGEST_RUN = 300.0  # seconds
# Often enough that every run has checkpoints in its frames and in its refinement.
SETTINGS = [
    *("--checkpoint", "0.001", "--mapping.iterations", "2", "--mapping.final-iterations", "60"),
    *("--evaluation.max-images", "3", "--evaluation.flythrough-frames", "5"),
]


def start(arguments: list[str]) -> "subprocess.Popen[bytes]":
    """Start `edslam slam` with these arguments."""
    command = [sys.executable, "-c", "from edslam_ti.commands import main; main()", "slam", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def finished(arguments: list[str]) -> None:
    """Run to the end; raises RuntimeError with what is on stderr where that fails."""
    process = start(arguments)
    _, errors = process.communicate(timeout=LONGEST_RUN)
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {errors.decode(errors='replace')[-1000:]}")


def new_run(recording: Path, out: Path) -> list[str]:
    """Return the arguments of a run of a recording in EventReplica's layout."""
    where = ["--dataset", "event_replica", "--data-dir", str(recording.parent), "--scene", recording.name]
    return [*where, "--out", str(out), *SETTINGS]


def folder_in(out: Path) -> Path | None:
    """Return the folder of the run in `out`, None before it is there."""
    return next((p.parent for p in out.glob("*/*/*/*/run.json") if p.parent.name != "latest"), None)


def kill_at(moment: str, process: "subprocess.Popen[bytes]", out: Path, rng: random.Random) -> bool:
    """Kill a run at a moment; return False where it ended before."""

    def has_come() -> bool:
        folder = folder_in(out)
        if folder is None:
            return False
        if moment == "start":
            return True
        if moment == "saving":
            return (folder / "trajectory_tum.txt").exists()
        if moment == "checkpoint":
            return any((folder / "checkpoint").glob(".*.partial"))
        journal = folder / "journal.csv"
        lines = journal.read_bytes().count(b"\n") if journal.exists() else 0
        return lines > (15 if moment == "refining" else 2)

    if moment == "checkpoint":  # not the first one
        wait_for(has_come, process)
        time.sleep(rng.uniform(0, 2))
    if not wait_for(has_come, process):
        return False
    time.sleep(0 if moment == "checkpoint" else rng.uniform(0, 1.5))
    if process.poll() is not None:
        return False
    process.send_signal(signal.SIGKILL)
    process.wait()
    return True


def wait_for(has_come: Callable[[], bool], process: "subprocess.Popen[bytes]") -> bool:
    """Wait for a moment; return False where the process ends before."""
    deadline = time.monotonic() + LONGEST_RUN
    while not has_come():
        if process.poll() is not None or time.monotonic() > deadline:
            return False
        time.sleep(0.001)
    return True


def killed_and_resumed(recording: Path, out: Path, rng: random.Random) -> tuple[Path, list[str]]:
    """Kill a run at one to three random moments, resume it each time; return its folder and the moments."""
    killed: list[str] = []
    arguments = new_run(recording, out)
    for _ in range(rng.choice((1, 1, 2, 3))):
        moment = rng.choice(MOMENTS)
        process = start(arguments)
        was_killed = kill_at(moment, process, out, rng)
        process.wait()
        folder = folder_in(out)
        if not was_killed or folder is None:
            break
        killed.append(moment)
        arguments = ["--resume", str(folder)]
    folder = folder_in(out)
    assert folder is not None
    if killed and "finished" not in (folder / "run.json").read_text():
        finished(["--resume", str(folder)])
    return folder, killed


def differences(folder: Path, reference: Path) -> list[str]:
    """Return the names of the files that differ from those of the uninterrupted run, or are not in both."""
    wrong = [n for n in COMPARED if (folder / n).read_bytes() != (reference / n).read_bytes()]
    names, expected = ({str(p.relative_to(f)) for p in f.rglob("*")} for f in (folder, reference))
    return wrong + sorted(names ^ expected)  # nothing is missing, nothing is left over


def main() -> int:
    """Kill and resume as many runs as asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, bad, num_kills, k = random.Random(options.seed), 0, 0, 0
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        recording = place / "tiny"
        script = (
            "import sys; from pathlib import Path; from edslam_ti import kernels; import sequences; "
            "kernels.init('cpu'); sequences.record_tiny_room(Path(sys.argv[1]))"
        )
        paths = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
        environment = os.environ | {"PYTHONPATH": paths}
        subprocess.run([sys.executable, "-c", script, str(recording)], env=environment, check=True)
        finished(new_run(recording, place / "reference"))
        reference = folder_in(place / "reference")
        assert reference is not None
        while num_kills < options.kills:
            k += 1
            folder, killed = killed_and_resumed(recording, place / f"run{k}", rng)
            wrong = differences(folder, reference)
            num_kills += len(killed)
            bad += bool(wrong)
            print(f"{num_kills} kills: {', '.join(killed) or 'none'}: {wrong or 'same'}", flush=True)
    print(f"{num_kills} kills in {k} runs, {bad} with another result")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
