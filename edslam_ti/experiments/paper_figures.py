"""The paper's figures 3 to 5 from finished runs: renders of rooms, trajectories, renders of recordings."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edslam_ti.experiments.paper_views import ShownGroup
from edslam_ti.results.pictures import new_figure, save_figure
from edslam_ti.results.plots import colours

PANEL = 2.4  # inches, width of a render
ZOOM = 0.6  # of the true path's size is shown around it: a lost method's path leaves the picture


def write_figures(groups: Sequence[ShownGroup], out: Path) -> list[Path]:
    """Write fig3.png, fig4.png and fig5.png where there is something to show; return what was written."""
    written = []
    for name, chosen in (
        ("fig3.png", [g for g in groups if g.dataset == "builtin"]),
        ("fig5.png", [g for g in groups if g.dataset != "builtin"]),
    ):
        shown = [group for group in chosen if group.times()]
        if shown:
            _draw_renders(out / name, shown)
            written.append(out / name)
    with_truth = [group for group in groups if group.truth is not None]
    if with_truth:
        _draw_paths(out / "fig4.png", with_truth)
        written.append(out / "fig4.png")
    return written


def _draw_renders(path: Path, groups: Sequence[ShownGroup]) -> None:
    """Draw the middle held-out view of every recording: the truth, then every method's render."""
    methods = list(dict.fromkeys(run.method for group in groups for run in group.runs if run.views()))
    height = PANEL * 0.72 * len(groups) + 0.4
    figure = new_figure(PANEL * (1 + len(methods)), height)
    axes = figure.subplots(len(groups), 1 + len(methods), squeeze=False)
    for row, group in zip(axes, groups):
        times = group.times()
        time = times[len(times) // 2]
        views = {run.method: v for run in group.runs for v in run.views() if v.timestamp == time}
        for ax in row:
            ax.set(xticks=[], yticks=[])
        truth = next((v.panels()[0] for v in views.values() if v.psnr_db is not None), None)
        if truth is not None:
            row[0].imshow(truth)
        else:
            row[0].text(0.5, 0.5, "no true image", ha="center", va="center")
        row[0].set_ylabel(f"{group.scene}, t = {time:.2f} s\n{group.kind}", fontsize=7)
        for ax, method in zip(row[1:], methods):
            view = views.get(method)
            if view is None:
                ax.text(0.5, 0.5, "no render", ha="center", va="center", transform=ax.transAxes)
                continue
            ax.imshow(view.panels()[1])
            if view.psnr_db is not None:
                ax.set_xlabel(f"{view.psnr_db:.1f} dB", fontsize=7)
    for ax, title in zip(axes[0], ["truth", *methods]):
        ax.set_title(title, fontsize=8)
    save_figure(figure, path)


def _draw_paths(path: Path, groups: Sequence[ShownGroup]) -> None:
    """Draw the paths of every recording in the plane of its two longest axes, aligned by SE(3)."""
    columns = min(3, len(groups))
    rows = -(-len(groups) // columns)
    figure = new_figure(4.6 * columns, 4.0 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    methods = list(dict.fromkeys(run.method for group in groups for run in group.runs))
    colour_of = dict(zip(methods, colours()))
    for ax, group in zip(axes, groups):
        assert group.truth is not None
        middle, main = group.plane()
        true = (group.truth.poses[:, :3, 3] - middle) @ main[:2].T
        ax.plot(*true.T, color="black", linewidth=1.4, label="truth")
        for run in group.runs:
            positions, errors = run.aligned()
            x, y = ((positions - middle) @ main[:2].T).T
            known = errors[np.isfinite(errors)]
            ate = f" {np.sqrt((known**2).mean()):.2f} cm" if len(known) else ""
            ax.plot(x, y, color=colour_of[run.method], linewidth=1, label=run.method + ate)
        low, high = true.min(0), true.max(0)
        margin = ZOOM * max((high - low).max(), 1e-3) / 2
        ax.set_xlim(low[0] - margin, high[0] + margin)
        ax.set_ylim(low[1] - margin, high[1] + margin)
        ax.set_aspect("equal")
        ax.set_title(f"{group.scene}\n{group.data}", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=6, framealpha=0.8)
    for ax in axes[len(groups) :]:
        ax.set_axis_off()
    save_figure(figure, path)
