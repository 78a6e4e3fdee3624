"""Numbers that others have published: where they stand, what data they are of, how paths were aligned.

ED-SLAM's paper does not say how it aligned trajectories, nor what it ran SplaTAM and IncEventGS on beyond the
names of the recordings. Many numbers of other papers were read in a collection of published results
(github.com/boragunes/event_world, commit 55c115a), not in the papers; `source` says so by "via EW".
"""

from dataclasses import dataclass

FULL, SLICES = "full", "inceventgs"  # protocols: whole run and SE(3); IncEventGS's slices and Sim(3)
REPLICA, VECTOR = "EventReplica", "VECtor"
PAPER = "ED-SLAM paper"
ROOMS = ("room0", "room2", "office0", "office2", "office3")
VECTOR_SCENES = ("desk_normal", "robot_normal", "sofa_normal", "hdr_normal")
PAPER_SCENES = (*ROOMS, *VECTOR_SCENES)
UNKNOWN_ALIGNMENT = "not stated"


@dataclass(frozen=True)
class Published:
    """One system's number on one recording."""

    system: str
    scene: str
    measure: str  # as in metrics.json: ate_rmse_cm, psnr_corrected_db, ssim, lpips
    value: float
    protocol: str  # the one of ours that it is nearest to
    data: str
    alignment: str  # of the trajectory
    source: str


def dataset_of(scene: str) -> str:
    """Return the data set that the paper's scene belongs to."""
    return REPLICA if scene in ROOMS else VECTOR


# --- the paper ---

# Table IV: ATE in cm, in the order of PAPER_SCENES.
TABLE_4 = {
    "IncEventGS": (3.75, 0.84, 5.48, 2.38, 1.58, 2.16, 5.62, 8.78, 2.15),
    "SplaTAM": (2.67, 1.54, 1.48, 1.71, 1.58, 0.75, 3.47, 5.69, 1.49),
    "ED-SLAM": (0.18, 0.45, 0.35, 0.26, 0.66, 0.91, 0.94, 3.00, 1.02),
}
# Table III: PSNR in dB, SSIM and LPIPS of each scene, in the order of ROOMS.
TABLE_3 = {
    "IncEventGS": (
        *((17.38, 0.63, 0.52), (18.98, 0.53, 0.57), (18.89, 0.32, 0.85)),
        *((13.49, 0.55, 0.56), (14.61, 0.58, 0.40)),
    ),
    "Event 3DGS": (
        *((15.05, 0.60, 0.53), (16.17, 0.57, 0.59), (19.69, 0.45, 0.59)),
        *((12.40, 0.47, 0.57), (13.21, 0.49, 0.48)),
    ),
    "ED-SLAM": (
        *((22.37, 0.87, 0.18), (24.27, 0.83, 0.20), (27.85, 0.59, 0.31)),
        *((22.21, 0.81, 0.16), (20.43, 0.85, 0.15)),
    ),
}
# Tables I and II: PSNR in dB, SSIM, LPIPS and ATE in cm on office0, by patch size and by number of patches.
TABLE_1 = {
    5: (20.12, 0.51, 0.44, 0.58),
    7: (23.45, 0.55, 0.38, 0.42),
    9: (27.85, 0.59, 0.31, 0.35),
    11: (27.10, 0.57, 0.33, 0.37),
    13: (25.30, 0.54, 0.36, 0.44),
}
TABLE_2 = {
    200: (22.50, 0.52, 0.39, 0.48),
    400: (27.85, 0.59, 0.31, 0.35),
    600: (27.50, 0.58, 0.32, 0.36),
    800: (27.20, 0.57, 0.33, 0.38),
}
IMAGE_MEASURES = ("psnr_corrected_db", "ssim", "lpips")
ABLATION_MEASURES = (*IMAGE_MEASURES, "ate_rmse_cm")
ABLATION_SCENE = "office0"


def _table_4() -> list[Published]:
    return [
        Published(
            system, scene, "ate_rmse_cm", value, FULL, dataset_of(scene), UNKNOWN_ALIGNMENT,
            f"{PAPER}, Table IV",
        )
        for system, values in TABLE_4.items()
        for scene, value in zip(PAPER_SCENES, values)
    ]  # fmt: skip


