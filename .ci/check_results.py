"""python .ci/check_results.py RESULT: fail unless a results folder is complete and its numbers make sense."""

import json
import sys
from pathlib import Path

FILES = [
    *("trajectory_tum.txt", "trajectory.png", "map.ply", "mesh.ply", "points.ply"),
    *("config.yaml", "metrics.json", "log.txt", "flythrough.mp4", "renders/contact.png", "renders/views.csv"),
]
KEYS = [
    *("dataset", "scene", "method", "protocol", "device"),
    *("ate_rmse_cm", "ate_mean_cm", "ate_rmse_sim3_cm", "rpe_trans_cm", "rpe_rot_deg"),
    *("psnr_db", "psnr_corrected_db", "ssim_corrected", "lpips_corrected", "depth_l1_cm"),
    *("psnr_novel_corrected_db", "mesh_accuracy_cm", "mesh_completion_ratio_5cm", "ate_frontend_rmse_cm"),
    *("num_frames", "num_lost_frames", "num_gaussians", "num_events"),
    *("tracking_hz", "total_fps", "wall_s", "peak_memory_mb"),
]
# Far from the targets, which are measured on whole runs: a short one with few iterations must just work.
MAX_ATE_CM = 3.0
MIN_PSNR_DB = 12.0


def problems(folder: Path) -> list[str]:
    """Return what is wrong with the folder."""
    found = [f"{name} is missing or empty" for name in FILES if not _has_content(folder / name)]
    if not list((folder / "renders").glob("*.png")):
        found.append("renders/ holds no picture")
    if found:
        return found
    metrics = json.loads((folder / "metrics.json").read_text())
    found += [f"metrics.json lacks {key}" for key in KEYS if key not in metrics]
    found += [f"{key} is null" for key in KEYS if metrics.get(key, 0) is None and key != "lpips_corrected"]
    if found:
        return found
    if not metrics["ate_rmse_cm"] <= MAX_ATE_CM:
        found.append(f"ate_rmse_cm: expected at most {MAX_ATE_CM}, got {metrics['ate_rmse_cm']}")
    if not metrics["psnr_corrected_db"] >= MIN_PSNR_DB:
        found.append(
            f"psnr_corrected_db: expected at least {MIN_PSNR_DB}, got {metrics['psnr_corrected_db']}"
        )
    if metrics["num_lost_frames"]:
        found.append(f"num_lost_frames: expected 0, got {metrics['num_lost_frames']}")
    leftovers = [path.name for path in folder.resolve().parent.rglob("*.partial*")]
    found += [f"half-written {name} was left behind" for name in leftovers]
    return found


def _has_content(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


if __name__ == "__main__":
    wrong = problems(Path(sys.argv[1]))
    print("\n".join(wrong) or "results are complete")
    sys.exit(1 if wrong else 0)
