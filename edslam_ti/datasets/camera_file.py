"""camera.json: facts about camera, depth and clock that a recording's other files do not state.

It may contain any of the fields of `CameraFile`. For missing fields, EventReplica's own camera
(event_replica) or the layout's (rpg, rgbd) applies. Other keys belong to other programs and are ignored,
unless they look like a misspelt field.
"""

import difflib
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from edslam_ti.camera import LARGEST_SIDE, Camera
from edslam_ti.datasets.depth import DepthFormat
from edslam_ti.datasets.files import file_bytes
from edslam_ti.errors import DataError, plain, shown

DISTORTION_KEYS = ("distortion", "distortion_coefficients", "dist", "k1", "k2", "k3", "p1", "p2")
LONGEST_KEY = 40  # characters; longer keys are not compared with the fields' names


class CameraFile(BaseModel):
    """camera.json; the defaults are EventReplica's camera (IncEventGS, configs/SimuEvent)."""

    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    width: int = Field(768, ge=1, le=LARGEST_SIDE)
    height: int = Field(480, ge=1, le=LARGEST_SIDE)
    fx: float = Field(384.0, gt=0)
    fy: float = Field(384.0, gt=0)
    cx: float = 384.0
    cy: float = 240.0
    pixel_centres: Literal["integer", "half"] = "half"
    contrast_threshold: float | None = Field(None, ge=1e-3, le=10)
    """C of Eq. 11; also chooses among several event folders."""
    depth_scale: float = Field(1000.0, ge=1e-6, le=1e6)
    """Units of depth/*.png per metre (1000: millimetres); below 1, metres per unit (0.001: the same)."""
    invalid: float | None = None
    """Value in depth images, in their own units, that means no measurement, as 0 and the largest do."""
    depth_rate: float | None = Field(None, ge=1e-3, le=1e5)
    """Hz. If given, numbers in the names of depth images are indices, not milliseconds (event_replica)."""
    image_rate: float | None = Field(None, ge=1e-3, le=1e5)
    """Hz; the same for grey images."""
    exposure: float | None = Field(None, ge=0, lt=1)
    """Seconds over which an image integrates, centred on its time; 0: sharp."""
    frame_rate: float = Field(30.0, ge=1e-3, le=1e5)
    """Images per second, for layouts whose files have a number but no time (not EventReplica's)."""
    time_offset: float = Field(0.0, ge=-1e11, le=1e11)
    """Seconds to add to every stamp of the files for the recording's own clock (event_replica, generic)."""
    preset: str | None = Field(None, pattern=r"^[a-z0-9_]{1,40}$")
    """Data set whose settings (configs/<preset>.yaml) fit the recording (event_replica, generic)."""
    description: str | None = None
    """One line about the recording, repeated in results, cut if long; a simulated one must say that it is."""

    @property
    def camera(self) -> Camera:
        """The pinhole camera with pixel centres at integers."""
        shift = 0.5 if self.pixel_centres == "half" else 0.0
        return Camera(self.width, self.height, self.fx, self.fy, self.cx - shift, self.cy - shift)

    @property
    def metres_per_unit(self) -> float:
        return self.depth_scale if self.depth_scale < 1 else 1 / self.depth_scale

    def depth_format(self, units_per_metre: float | None = None) -> DepthFormat:
        """Return the meaning of depth values; a layout's own unit applies if none is stated."""
        if units_per_metre is None or "depth_scale" in self.model_fields_set:
            return DepthFormat(self.metres_per_unit, self.invalid)
        return DepthFormat(1 / units_per_metre, self.invalid)


def read_camera(path: Path) -> CameraFile:
    """Read camera.json; a missing file gives EventReplica's camera."""
    if not path.exists():
        return CameraFile()
    values = read_json(path)
    if not isinstance(values, dict):
        raise DataError(f'{path}: expected an object {{"width": 768, ...}}, got {type(values).__name__}')
    for key, value in values.items():
        if key not in CameraFile.model_fields and len(key) <= LONGEST_KEY:
            _check_key(path, key, value)
    if isinstance(values.get("description"), str):
        values["description"] = plain(values["description"])
    try:
        result = CameraFile.model_validate(
            {k: int(v) if isinstance(v, float) and v.is_integer() and k in ("width", "height") else v
             for k, v in values.items() if k in CameraFile.model_fields}
        )  # fmt: skip
        result.camera  # noqa: B018  its own checks
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(str(part) for part in problem["loc"])
        raise DataError(f"{path}: {name}: {problem['msg']}, got {shown(problem['input'])}") from error
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    if not (0 < result.cx < result.width and 0 < result.cy < result.height):
        raise DataError(
            f"{path}: expected the principal point inside the {result.width}x{result.height} image, got "
            f"cx = {result.cx}, cy = {result.cy}; give width, height, fx, fy, cx and cy together"
        )
    return result


def read_json(path: Path) -> Any:
    """Return the contents of a JSON file; no key may occur twice in an object."""
    try:
        text = file_bytes(path, "calibration").decode("utf-8-sig")
        return json.loads(text, object_pairs_hook=_without_repeats)
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: calibration not readable as JSON: not in UTF-8 ({error.reason})") from error
    except RecursionError as error:
        raise DataError(f"{path}: calibration not readable as JSON: nested too deeply") from error
    except ValueError as error:  # JSONDecodeError, repeated keys, integers of thousands of digits
        raise DataError(f"{path}: calibration not readable as JSON: {plain(error)}") from error


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise ValueError(f"the key '{plain(key, 60)}' occurs twice")
        result[key] = value
    return result


def _check_key(path: Path, key: str, value: object) -> None:
    """Refuse an unknown key that looks like a misspelt field, and any distortion except zero."""
    close = difflib.get_close_matches(key.lower(), CameraFile.model_fields, n=1, cutoff=0.8)
    if close:
        raise DataError(f"{path}: unknown key '{plain(key)}'; did you mean '{close[0]}'?")
    if key.lower() in DISTORTION_KEYS and value and np.any(np.asarray(value, object) != 0):
        raise DataError(f"{path}: '{key}': expected an undistorted camera; undistort the data first")
