"""What a run found of its event sensor: numbers for metrics.json, lines, and a picture."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edslam_ti.event_images.contrast import ContrastThreshold
from edslam_ti.event_images.sensor import EDGES, SensorEstimate
from edslam_ti.results.pictures import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LISTED = 100  # hot pixels


def sensor_metrics(estimate: SensorEstimate, contrast: ContrastThreshold | None) -> dict[str, Any]:
    """Return the group `sensor` of metrics.json; None where the recording does not tell."""
    by_polarity = estimate.shortest_by_polarity or (None, None)
    deviations = None if contrast is None else contrast.deviations
    return {
        "dead_time_ms": _milliseconds(estimate.dead_time),
        "shortest_interval_ms": _milliseconds(estimate.shortest_interval),
        "shortest_same_polarity_ms": _milliseconds(by_polarity[0]),
        "shortest_other_polarity_ms": _milliseconds(by_polarity[1]),
        "share_within_two_dead_times": round(estimate.short_share, 4),
        "noise_rate_hz": _rounded(estimate.noise_rate),
        "noise_positive_share": _rounded(estimate.noise_positive_share),
        "positive_share": _rounded(estimate.positive_share),
        "num_hot_pixels": len(estimate.hot_pixels),
        "hot_pixels_xy": estimate.hot_pixels[:MOST_LISTED].tolist(),
        "threshold_positive": None if contrast is None else _rounded(contrast.positive),
        "threshold_negative": None if contrast is None else _rounded(contrast.negative),
        "threshold_positive_deviation": None if deviations is None else _rounded(deviations[0]),
        "threshold_negative_deviation": None if deviations is None else _rounded(deviations[1]),
        "num_events_examined": estimate.num_events,
        "seconds_examined": _rounded(estimate.duration),
    }


def sensor_lines(estimate: SensorEstimate, contrast: ContrastThreshold | None) -> list[str]:
    """Return what is known of the sensor, a line each."""
    dead, noise = estimate.dead_time, estimate.noise_rate
    lines = [
        "no sign of a dead time"
        if dead is None
        else f"dead time {1e3 * dead:.3g} ms ({estimate.short_share:.1%} of the intervals below twice that)",
        "noise not measurable: no pixel has quiet neighbours"
        if noise is None
        else f"noise at most {noise:.2g} Hz a pixel",
        f"{len(estimate.hot_pixels)} hot pixels, {estimate.positive_share:.1%} of the events brighter",
    ]
    if contrast is not None and contrast.deviations is not None:
        pairs = zip((contrast.positive, contrast.negative), contrast.deviations)
        plus, minus = (f"{value:.3f} +- {deviation:.3f}" for value, deviation in pairs)
        lines.append(f"C+ {plus}, C- {minus} (images)")
    return lines


def plot_sensor(estimate: SensorEstimate, contrast: ContrastThreshold | None, path: Path) -> None:
    """Draw the intervals between events of a pixel, and the number of events of each pixel."""
    figure = new_figure(11, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.15))
    _draw_intervals(left, estimate)
    height, width = estimate.numbers.shape
    rate = estimate.numbers / max(estimate.duration, 1e-9)
    shown = right.imshow(np.log10(np.maximum(rate, 0.5)), cmap="magma", interpolation="nearest")
    figure.colorbar(shown, ax=right, label="log10 of events a second", fraction=0.04, pad=0.02)
    if len(estimate.hot_pixels):
        right.scatter(*estimate.hot_pixels.T, s=60, facecolors="none", edgecolors="cyan", label="hot pixel")
        right.legend(fontsize=8, loc="lower right")
    right.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    right.set_title("events of each pixel", fontsize=10)
    figure.suptitle("; ".join(sensor_lines(estimate, contrast)), fontsize=9)
    save_figure(figure, path)


def _draw_intervals(ax: "Axes", estimate: SensorEstimate) -> None:
    middle = 1e3 * np.sqrt(EDGES[1:] * EDGES[:-1])
    for counts, label, colour in zip(
        estimate.histograms, ("same polarity", "other polarity"), ("#0072B2", "#D55E00")
    ):
        ax.step(middle, counts, where="mid", label=label, color=colour)
    if estimate.dead_time is not None:
        ax.axvline(1e3 * estimate.dead_time, color="black", linestyle="--", label="dead time")
    ax.set(xscale="log", yscale="symlog", xlim=(1e-2, 1e3), ylim=(0, None))
    ax.set(xlabel="ms since the pixel's last event", ylabel="number of events")
    ax.set_title("intervals at a pixel", fontsize=10)
    ax.legend(fontsize=8)


def _milliseconds(seconds: float | None) -> float | None:
    return None if seconds is None else round(1e3 * seconds, 4)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 4)
