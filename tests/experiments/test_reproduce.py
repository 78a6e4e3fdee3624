"""The bench: cases, altered sequences, runs that are kept, and the tables made of them."""

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from sequences import TINY, tiny_room

from apps import reproduce
from edslam_ti.camera import Camera
from edslam_ti.command_line import UsageError
from edslam_ti.config import Config, MappingConfig, dataset_differences
from edslam_ti.datasets import EventDepthSequence, SampledSequence
from edslam_ti.datasets.altered import AlteredSequence, RepeatedSequence
from edslam_ti.datasets.event_replica import EventReplicaSequence
from edslam_ti.errors import ConfigError, DataError
from edslam_ti.experiments import runs
from edslam_ti.experiments.ablations import (
    ablation_cases,
    ablation_markdown,
    ablation_rows,
    ablation_variants,
)
from edslam_ti.experiments.cases import Case, Recording, all_cases, quick_cases, with_sensors
from edslam_ti.experiments.long_stream import FrameCost, held_bytes, measure, table, windows
from edslam_ti.experiments.recordings import Recordings
from edslam_ti.experiments.report import insert_into, markdown, write_report
from edslam_ti.experiments.runs import Variant, methods_as_variants, result_file, run_all
from edslam_ti.experiments.selection import Selection
from edslam_ti.mapping.gaussians import GaussianMap
from edslam_ti.methods import METHODS
from edslam_ti.simulation import HandHeldPath, make_path, simulate
from edslam_ti.simulation.depth_noise import viewing_cosine
from edslam_ti.simulation.renderer import Renderer
from edslam_ti.tracking.keyframes import BrightnessKeyframe, Depth


