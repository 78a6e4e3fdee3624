"""Depth images of a ROS bag, written once into the user's cache, one file each, so that any can be read.

    <cache>/depth/<hash>/<seconds>.png    16 bits, mm

The hash is that of the bag's path, size and modification time and of the topic. A folder appears when it is
complete. What a killed process leaves is removed by the next one.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from edslam_ti.cache import cached
from edslam_ti.datasets.files import timed_files
from edslam_ti.errors import DataError
from edslam_ti.event_files.bags import bag_images, bag_topics
from edslam_ti.output import atomic_folder

MILLIMETRES = 1000
SLOW = 50_000_000  # bytes; longer bags show a bar


def depth_of_bag(bag: Path, topic: str) -> tuple[np.ndarray, list[Path]]:  # [D] s, D PNG files in mm
    """Return the depth images of a topic; `DataError` where the bag has none or they are no depth."""
    status = bag.stat()
    key = f"{bag.resolve()} {status.st_size} {status.st_mtime_ns} {topic}"
    folder = cached(Path("depth") / hashlib.sha256(key.encode()).hexdigest()[:16])
    if not folder.is_dir():
        with atomic_folder(folder) as made, _counted(bag) as show:
            number = 0
            for time, image in bag_images(bag, topic):
                path = made / f"{time:.9f}.png"
                if not cv2.imwrite(str(path), _millimetres(image, f"{bag} ({topic})")):
                    raise DataError(f"{path}: could not be written; is the disk full?")
                number += 1
                show(number)
            if number == 0:
                raise DataError(f"{bag} ({topic}): expected depth images, got none")
    return timed_files(folder, (".png",))


def depth_topic(bag: Path) -> str | None:
    """Return the topic whose name says depth and that holds images; None: there is none."""
    topics = [topic for topic, kind in bag_topics(bag).items() if kind == "image" and "depth" in topic]
    return min(topics, key=len) if topics else None


def _millimetres(image: np.ndarray, what: str) -> np.ndarray:  # [H, W] uint16
    if image.dtype == np.uint16 and image.ndim == 2:
        return image  # by convention (REP 118) 16 bits are millimetres
    if image.dtype != np.float32 or image.ndim != 2:
        raise DataError(
            f"{what}: expected depth of 16 bits or float, got {image.dtype} of shape {image.shape}"
        )
    units = np.rint(np.nan_to_num(image, nan=0, posinf=0, neginf=0) * np.float32(MILLIMETRES))
    return np.where((units > 0) & (units < np.iinfo(np.uint16).max), units, 0).astype(np.uint16)


@contextmanager
def _counted(bag: Path) -> Iterator[Callable[[int], None]]:
    """Show how many images of a large bag were written."""
    if bag.stat().st_size < SLOW:
        yield lambda number: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task(f"depth images of {escape(bag.name)} (first use)", total=None)
        yield lambda number: bar.update(
            task, completed=number, description=f"{number} depth images of {escape(bag.name)}"
        )
