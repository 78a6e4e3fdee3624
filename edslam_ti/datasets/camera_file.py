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
from edslam_ti.lenses import MODELS, Lens, model_name

DISTORTION_LISTS = ("distortion", "distortion_coefficients", "dist")  # names of the same key
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
    distortion_model: str = Field("plumb_bob", max_length=40)
    """plumb_bob (k1 k2 p1 p2 k3), rational (also k4 k5 k6) or equidistant (k1 k2 k3 k4), OpenCV's."""
    distortion: list[float] = Field([], max_length=8)
    """Its coefficients in OpenCV's order; or one by one, below."""
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    depth_undistorted: bool = False
    """Depth images are undistorted already, in the pinhole camera without the distortion."""
    T_events_depth: list[float] | None = Field(None, min_length=16, max_length=16)
    """In a folder of depth images (--depth-dir): from the depth camera to the event camera, row by row."""
    description: str | None = None
    """One line about the recording, repeated in results, cut if long; a simulated one must say that it is."""

    @property
    def camera(self) -> Camera:
        """The pinhole camera with pixel centres at integers."""
        shift = 0.5 if self.pixel_centres == "half" else 0.0
        return Camera(self.width, self.height, self.fx, self.fy, self.cx - shift, self.cy - shift)

    @property
    def lens(self) -> Lens:
        """The camera with its distortion."""
        model = model_name(self.distortion_model)
        given = self.distortion
        if not given:
            names = MODELS[model][0].split()
            given = [getattr(self, name) for name in names]
        if model == "plumb_bob" and len(given) == 8:
            model = "rational"
        return Lens(self.camera, model, tuple(float(v) for v in given))

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
    for key in values:
        if key not in CameraFile.model_fields and len(key) <= LONGEST_KEY and key not in DISTORTION_LISTS:
            _check_key(path, key)
    for key in DISTORTION_LISTS[1:]:
        if key in values and "distortion" not in values:
            values["distortion"] = values.pop(key)
    if isinstance(values.get("distortion"), list) and not np.any(np.array(values["distortion"], object) != 0):
        values.pop("distortion")  # zeros, whatever their number
    if isinstance(values.get("description"), str):
        values["description"] = plain(values["description"])
    known = {
        k: int(v) if isinstance(v, float) and v.is_integer() and k in ("width", "height") else v
        for k, v in values.items()
        if k in CameraFile.model_fields
    }
    result = validated(known, str(path))
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


def _check_key(path: Path, key: str) -> None:
    """Refuse an unknown key that looks like a misspelt field."""
    close = difflib.get_close_matches(key.lower(), CameraFile.model_fields, n=1, cutoff=0.8)
    if close:
        raise DataError(f"{path}: unknown key '{plain(key)}'; did you mean '{close[0]}'?")


def validated(values: dict[str, Any], where: str) -> CameraFile:
    """Return a camera from its fields; raises DataError naming `where` and the first field that is wrong."""
    try:
        file = CameraFile.model_validate(values)
        file.lens  # noqa: B018  its own checks
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(str(part) for part in problem["loc"])
        raise DataError(f"{where}: {plain(name)}: {problem['msg']}, got {shown(problem['input'])}") from error
    except DataError as error:
        raise DataError(f"{where}: {error}") from error
    return file
