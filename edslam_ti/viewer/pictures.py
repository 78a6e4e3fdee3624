"""Pictures of a moment of a run: events, depth, brightness."""

import cv2
import numpy as np

from edslam_ti.events import Events

POSITIVE, NEGATIVE = (0, 114, 178), (213, 94, 0)  # colour-blind safe (Okabe and Ito)
MOST_EVENTS = 200_000  # of the newest, in a picture
WIDEST = 480  # pixels: larger images are reduced


def event_picture(events: Events, shape: tuple[int, int]) -> np.ndarray:  # [H, W, 3] uint8
    """Return the newest events in two colours on white."""
    picture = np.full((*shape, 3), 255, np.uint8)
    newest = slice(max(0, len(events) - MOST_EVENTS), None)
    x, y, polarity = events.x[newest], events.y[newest], events.polarity[newest]
    for sign, colour in ((1, POSITIVE), (-1, NEGATIVE)):
        chosen = polarity == sign
        picture[y[chosen], x[chosen]] = colour
    return reduced(picture)


def depth_picture(depth: np.ndarray) -> np.ndarray:  # [H, W] metres -> [h, w, 3] uint8
    """Return depth from dark (near) to bright (far), white where there is none."""
    depth = depth[:: _step(depth), :: _step(depth)]
    known = depth[depth > 0]
    near, far = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    scaled = np.clip((depth - near) / max(far - near, 1e-3), 0, 1)
    picture = np.asarray(cv2.applyColorMap(np.rint(255 * scaled).astype(np.uint8), cv2.COLORMAP_VIRIDIS))
    picture = picture[..., ::-1].copy()
    picture[depth <= 0] = 255
    return picture


def grey_picture(image: np.ndarray) -> np.ndarray:  # [H, W] in [0, 1] -> [h, w, 3] uint8
    """Return brightness as a picture."""
    grey = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return reduced(np.repeat(grey[..., None], 3, axis=2))


def brightness_picture(log_brightness: np.ndarray) -> np.ndarray:  # [H, W] -> [h, w, 3] uint8
    """Return log brightness of unknown level, its brightest percent white."""
    image = np.exp(log_brightness - np.percentile(log_brightness, 99))
    return grey_picture(image)


def reduced(picture: np.ndarray) -> np.ndarray:  # [H, W, 3]
    """Return a picture at most `WIDEST` pixels wide."""
    height, width = picture.shape[:2]
    if width <= WIDEST:
        return picture
    size = (WIDEST, max(1, round(height * WIDEST / width)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _step(image: np.ndarray) -> int:
    return max(1, image.shape[1] // WIDEST)
