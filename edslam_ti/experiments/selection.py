"""Options that select cases of the tracking benchmark."""

from typing import TYPE_CHECKING

from edslam_ti.config import Stage

if TYPE_CHECKING:  # the cases load the simulator
    from edslam_ti.experiments.cases import Case


class Selection(Stage):
    """Which cases to run; an empty tuple takes all."""

    cases: tuple[str, ...] = ()
    """Parts of case names: wall, gap, 30s, kinect-5hz, ..."""
    groups: tuple[str, ...] = ()
    """Groups: rooms, unseen, wall, corridor, rotation, stop_and_go, mesh, gaps, long, real."""
    scenes: tuple[str, ...] = ()
    """Scenes: room0, wall, viking_room, slider_depth, ..."""
    depth: tuple[str, ...] = ()
    """Depth: exact, kinect, measured."""
    rates: tuple[float, ...] = ()
    """Depth images per second: 20, 10, 5."""
    speeds: tuple[float, ...] = ()
    """Speed of the motion: 1, 2."""
    seeds: tuple[int, ...] = ()
    """Seeds of path and noise: 0, 1, 2."""

    def includes(self, case: "Case") -> bool:
        """Return whether a case passes every filter."""
        recording = case.recording
        wanted = (
            (self.groups, case.group),
            (self.scenes, recording.scene),
            (self.depth, case.depth),
            (self.rates, case.rate),
            (self.speeds, recording.speed),
            (self.seeds, recording.seed),
        )
        named = not self.cases or any(part in case.name for part in self.cases)
        return named and all(not values or value in values for values, value in wanted)
