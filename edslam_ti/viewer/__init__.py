"""Shows runs: an Open3D window, a page in the browser, a file for Rerun."""

from collections.abc import Callable

from edslam_ti.config import Config
from edslam_ti.errors import plain
from edslam_ti.viewer.live import BrowserViewer
from edslam_ti.viewer.moment import Moment, NoViewer, Say, Viewer
from edslam_ti.viewer.rerun_log import RerunLog
from edslam_ti.viewer.window import Open3dViewer

__all__ = [
    "VIEWERS",
    "BrowserViewer",
    "Moment",
    "NoViewer",
    "Open3dViewer",
    "RerunLog",
    "Viewer",
    "Viewers",
    "make_viewers",
]

# By the setting that asks for it; a viewer is made when a run starts and may raise EdSlamError.
VIEWERS: dict[str, Callable[[Config, Say], Viewer]] = {
    "visualize": lambda config, say: Open3dViewer(),
    "viewer": lambda config, say: BrowserViewer(config.viewer_address, config.viewer_port, say),
    "log": lambda config, say: _log(config),
}


def _log(config: Config) -> RerunLog:
    assert config.log is not None  # the setting asks for it
    return RerunLog(config.log)


def make_viewers(config: Config, say: Say) -> "Viewers":
    """Return the viewers that the settings ask for; raises EdSlamError where one cannot be had."""
    return Viewers({name: make(config, say) for name, make in VIEWERS.items() if getattr(config, name)}, say)


class Viewers:
    """Several viewers at once, or none. One that fails is left out, and the run goes on."""

    def __init__(self, viewers: dict[str, Viewer], say: Say) -> None:
        self._viewers = viewers
        self._say = say

    def update(self, moment: Moment) -> None:
        """Show the state of the run."""
        self._each(lambda viewer: viewer.update(moment))

    def wait(self, is_ended: Callable[[], bool]) -> None:
        """Return when the run may go on."""
        self._each(lambda viewer: viewer.wait(is_ended))

    def close(self) -> None:
        """Stop showing."""
        self._each(lambda viewer: viewer.close())

    def _each(self, action: Callable[[Viewer], None]) -> None:
        for name, viewer in list(self._viewers.items()):
            try:
                action(viewer)
            except Exception as error:  # whatever a window or a network does, the run is worth more
                del self._viewers[name]
                self._say(f"--{name} has ended: {plain(error) or type(error).__name__}")
