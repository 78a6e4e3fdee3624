"""Loop closure where an old keyframe is in view again, and relocalisation after a gap."""

import numpy as np

from edslam_ti.alignment import MIN_PIXELS
from edslam_ti.config import ImageTrackingConfig, TrackingConfig
from edslam_ti.geometry import inverse, is_near
from edslam_ti.tracking.keyframes import BrightnessKeyframe, KeyframeAligner
from edslam_ti.tracking.place_recognition import pose_by_features
from edslam_ti.tracking.pose_graph import Revisit, corrections, spread
from edslam_ti.trajectory import PathDraft

# Not settings: they bound the time that one frame may take.
MAX_REVISITS = 3  # old keyframes compared with a new one
MAX_RECOGNISED = 20  # old keyframes searched after a gap
# Not settings: they follow from the accuracy of an alignment.
NO_DRIFT = (0.003, 0.2)  # metres, degrees: smaller corrections are the alignment's own error
MAX_DRIFT = (0.3, 15.0)  # metres, degrees: larger corrections are rejected


class OldKeyframes:
    """Keyframes of places that the camera has left, and the revisits to them."""

    def __init__(self, aligner: KeyframeAligner, config: TrackingConfig) -> None:
        self._aligner = aligner
        self._config = config
        self._kept: list[BrightnessKeyframe] = []
        self._revisits: list[Revisit] = []

    @property
    def newest(self) -> BrightnessKeyframe:
        """The keyframe added last."""
        return self._kept[-1]

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, keyframe: BrightnessKeyframe) -> None:
        """Keep the parts of a keyframe that loop closure and relocalisation need."""
        self._kept.append(keyframe.reduced())

    def close_loop(self, keyframe: BrightnessKeyframe, path: PathDraft) -> str:
        """Correct the drift since an older keyframe that is in view again; return a message."""
        settings = self._config.images
        T_now = path.pose(keyframe.index)
        old_enough = [k for k in self._kept if keyframe.index - k.index >= 2 * settings.window]
        shares = [self._aligner.share_in_view(k, inverse(path.pose(k.index)) @ T_now) for k in old_enough]
        in_view = [k for k, share in zip(old_enough, shares) if share >= settings.revisit_overlap]
        for old in in_view[:MAX_REVISITS]:  # the oldest has drifted least
            T = self._compared(old, keyframe, T_now, path)
            if T is None:
                continue
            keyframe.is_new_place = max(shares) < self._config.min_overlap
            drift = inverse(T_now) @ T
            if not is_near(drift, *MAX_DRIFT):
                continue
            T_old_new = inverse(path.pose(old.index)) @ T
            self._revisits.append(Revisit(old.index, keyframe.index, T_old_new))
            if not is_near(drift, *NO_DRIFT):
                self._correct(keyframe, path)
                return f"place of frame {old.index} seen again"
            return ""
        return ""

    def relocalised(
        self, keyframe: BrightnessKeyframe, path: PathDraft
    ) -> tuple[np.ndarray, str] | None:  # [4, 4] T_world_camera
        """Return a keyframe's pose relocalised by an older keyframe, and a message; None: no match."""
        T_now = path.pose(keyframe.index)
        for old in self._kept[::-1][:MAX_RECOGNISED]:
            T_old_new = pose_by_features(old, keyframe, self._aligner.camera)
            by_features = None if T_old_new is None else path.pose(old.index) @ T_old_new
            for start in (by_features, T_now):
                T = None if start is None else self._compared(old, keyframe, start, path)
                if T is not None:
                    return T, f"relocalised by the place of frame {old.index}"
        return None

    def _compared(
        self, old: BrightnessKeyframe, new: BrightnessKeyframe, start: np.ndarray, path: PathDraft
    ) -> np.ndarray | None:
        """Return the new keyframe's pose by alignment to an older one, or None where they do not match."""
        settings: ImageTrackingConfig = self._config.images
        old, T_world_old = self._aligner.with_points(old), path.pose(old.index)
        T = inverse(T_world_old) @ start
        for _ in range(2):  # images are known up to an offset: estimate it again at the better pose
            difference = self._aligner.difference(old, new.log_brightness, T)
            if len(difference) < MIN_PIXELS // 4:
                return None
            image = new.log_brightness - np.float32(np.median(difference))
            aligned = self._aligner.align(old, image, new.depth, T)
            T = aligned.T_keyframe_camera
        is_same = not aligned.problem(self._config) and aligned.misfit < settings.revisit_misfit
        return T_world_old @ T if is_same and aligned.overlap > settings.revisit_overlap / 2 else None

    def _correct(self, keyframe: BrightnessKeyframe, path: PathDraft) -> None:
        """Move all frames so that keyframes best agree with their neighbours and with all revisits."""
        seen = {k for revisit in self._revisits for k in (revisit.old, revisit.new)}
        nodes = sorted(seen | {k.index for k in self._kept} | {keyframe.index})
        moved = corrections(nodes, [path.pose(k) for k in nodes], self._revisits)
        for index in range(nodes[0] + 1, len(path)):
            path.replace(index, spread(index, nodes, moved) @ path.pose(index))