def _table_3() -> list[Published]:
    return [
        Published(system, scene, measure, value, FULL, REPLICA, "-", f"{PAPER}, Table III")
        for system, scenes in TABLE_3.items()
        for scene, values in zip(ROOMS, scenes)
        for measure, value in zip(IMAGE_MEASURES, values)
    ]


# --- others ---

# IncEventGS's own paper, on slices of about 5 s.
INCEVENTGS = {
    "ate_rmse_cm": (0.046, 0.067, 0.045, 0.046, 0.054),
    "psnr_corrected_db": (24.31, 23.75, 25.64, 21.74, 21.18),
    "ssim": (0.85, 0.79, 0.54, 0.82, 0.88),
    "lpips": (0.17, 0.23, 0.30, 0.23, 0.13),
}
E2EGS = "E2EGS (arXiv 2603.14684), as transcribed by others"
DEVO_TABLE = "DEVO paper, Table 2, via EW"


def _inceventgs() -> list[Published]:
    return [
        Published(
            "IncEventGS", scene, measure, value, SLICES, f"{REPLICA}, slices of 5 s", "Sim(3)",
            "IncEventGS paper (arXiv 2410.08107)",
        )
        for measure, values in INCEVENTGS.items()
        for scene, value in zip(ROOMS, values)
    ]  # fmt: skip


def _e2egs() -> list[Published]:
    values = {
        "ate_rmse_cm": {"room0": 0.049, "room2": 0.065, "office0": 0.078},
        "psnr_corrected_db": {"room0": 23.86, "office0": 28.01, "office3": 20.75},
    }
    return [
        Published(
            "E2EGS", scene, measure, value, SLICES, f"{REPLICA}, slices", "Sim(3)", E2EGS
        )
        for measure, of_scenes in values.items()
        for scene, value in of_scenes.items()
    ]  # fmt: skip


def _vector() -> list[Published]:
    """Return the best numbers on VECtor that are not in the paper's table; all with free scale."""
    values = {
        "DPVO (frames)": (
            {"desk_normal": 1.0, "robot_normal": 0.7, "sofa_normal": 2.1, "hdr_normal": 0.5},
            DEVO_TABLE,
        ),
        "DEVO (events)": ({"desk_normal": 1.1, "robot_normal": 1.0, "sofa_normal": 4.7}, DEVO_TABLE),
        "DEIO (events, IMU)": (
            {"desk_normal": 1.39, "robot_normal": 0.82, "sofa_normal": 4.82, "hdr_normal": 1.43},
            "notebooks of github.com/arclab-hku/DEIO",
        ),
    }
    return [
        Published(system, scene, "ate_rmse_cm", value, FULL, VECTOR, "Sim(3)", source)
        for system, (of_scenes, source) in values.items()
        for scene, value in of_scenes.items()
    ]


PUBLISHED: tuple[Published, ...] = (*_table_4(), *_table_3(), *_inceventgs(), *_e2egs(), *_vector())

LOWER_IS_BETTER = ("ate_rmse_cm", "lpips")


def best(protocol: str, scene: str, measure: str) -> Published | None:
    """Return the best published number, the paper's own included; None: we know of none."""
    found = [p for p in PUBLISHED if (p.protocol, p.scene, p.measure) == (protocol, scene, measure)]
    sign = 1 if measure in LOWER_IS_BETTER else -1
    return min(found, key=lambda p: sign * p.value, default=None)


@dataclass(frozen=True)
class PublishedSpeed:
    """How fast a system is said to be; None where nothing is said."""

    system: str
    tracking_hz: float | None
    mapping_hz: float | None
    total_fps: float | None
    map_mb: float | None
    device: str
    source: str


SPEEDS = (
    PublishedSpeed("ED-SLAM", None, None, None, None, "RTX 4090", "ED-SLAM paper: states no speed"),
    PublishedSpeed(
        "IncEventGS", 1 / 0.3, 1 / 1.7, 0.5, 65.0, "RTX 3090",
        "IncEventGS paper: 0.3 s of tracking and 1.7 s of mapping a chunk",
    ),
    PublishedSpeed("EGS-SLAM", None, None, 0.55, None, "RTX 4080", "EGS-SLAM paper"),
    PublishedSpeed("MonoGS", None, None, 1.75, None, "RTX 4080", "EGS-SLAM paper"),
    PublishedSpeed(
        "SplaTAM", None, None, 0.25, None, "RTX 4070 Ti",
        "users of github.com/spla-tam/SplaTAM (issue 34)",
    ),
)  # fmt: skip
