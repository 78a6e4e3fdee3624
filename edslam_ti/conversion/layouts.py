"""Writes a sequence in one of our own layouts: the same data to the bit, so the same trajectory.

Stamps stay those of the sequence. If its recording's own clock is another one (a late one is shifted),
camera.json states the seconds to add as `time_offset`, so that no digit is lost.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edslam_ti.conversion.events import ColumnWriter, RowWriter, slices
from edslam_ti.conversion.pictures import depth_units, exact_scale, write_depth, write_grey
from edslam_ti.datasets.base import EventDepthSequence
from edslam_ti.datasets.event_recording import EventRecording
from edslam_ti.errors import DataError, plain
from edslam_ti.output import atomic_folder, check_replaceable, title_of

TITLE = "Converted recording"  # how README.txt begins
FILES = (
    *("README.txt", "camera.json", "depth.txt", "images.txt", "poses_ts.txt", "traj.txt", "surfaces.ply"),
    *("imu.txt", "depth/timestamps.txt", "images/timestamps.txt", "Depth_exr/timestamps.txt"),
    *("novel_views/traj.txt", "events/x.npy", "events/y.npy", "events/t.npy", "events/p.npy"),
)
PICTURES = ("depth", "images", "Depth_exr", "novel_views/depth", "novel_views/images")
LOOKED_AT = 5  # depth images that a unit is sought for
SHARES = (0.7, 0.85)  # of the work that is done after the events, and after depth

Progress = Callable[[float], None]  # receives the share done, 0 to 1


@dataclass(frozen=True)
class Summary:
    """What was written."""

    folder: Path
    num_events: int
    num_depth_images: int
    num_images: int
    notes: tuple[str, ...]


def convert(sequence: EventDepthSequence, out: Path, layout: str, progress: Progress) -> Summary:
    """Write a sequence to the folder `out` in a layout of `LAYOUTS`.

    `out` is a new or an empty folder, or an older conversion, which is replaced; it gets its name when it is
    complete. Raises `DataError` for what the layout cannot hold.
    """
    if layout not in LAYOUTS:
        raise DataError(f"layout: expected one of {', '.join(LAYOUTS)}, got '{plain(layout)}'")
    check_replaceable(out, why_not_a_conversion)
    with atomic_folder(out, why_not_a_conversion) as folder:
        writer = LAYOUTS[layout](sequence, folder)
        return Summary(out, *writer.write(progress), tuple(writer.notes))


class GenericWriter:
    """The layout `generic`: columns of events, depth.txt, images.txt; a file of its own for every image."""

    layout = "generic"

    def __init__(self, sequence: EventDepthSequence, folder: Path) -> None:
        self.sequence, self.folder = sequence, folder
        self.notes: list[str] = []
        self._scale = exact_scale(_some_depth(sequence))

    def write(self, progress: Progress) -> tuple[int, int, int]:
        """Write everything; return the numbers of events, depth images and images."""
        num_events = self._write_events(lambda share: progress(SHARES[0] * share))
        num_depth = self._write_depth(lambda s: progress(SHARES[0] + (SHARES[1] - SHARES[0]) * s))
        num_images = self._write_images(lambda s: progress(SHARES[1] + (1 - SHARES[1]) * s))
        self._write_truth()
        self._write_imu()
        self._write_descriptions()
        progress(1.0)
        return num_events, num_depth, num_images

    def _write_events(self, progress: Progress) -> int:
        if not self.sequence.has_events:
            return 0
        with ColumnWriter(self.folder / "events") as writer:
            for events, share in slices(self.sequence):
                writer.append(events)
                progress(share)
        return writer.count

    def _write_depth(self, progress: Progress) -> int:
        times, lines = self.sequence.depth_timestamps, []
        if len(times) == 0:
            return 0
        (self.folder / "depth").mkdir()
        for k, t in enumerate(times):
            depth = self._readable(self.sequence.depth, k, t, "depth")
            if depth is not None:
                name = write_depth(self.folder / "depth", f"{k:06d}", depth, self._scale)
                lines.append(f"{float(t)!r} depth/{name}\n")
            progress((k + 1) / len(times))
        (self.folder / "depth.txt").write_text("# stamp [s] path\n" + "".join(lines))
        return len(lines)

    def _write_images(self, progress: Progress) -> int:
        times, lines = self.sequence.image_timestamps, []
        if len(times) == 0:
            return 0
        (self.folder / "images").mkdir()
        for k, t in enumerate(times):
            image = self._readable(self.sequence.image, k, t, "image")
            if image is not None:
                name = write_grey(self.folder / "images", f"{k:06d}", image)
                lines.append(f"{float(t)!r} images/{name}\n")
            progress((k + 1) / len(times))
        (self.folder / "images.txt").write_text("# stamp [s] path\n" + "".join(lines))
        return len(lines)

    def _readable(self, read: Callable[[int], np.ndarray], k: int, t: float, what: str) -> np.ndarray | None:
        """Return an image, None with a note where it cannot be read."""
        try:
            return read(k)
        except (DataError, OSError) as error:
            own = t + self.sequence.time_offset
            self.notes.append(f"{what} at {own:.6f} s is left out: {plain(error)}")
            return None

    def _write_truth(self) -> None:
        sequence, folder = self.sequence, self.folder
        if sequence.truth is not None:
            stamps = "".join(f"{float(t)!r}\n" for t in sequence.truth.timestamps)
            (folder / "poses_ts.txt").write_text(stamps)
            rows = (" ".join(repr(float(v)) for v in T.ravel()) for T in sequence.truth.poses)
            (folder / "traj.txt").write_text("".join(f"{row}\n" for row in rows))
        if sequence.surfaces_file is not None:
            shutil.copyfile(sequence.surfaces_file, folder / "surfaces.ply")
        self._write_novel_views()

    def _write_imu(self) -> None:
        imu = self.sequence.imu
        if imu is None:
            return
        rows = np.concatenate([imu.timestamps[:, None], imu.angular_velocity, imu.acceleration], 1)
        lines = (" ".join(repr(float(v)) for v in row) + "\n" for row in rows)
        (self.folder / "imu.txt").write_text("# t gx gy gz ax ay az, s, rad/s, m/s^2\n" + "".join(lines))

    def _write_novel_views(self) -> None:
        views = self.sequence.novel_views()
        if not views:
            return
        folder = self.folder / "novel_views"
        if self._scale is None or any(depth_units(v.depth, self._scale) is None for v in views):
            self.notes.append("novel views are left out: their depth does not fit 16-bit images exactly")
            return
        for name in ("images", "depth"):
            (folder / name).mkdir(parents=True)
        for view in views:
            stem = f"frame{round(1000 * view.timestamp):06d}"
            write_depth(folder / "depth", stem, view.depth, self._scale)
            write_grey(folder / "images", stem, view.image)
        rows = (" ".join(repr(float(v)) for v in view.T_world_camera.ravel()) for view in views)
        (folder / "traj.txt").write_text("".join(f"{row}\n" for row in rows))

    def _write_descriptions(self) -> None:
        sequence, camera = self.sequence, self.sequence.camera
        has_lens = not isinstance(sequence, EventRecording) or sequence.has_lens
        names = ("width", "height", "fx", "fy", "cx", "cy") if has_lens else ("width", "height")
        if not has_lens:
            self.notes.append("the lens is not known: state fx, fy, cx and cy in camera.json (--intrinsics)")
        if len(sequence.depth_timestamps) == 0:
            self.notes.append("there is no depth: give depth.txt and depth/ (docs/my_camera.md) to run on it")
        values = {
            **{name: getattr(camera, name) for name in names},
            "pixel_centres": "integer",
            "contrast_threshold": sequence.contrast_threshold,
            "depth_scale": self._scale,
            "exposure": sequence.exposure,
            "preset": sequence.preset
            or (sequence.dataset if sequence.dataset not in (*LAYOUTS, "events") else None),
            "time_offset": sequence.time_offset or None,
            "description": sequence.description,
        }
        known = {key: value for key, value in values.items() if value is not None}
        (self.folder / "camera.json").write_text(json.dumps(known, indent=1) + "\n")
        lines = [
            f"{TITLE}, layout '{self.layout}' (docs/data.md), from a recording in the layout "
            f"'{sequence.dataset}': {sequence.description}.",
            "Events, depth and images are undistorted, in the camera of camera.json; values are those of the "
            "original to the bit.",
        ]
        if sequence.time_offset:
            lines.append(f"Add {sequence.time_offset!r} s to every stamp to get the recording's own clock.")
        (self.folder / "README.txt").write_text("\n".join([*lines, *self.notes]) + "\n")


class EventReplicaWriter(GenericWriter):
    """The layout `event_replica`: rows of events; depth is PNG throughout, or OpenEXR throughout."""

    layout = "event_replica"

    def __init__(self, sequence: EventDepthSequence, folder: Path) -> None:
        super().__init__(sequence, folder)
        for what, there in (("events", sequence.has_events), ("depth", len(sequence.depth_timestamps) > 0)):
            if not there:
                raise DataError(
                    f"{sequence.scene}: the layout event_replica needs {what}, and this recording has none; "
                    "convert it to generic"
                )

    def _write_imu(self) -> None:
        if self.sequence.imu is not None:
            self.notes.append("inertial measurements are left out: event_replica has no place for them")

    def _write_events(self, progress: Progress) -> int:
        threshold = self.sequence.contrast_threshold
        name = "unknown" if threshold is None else repr(float(threshold))
        folder = self.folder / f"event_threshold_{name}"
        folder.mkdir()
        with RowWriter(folder / "gray_events_data.npy") as writer:
            for events, share in slices(self.sequence):
                writer.append(events)
                progress(share)
        return writer.count

    def _write_depth(self, progress: Progress) -> int:
        number = super()._write_depth(progress)
        if any((self.folder / "depth").glob("*.exr")) and any((self.folder / "depth").glob("*.png")):
            shutil.rmtree(self.folder / "depth")
            self._scale = None
            number = super()._write_depth(progress)
        name = "Depth_exr" if any((self.folder / "depth").glob("*.exr")) else "depth"
        (self.folder / "depth").rename(self.folder / name)
        self._name_frames("depth.txt", self.folder / name)
        return number

    def _write_images(self, progress: Progress) -> int:
        number = super()._write_images(progress)
        if number:
            self._name_frames("images.txt", self.folder / "images")
        return number

    def _name_frames(self, table: str, folder: Path) -> None:
        """Turn a list 'stamp path' into timestamps.txt of a folder, and name its files frameNNNNNN."""
        lines = []
        for line in (self.folder / table).read_text().splitlines()[1:]:
            stamp, path = line.split()
            old = folder / Path(path).name
            old.rename(old.with_name(f"frame{old.name}"))
            lines.append(f"frame{old.name} {stamp}\n")
        (folder / "timestamps.txt").write_text("".join(lines))
        (self.folder / table).unlink()


LAYOUTS: dict[str, type[GenericWriter]] = {"generic": GenericWriter, "event_replica": EventReplicaWriter}


def _some_depth(sequence: EventDepthSequence) -> list[np.ndarray]:
    """Return a few readable depth images."""
    number = len(sequence.depth_timestamps)
    found = []
    for k in np.unique(np.linspace(0, number - 1, LOOKED_AT).astype(int)) if number else ():
        try:
            found.append(sequence.depth(int(k)))
        except (DataError, OSError):
            continue
    return found


def why_not_a_conversion(folder: Path) -> str | None:
    """Return what shows that a folder is not, or not only, a converted recording; None: it is one."""
    if title_of(folder, len(TITLE)) != TITLE:
        return "holds something else than a converted recording"
    for path in sorted(folder.rglob("*")):
        name, parent = (p.relative_to(folder).as_posix() for p in (path, path.parent))
        is_known = (
            name in FILES
            or (parent in PICTURES and path.suffix in (".png", ".exr"))
            or path.match("event_threshold_*/gray_events_data.npy")
        )
        is_plain = path.is_file() and not path.is_symlink()
        if (path.is_symlink() or not path.is_dir()) and not (is_known and is_plain):
            return f"holds '{name}' beside a converted recording"
    return None
