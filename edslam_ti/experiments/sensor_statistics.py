"""Statistics of the events of simulated sensors beside those of real ones."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.console import Console

from edslam_ti import __version__
from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.datasets import EventDepthSequence
from edslam_ti.datasets.builtin import BuiltinSequence, builtin_sequence_folder
from edslam_ti.errors import DataError
from edslam_ti.event_files import open_events
from edslam_ti.event_images.sensor import estimate_sensor
from edslam_ti.events import Events
from edslam_ti.experiments.documents import table_lines
from edslam_ti.experiments.jobs import source_commit
from edslam_ti.inspection.opening import open_path
from edslam_ti.output import atomic_file
from edslam_ti.sensor_config import PRESETS, SensorName
from edslam_ti.simulation import SimulationConfig

NAME = "sensor_statistics"  # of the table
DARK = 0.2  # brightness; pixels below it are dark
REAL = {  # below the data folder; words of the table
    "slider_depth": "slider_depth",
    "real_events/ecd_rotation_slices/boxes_rotation/events.txt": "boxes_rotation",
    "real_events/ecd_rotation_slices/poster_rotation/events.txt": "poster_rotation",
    "real_events/ecd_rotation_slices/shapes_rotation/events.txt": "shapes_rotation",
    "real_events/ecd_rotation_slices/dynamic_rotation/events.txt": "dynamic_rotation",
    "aedat4/davis346_test_data.aedat4": "davis346_test_data",
}
DAVIS240C = (240, 180)  # pixels, of the slices
SENSORS = {"davis346_test_data": "DAVIS346"}  # the others: DAVIS240C
COLUMNS: list[dict[str, Any]] = [
    {"key": "recording", "title": "recording"},
    {"key": "sensor", "title": "sensor"},
    {"key": "rate", "title": "events/s a pixel", "decimals": 1, "whole_from_10": True},
    {"key": "same", "title": "shortest interval ms, same polarity", "decimals": 2},
    {"key": "other", "title": "other polarity", "decimals": 2},
    {"key": "low", "title": "1 % of the intervals below ms", "decimals": 2},
    {"key": "median", "title": "half of them", "decimals": 1},
    {"key": "ratio", "title": "brighter / darker", "decimals": 2},
    {"key": "noise", "title": "noise Hz a pixel", "decimals": 2},
    {"key": "dark", "title": "in the dark", "decimals": 2},
    {"key": "hot", "title": "hot pixels", "decimals": 0},
    {"key": "dead", "title": "dead time ms, estimated", "decimals": 2},
]


def compare_sensors(
    scene: str, duration: float, width: int, data_dir: Path, store: Path | None, console: Console
) -> dict[str, Any]:
    """Print the table, and write it to docs/results of the checkout `store`; return it."""
    command = f"edslam reproduce sensors --scene {scene} --duration {duration:g} --width {width}"
    rows = []
    for name, sensor, sequence in (*_simulated(scene, duration, width), *_real(data_dir, console)):
        values = {"recording": name, "sensor": sensor, **_statistics(sequence)}
        rows.append(
            {
                "command": command,
                "commit": source_commit(),
                "version": __version__,
                "source": "docs/sensors.md",
                "values": values,
            }
        )
        console.print(" ".join(f"{value}" for value in values.values()), soft_wrap=True)
    about = f"{scene}, {duration:g} s, simulated sensors, and recordings of real ones"
    table = {"about": about, "columns": COLUMNS, "rows": rows}
    console.print("\n".join(table_lines(table)), markup=False, soft_wrap=True)
    if store is not None:
        results = store / "docs" / "results"
        if not results.is_dir():
            raise DataError(f"{results}: not found; give the checkout that contains docs/ (--store)")
        with atomic_file(results / f"{NAME}.json") as temporary:
            temporary.write_text(json.dumps(table, indent=1) + "\n")
    return table


def _simulated(scene: str, duration: float, width: int) -> Iterator[tuple[str, str, EventDepthSequence]]:
    names: tuple[SensorName, ...] = get_args(SensorName)
    for name in names:
        own = PRESETS[name].size
        size = {}
        if own is not None and own[0] > width:
            size = {"width": width, "height": round(width * own[1] / own[0])}
        threshold = {"contrast_threshold": 0.2} if name == "ideal" else {}
        settings = SimulationConfig(duration=duration, sensor=name, **size, **threshold)
        yield f"simulated {scene}", name, BuiltinSequence(builtin_sequence_folder(scene, settings))


def _real(data_dir: Path, console: Console) -> Iterator[tuple[str, str, EventDepthSequence]]:
    for place, name in REAL.items():
        if not (data_dir / place).exists():
            console.print(f"{data_dir / place}: not there, left out", markup=False, soft_wrap=True)
            continue
        sequence: EventDepthSequence | None
        if place.endswith(".txt"):
            sequence, refusal = _Slice(data_dir / place, DAVIS240C), None
        else:
            sequence, refusal = open_path(data_dir / place, Config())
        if sequence is None:
            raise DataError(f"{data_dir / place}: {refusal.text if refusal else 'cannot be opened'}")
        yield name, SENSORS.get(name, "DAVIS240C"), sequence


class _Slice(EventDepthSequence):
    """A text file of events of a sensor whose size is known."""

    dataset = "events"
    contrast_threshold = None
    truth = None

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        width, height = size
        self.scene, self.description = path.parent.name, f"file of events, {path.name}"
        self.camera = Camera(width, height, width / 2, width / 2, (width - 1) / 2, (height - 1) / 2)
        self._events = open_events(path, size)
        self.depth_timestamps = self.image_timestamps = np.empty(0)

    @property
    def time_range(self) -> tuple[float, float]:
        return self._events.time_range

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    def depth(self, index: int) -> np.ndarray:
        raise IndexError("a file of events has no depth")

    def image(self, index: int) -> np.ndarray:
        raise IndexError("a file of events has no images")


def _statistics(sequence: EventDepthSequence) -> dict[str, float | None]:
    start, end = sequence.time_range
    found = estimate_sensor(sequence, start, end)
    dark = _dark_pixels(sequence)
    in_the_dark = None if dark is None else estimate_sensor(sequence, start, end, dark).noise_rate
    both = found.shortest_by_polarity or (None, None)
    return {
        "rate": found.num_events / max(found.duration, 1e-9) / found.numbers.size,
        "same": _ms(both[0]),
        "other": _ms(both[1]),
        "low": _ms(found.interval_quantile(0.01)),
        "median": _ms(found.interval_quantile(0.5)),
        "ratio": found.positive_share / max(1 - found.positive_share, 1e-9),
        "noise": found.noise_rate,
        "dark": in_the_dark,
        "hot": float(len(found.hot_pixels)),
        "dead": _ms(found.dead_time),
    }


def _dark_pixels(sequence: EventDepthSequence) -> np.ndarray | None:  # [H, W]
    """Return the pixels that are dark on average; None: there are no images, or no such pixels."""
    images = [sequence.image_or_none(k) for k in range(len(sequence.image_timestamps))]
    known = [image for image in images if image is not None]
    if not known:
        return None
    dark: np.ndarray = np.mean(known, axis=0) < DARK
    return dark if dark.any() else None


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(1e3 * seconds, 4)
