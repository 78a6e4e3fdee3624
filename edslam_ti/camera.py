"""Pinhole camera with pixel centres at integer coordinates: x right, y down, z forward."""

from dataclasses import dataclass

import numpy as np

from edslam_ti.errors import DataError, plain

LARGEST_SIDE = 32767  # pixels; events hold 16-bit coordinates
SHORTEST_FOCAL, LONGEST_FOCAL = (
    1e-3,
    1e3,
)  # longer sides; beyond any fisheye, any telescope
FLATTEST_PIXEL = 5.0  # height over width or width over height; a sensor read out in every 4th row has 4
USUAL_FLATNESS = 1.5  # beyond, it is said
USUAL_CENTRE = 0.25  # of a side: the principal point is usually nearer to the middle
FARTHEST_CENTRE = 10  # longer sides; cut-outs have their centre outside

NEAREST = 0.05  # metres: points nearer than this do not count as in view


@dataclass(frozen=True)
class Camera:
    """Undistorted pinhole intrinsics in pixels; (0, 0) is the centre of the top left pixel."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not (1 <= self.width <= LARGEST_SIDE and 1 <= self.height <= LARGEST_SIDE):
            raise DataError(
                f"camera: expected a size of 1 to {LARGEST_SIDE} pixels, got "
                f"{plain(self.width, 20)}x{plain(self.height, 20)}"
            )
        values = (self.fx, self.fy, self.cx, self.cy)
        if not all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise DataError(
                f"camera: expected finite fx, fy, cx, cy with positive focal lengths, got {values}"
            )
        side = max(self.width, self.height)
        low, high = SHORTEST_FOCAL * side, LONGEST_FOCAL * side
        if not (low <= self.fx <= high and low <= self.fy <= high):
            raise DataError(
                f"camera: expected focal lengths in pixels, {low:.3g} to {high:.3g} for {self.width}x"
                f"{self.height} pixels (a usual lens has half to twice the width), got fx = {self.fx:g}, "
                f"fy = {self.fy:g}"
            )
        if not 1 / FLATTEST_PIXEL <= self.fx / self.fy <= FLATTEST_PIXEL:
            raise DataError(
                f"camera: expected fx and fy of one lens, at most {FLATTEST_PIXEL:g} times each other, got "
                f"fx = {self.fx:g}, fy = {self.fy:g}; state both, and the size and centre that go with them"
            )
        if abs(self.cx) > FARTHEST_CENTRE * side or abs(self.cy) > FARTHEST_CENTRE * side:
            raise DataError(
                f"camera: expected the principal point near the {self.width}x{self.height} image, got "
                f"cx = {self.cx:g}, cy = {self.cy:g}"
            )

    @property
    def oddities(self) -> list[str]:
        """One line for each value that is possible, but of no usual camera."""
        lines = []
        flatness = max(self.fx / self.fy, self.fy / self.fx)
        if flatness > USUAL_FLATNESS:
            lines.append(
                f"camera: fx = {self.fx:g} and fy = {self.fy:g} mean pixels {flatness:.2g} times as long as "
                "wide; check them"
            )
        for name, value, side in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if abs(value / side - 0.5) > USUAL_CENTRE:
                lines.append(
                    f"camera: {name} = {value:g} is far from the middle of {side} pixels; is the image a "
                    "part of another, or is the principal point wrong?"
                )
        return lines

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of its images."""
        return self.height, self.width

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy)."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def matrix(self) -> np.ndarray:  # [3, 3]
        """The intrinsic matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def downscaled(self, factor: int) -> "Camera":
        """Return the camera of an image averaged over factor x factor blocks (odd edges cut off)."""
        # Block k covers pixels factor*k .. factor*k + factor - 1, whose centre is factor*k + (factor-1)/2.
        shift = (factor - 1) / 2
        return Camera(
            self.width // factor,
            self.height // factor,
            self.fx / factor,
            self.fy / factor,
            (self.cx - shift) / factor,
            (self.cy - shift) / factor,
        )

    def rays(self) -> np.ndarray:  # [H, W, 3]
        """Return the viewing ray of every pixel, scaled to z = 1 (point = depth * ray)."""
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
        return self.back_project_pixels(u, v, np.ones_like(u))

    def project(
        self,
        points: np.ndarray,  # [..., 3] metres, camera frame
        nearest: float = 1e-6,  # metres
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # [...] each
        """Return the pixels u and v of points, and their depths z in metres.

        No point is removed: pixels may lie outside the image. Points at a depth below `nearest`, including
        those behind the camera, are divided by `nearest` instead of their depth. Callers select by z.
        """
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        divisor = np.maximum(z, nearest)
        return self.fx * x / divisor + self.cx, self.fy * y / divisor + self.cy, z

    def back_project(
        self,
        depth: np.ndarray,  # [H, W] metres
        mask: np.ndarray | None = None,  # [H, W] bool; None: where there is depth
    ) -> np.ndarray:  # [N, 3] metres, camera frame
        """Return the points of a depth image's pixels, row by row."""
        if depth.shape != self.shape:
            raise DataError(f"depth: expected shape {self.shape}, got {depth.shape}")
        v, u = np.nonzero(depth > 0 if mask is None else mask)
        return self.back_project_pixels(u, v, depth[v, u])

    def back_project_pixels(
        self,
        u: np.ndarray,  # [...] pixels, fractions allowed
        v: np.ndarray,  # [...] pixels
        depth: np.ndarray,  # [...] metres
    ) -> np.ndarray:  # [..., 3] metres, camera frame
        """Return the points at pixels (u, v) and these depths."""
        return np.stack([(u - self.cx) / self.fx * depth, (v - self.cy) / self.fy * depth, depth], -1)
