"""Where pixels stand when a recording begins."""

from types import SimpleNamespace

import numpy as np

from edslam_ti.event_images.start_bias import LEAKED, start_bias
from edslam_ti.events import Events

SHAPE = (40, 50)
C = 0.2


def found(pending: float) -> float:  # thresholds of brighter events, largest at the start
    """Return the bias of pixels that change steadily, half of them up, half of them down."""
    rng = np.random.default_rng(0)
    rate = rng.normal(0, 10, SHAPE)  # 1/s
    before = pending * C * rng.random(SHAPE)
    rows: list[tuple[int, int, float, float]] = []
    for y in range(SHAPE[0]):
        for x in range(SHAPE[1]):
            slope, first = float(rate[y, x]), float(before[y, x])
            wait = (C - first) / slope if slope > 0 else (C + first) / -slope
            times = np.arange(wait, 0.1, C / abs(slope)).tolist()
            rows += [(x, y, t, 1.0 if slope > 0 else -1.0) for t in times]
    u, v, time, polarity = np.array(sorted(rows, key=lambda r: r[2])).T
    events = Events(u.astype(np.int16), v.astype(np.int16), time, polarity.astype(np.int8))
    camera = SimpleNamespace(shape=SHAPE)
    return start_bias(SimpleNamespace(events=events.between, camera=camera), 0.0, (1.0, 1.0))  # type: ignore[arg-type]


def test_pixels_that_have_leaked_are_seen() -> None:
    assert found(pending=1.0) == LEAKED


def test_pixels_that_start_at_their_reference_have_no_bias() -> None:
    assert found(pending=0.0) == 0.0