class TinyRecordings(Recordings):
    """Opens the tiny recording under every scene name but two."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.opened: list[str] = []
        self.folder = folder

    def open(self, recording: Recording, progress: Any) -> EventDepthSequence:
        self.opened.append(recording.scene)
        if recording.scene == "absent":
            raise FileNotFoundError("no such data")
        if recording.scene == "broken":
            raise ZeroDivisionError("something unforeseen")
        return EventReplicaSequence(self.folder)


def test_viewing_cosine_of_exact_depth_is_the_renderer_s() -> None:
    room = tiny_room()
    render = Renderer(room.scene, TINY.camera).render(HandHeldPath(room, 1.0).pose(0.3))
    difference = np.abs(viewing_cosine(render.depth, TINY.camera) - render.cosine)
    assert np.quantile(difference, 0.9) < 0.01  # corners of the room apart
    assert viewing_cosine(np.zeros((3, 4)), Camera(4, 3, 2.0, 2.0, 1.5, 1.0)).max() == 0


def test_altered_sequence_thins_depth_and_cuts_gaps(tiny_sequence: EventDepthSequence) -> None:
    stamps = tiny_sequence.depth_timestamps
    np.testing.assert_array_equal(AlteredSequence(tiny_sequence, depth_rate=20).depth_timestamps, stamps)
    sparse = AlteredSequence(tiny_sequence, depth_rate=5)
    np.testing.assert_allclose(sparse.depth_timestamps, stamps[::4])
    np.testing.assert_array_equal(sparse.depth(2), tiny_sequence.depth(8))
    gap = AlteredSequence(tiny_sequence, event_gap=(0.2, 0.1), depth_gap=(0.2, 0.1))
    np.testing.assert_allclose(gap.depth_timestamps, np.delete(stamps, [4, 5]))
    whole, cut = tiny_sequence.events(0.1, 0.4), gap.events(0.1, 0.4)
    kept = (whole.t < 0.2) | (whole.t >= 0.3)
    np.testing.assert_array_equal(cut.t, whole.t[kept])
    assert len(gap.events(0.22, 0.28)) == 0
    assert len(gap.events(0.15, 0.18)) == len(tiny_sequence.events(0.15, 0.18))


@pytest.mark.slow
def test_a_loop_is_played_again_where_it_ended(tmp_path: Path) -> None:
    settings = TINY.model_copy(update={"path": "loop", "duration": 0.2, "width": 48, "height": 32})
    room = tiny_room()
    simulate(room.scene, make_path(room, settings), settings, tmp_path / "loop")
    once = EventReplicaSequence(tmp_path / "loop")
    twice = RepeatedSequence(once, 2)
    stamps = once.depth_timestamps
    np.testing.assert_allclose(twice.depth_timestamps, [*stamps, *(stamps[1:] + 0.2)])
    np.testing.assert_array_equal(twice.depth(len(stamps)), once.depth(1))
    assert twice.truth is not None
    np.testing.assert_allclose(twice.truth.at(0.25), twice.truth.at(0.05), atol=1e-9)
    across = twice.events(0.15, 0.25)
    assert len(across) == len(once.events(0.15, 0.2)) + len(once.events(0.0, 0.05))
    assert (np.diff(across.t) >= 0).all()
    assert len(SampledSequence(twice, 0.0, None, 0.05)) == 2 * len(SampledSequence(once, 0.0, None, 0.05))


@pytest.mark.slow
def test_long_stream_reports_the_cost_of_frames(tiny_sequence: EventDepthSequence, tmp_path: Path) -> None:
    config = Config(duration=0.2, poses="truth").updated({"mapping": {"iterations": 1}})
    lines: list[str] = []
    measure(tiny_sequence, config, tmp_path, length=0.1, report=lines.append)
    rows = (tmp_path / "frames.csv").read_text().splitlines()
    num_frames = len(SampledSequence(tiny_sequence, 0.0, 0.2, config.max_interval))
    assert len(rows) == 1 + num_frames
    assert float(rows[-1].split(",")[4]) > 100  # MB: Python and torch are there
    text = (tmp_path / "long_stream.md").read_text()
    assert all(line in text for line in lines)
    assert (tmp_path / "long_stream.png").stat().st_size > 1000


def test_growth_is_counted_from_the_warm_up_on() -> None:
    costs = [
        FrameCost(t, 0.2 if t < 15 else 0.3, 0.1, 0.1, 500 + t, int(1000 * t), 0.2 * t, 7.0, 0.1 * t)
        for t in range(20)
    ]
    text = table(windows(costs, length=5.0))
    parts = "map +2.0, frames +0.0, tracker +1.0, other +7.0"
    assert f"Since 10 s: +10 MB with +10000 Gaussians ({parts}), CPU time a frame +50 %." in text


def test_held_memory_counts_once_what_is_reached_twice() -> None:
    depth = np.zeros((10, 20), np.float32)
    keyframe = BrightnessKeyframe(
        0, depth, Depth(depth, depth[::2]), Depth(depth, depth), np.ones(7), [torch.zeros(3)], None, 0
    )
    counted: set[int] = set()
    assert held_bytes([keyframe, {"again": keyframe}], counted) == 10 * 20 * 4 + 7 * 8 + 3 * 4
    assert held_bytes(depth[3:], counted) == 0
    assert held_bytes(np.zeros(5), counted) == 5 * 8


def test_a_gaussian_takes_two_hundred_bytes_with_its_moments() -> None:
    gaussians = GaussianMap(MappingConfig())
    empty = held_bytes(gaussians, set())
    for _ in range(2):
        m = torch.rand(100, 3)
        gaussians.add(m, torch.rand(100, 4), torch.rand(100, 3), 0.5, torch.rand(100, 1))
    # Raw parameters and two moments of each, 5 cells, the frame, and whether it was measured
    assert held_bytes(gaussians, set()) - empty == 200 * (3 * 12 * 4 + 5 * 8 + 8 + 1)


def test_a_path_that_does_not_close_is_not_played_again(tiny_sequence: EventDepthSequence) -> None:
    with pytest.raises(DataError, match="end where they begin"):
        RepeatedSequence(tiny_sequence, 2)


def test_altered_depth_is_noisy_and_the_same_every_time(tiny_sequence: EventDepthSequence) -> None:
    first = AlteredSequence(tiny_sequence, "kinect", seed=1)
    exact, noisy = tiny_sequence.depth(3), first.depth(3)
    seen = noisy > 0
    assert 0.5 < seen.mean() < 1
    assert 0.001 < np.median(np.abs(noisy - exact)[seen]) < 0.01  # metres: quantised at 1 to 2 m
    np.testing.assert_array_equal(noisy, AlteredSequence(tiny_sequence, "kinect", seed=1).depth(3))
    assert (noisy != AlteredSequence(tiny_sequence, "kinect", seed=2).depth(3)).any()
    with pytest.raises(DataError, match="expected none or kinect, got 'kinetic'"):
        AlteredSequence(tiny_sequence, "kinetic")


def test_cases_are_unique_and_share_recordings() -> None:
    cases = all_cases()
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    rooms = [case for case in cases if case.group == "rooms"]
    assert len(rooms) == 5 * 2 * 3 * 2 * 3  # scenes, depth, rates, speeds, seeds
    assert len({case.recording for case in rooms}) == 5 * 2 * 3
    first = [case.recording for case in cases if case.recording.seed == 0]
    changes = sum(a != b for a, b in itertools.pairwise(first))
    assert changes == len(set(first)) - 1  # each recording is opened once
    assert "office0-loop-30s-kinect-20hz-seed1" in names
    assert len(quick_cases()) == 4


def test_other_sensors_record_the_same_cases() -> None:
    cases = with_sensors(quick_cases(), "typical", "exact")
    assert cases[0].name == "office0-typical-kinect-20hz-seed0"
    assert len(cases) == 4
    assert cases[0].recording.settings.sensor.preset == "typical"
    cases = with_sensors(all_cases(), "davis346", "kinect_azure")
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    assert "room0-x2-davis346-kinect_azure-30hz-seed1" in names
    assert [case.recording.sensor for case in cases if case.recording.scene == "slider_depth"] == ["ideal"]


def test_selection_filters_and_combines() -> None:
    cases = all_cases()
    chosen = [c for c in cases if Selection(scenes=("wall",), depth=("kinect",), seeds=(2,)).includes(c)]
    assert [c.name for c in chosen] == ["wall-kinect-20hz-seed2", "wall-kinect-5hz-seed2"]
    gaps = [c for c in cases if Selection(cases=("event_gap", "depth_gap")).includes(c)]
    assert {c.group for c in gaps} == {"gaps"}


def tiny_case(scene: str, **differences: Any) -> Case:
    return replace(Case("rooms", Recording(scene)), **differences)


@pytest.mark.slow
def test_runs_record_failures_continue_and_resume(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "event_replica.yaml").write_text("tracking: {levels: 2}")
    monkeypatch.setattr(runs, "dataset_differences", lambda dataset: dataset_differences(dataset, tmp_path))
    cases = [tiny_case(s) for s in ("absent", "tiny", "broken")] + [
        tiny_case("tiny", depth="kinect", rate=10)
    ]
    quick = {"mapping": {"enabled": False}, "tracking": {"num_patches": 100}}
    variants = [Variant("quick", "ed_slam", quick), Variant("odd", "no_such_method", {})]
    recordings = TinyRecordings(tiny_folder)
    console = Console(quiet=True)
    results = list(run_all(cases, variants, recordings, tmp_path, console))
    assert [r["variant"] for r in results] == ["quick", "odd"] * 4
    assert results[0]["skipped"] == "no such data"
    assert results[3]["error"].startswith("KeyError: 'no_such_method' (")
    assert results[4]["error"].startswith("ZeroDivisionError: something unforeseen")
    good = results[2]
    assert good["num_frames"] == 14  # the first depth image comes before there are events
    assert 0 < good["ate_rmse_cm"] < 1
    assert good["ate_at_depth_rmse_cm"] == good["ate_rmse_cm"]  # every frame has depth
    assert len(good["curve"]["path_m"]) == len(good["curve"]["drift_cm"]) == 14
    assert good["settings"]["tracking"]["num_patches"] == 100
    assert good["settings"]["tracking"]["levels"] == 2  # the data set's
    assert json.loads(result_file(tmp_path, cases[1], variants[0]).read_text()) == good

    again = TinyRecordings(tiny_folder)
    kept = list(run_all(cases[1:2], variants[:1], again, tmp_path, console))
    assert (kept, again.opened) == ([good], [])
    fresh = list(run_all(cases[1:2], variants[:1], again, tmp_path, console, fresh=True))
    assert again.opened == ["tiny"]
    assert fresh[0]["ate_rmse_cm"] == good["ate_rmse_cm"]  # runs repeat

    table = write_report(results, tmp_path, "Tracking").read_text()
    assert "| tiny-exact-20hz | 1 | " in table
    assert "- absent-exact-20hz, quick: skipped: no such data" in table
    assert (tmp_path / "ate.png").stat().st_size > 5000
    assert len(json.loads((tmp_path / "results.json").read_text())) == 8


def result(row: str, seed: int, variant: str, ate: float, **more: Any) -> dict[str, Any]:
    names = (
        *("ate_max_cm", "ate_at_depth_rmse_cm", "ate_frontend_rmse_cm", "rpe_trans_cm", "rpe_rot_deg"),
        *("final_drift_cm", "path_m", "num_frames", "tracking_hz"),
    )
    case = {"case": f"{row}-seed{seed}", "row": row, "group": "rooms", "seed": seed, "variant": variant}
    return case | {"ate_rmse_cm": ate, "num_lost_frames": 0} | dict.fromkeys(names, 1.0) | more


def test_table_holds_mean_and_worst_over_seeds() -> None:
    rows = [
        result("a-kinect-20hz", 0, "x", 0.1),
        result("a-kinect-20hz", 1, "x", 0.5, num_lost_frames=2),
        result("a-kinect-20hz", 0, "y", 1.0),
        {k: v for k, v in result("a-kinect-20hz", 1, "y", 0).items() if k != "ate_rmse_cm"}
        | {"error": "bad"},
        result("b-kinect-20hz", 0, "x", 0.3),
    ]
    table = markdown(rows, "T")
    assert "| rooms kinect 20hz | 3 | 0.30 / 0.50, 2 lost | 1.00 / 1.00, 1 without result |" in table
    assert "| a-kinect-20hz | 2 | 0.30 / 0.50, 2 lost | 1.00 / 1.00, 1 without result |" in table
    assert "| b-kinect-20hz | 1 | 0.30 / 0.30 | - |" in table
    assert "- a-kinect-20hz, y: error: bad" in table


def test_drift_of_long_cases_is_drawn(tmp_path: Path) -> None:
    curve = {"path_m": [0.0, 1.0, 2.0], "drift_cm": [0.0, 0.1, 0.3]}
    write_report([result("a-30s", 0, "x", 0.1, curve=curve) | {"group": "long"}], tmp_path, "T")
    assert (tmp_path / "drift.png").stat().st_size > 5000


def test_unknown_method_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected some of ed_slam, .* got 'orb'"):
        methods_as_variants(["ed_slam", "orb"], mapping=False)


def test_recordings_of_the_data_folder_are_missed_by_name(tmp_path: Path) -> None:
    recordings = Recordings(tmp_path)
    for scene in ("slider_depth", "viking_room"):
        with pytest.raises(FileNotFoundError, match="--data-dir"):
            recordings.open(Recording(scene), lambda share: None)


def test_only_recordings_made_here_are_discarded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_folder: Path
) -> None:
    from edslam_ti.experiments import recordings as module

    made = tmp_path / "made"

    def builtin(scene: str, settings: Any, progress: Any) -> Path:
        if not made.exists():
            made.symlink_to(tiny_folder)
            progress(1.0)
        return made

    monkeypatch.setattr(module, "builtin_sequence_folder", builtin)
    discarded: list[Path] = []
    monkeypatch.setattr(module.shutil, "rmtree", discarded.append)
    first, second = Recordings(tmp_path), Recordings(tmp_path)
    first.open(Recording("office0"), lambda share: None)
    second.open(Recording("office0"), lambda share: None)
    second.discard(Recording("office0"))
    assert discarded == []
    first.discard(Recording("office0"))
    assert discarded == [made]


def test_ablations_share_the_defaults_and_every_setting_exists() -> None:
    variants = ablation_variants()
    assert len({v.name for v in variants}) == len(variants)
    assert {"ed_slam", "ed_slam_paper"} <= {v.name for v in variants}
    settings = [
        Config(method=v.method).updated(dict(METHODS[v.method].overrides)).updated(v.differences)
        for v in variants
    ]
    assert len({s.tracking.model_dump_json() for s in settings}) == len(variants)  # no run twice
    for title, rows in ablation_rows().items():
        assert any(v.name == v.method for v in rows.values()) or "time surfaces and depth" in title
    cases = ablation_cases(("office0", "wall"), (0, 1))
    assert [c.row for c in cases] == ["office0-kinect-20hz"] * 2 + ["wall-kinect-20hz"] * 2


def test_ablation_tables_mark_the_default_and_list_failures() -> None:
    results = [
        result("office0-kinect-20hz", 0, v.name, 0.1 * k) for k, v in enumerate(ablation_variants(), 1)
    ]
    results.append({k: v for k, v in results[0].items() if k != "ate_rmse_cm"} | {"error": "bad", "row": "b"})
    text = ablation_markdown(results)
    assert "| brightness images and depth (default) | 0.100 | - | 0.100 | 0 | 1 |" in text
    assert "| brightness images alone | 0.200 | - | 0.200 | 0 | 1 |" in text
    assert "- ed_slam: bad" in text


def test_tables_are_inserted_between_their_marks(tmp_path: Path) -> None:
    document = tmp_path / "experiments.md"
    document.write_text("before\n<!-- ablations -->\nold\n<!-- end ablations -->\nafter\n")
    for text in ("new\n\n", "newer"):
        insert_into(document, "ablations", text)
    assert document.read_text() == "before\n<!-- ablations -->\nnewer\n<!-- end ablations -->\nafter\n"
    with pytest.raises(DataError, match="<!-- tracking -->"):
        insert_into(document, "tracking", "x")


def test_usage_errors_state_the_expected_arguments(tmp_path: Path) -> None:
    for arguments, message in (
        ([], "expected a command first: tracking, ablations"),
        (["track"], "expected a command first"),
        (["tracking", "--scenes", "nowhere"], "no case passes the filters"),
        (["tracking", "--sceens", "wall"], "unknown option '--sceens'; did you mean '--scenes'"),
    ):
        with pytest.raises(UsageError, match=message):
            reproduce.main(arguments)
