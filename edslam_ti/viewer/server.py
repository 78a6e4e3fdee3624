"""The server of the pages: viser (Yi et al. 2025), on this machine alone unless told otherwise."""

import contextlib
import io
import ipaddress
import socket
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edslam_ti.errors import EdSlamError, MissingExtraError
from edslam_ti.viewer.moment import Say
from edslam_ti.viewer.shapes import opening_view, rgb, up_direction

ASPECT = 1.1  # width over height of the scene in a usual browser, beside the panel
HALF_HEIGHT = 0.6  # tangent of half the angle of view where the camera is not known


def open_server(address: str, port: int, say: Say) -> Any:  # viser.ViserServer
    """Start serving an empty page and say where; raises EdSlamError where that is impossible."""
    viser = load_viser()
    _check_address(address)

    class Server(viser.ViserServer):  # type: ignore[name-defined]
        """viser's server without its tunnel, by which a page could be shared with the whole internet."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Open no tunnel, whoever asks."""

        def stop(self) -> None:
            """Stop without a word."""
            with contextlib.redirect_stdout(io.StringIO()):
                super().stop()

    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = Server(host=address, port=port, label="ED-SLAM", verbose=False)
    server.gui.configure_theme(
        show_logo=False,
        show_share_button=False,
        control_layout="fixed",
        control_width="medium",
        brand_color=(0, 114, 178),
    )
    server.gui.main_panel.dock_right()  # beside the scene, not over it
    if not is_local(address):
        say(
            f"warning: the page is open to other machines at {address}: whoever reaches it sees the run and "
            "can pause it; there is no password"
        )
    shown = "localhost" if address in ("0.0.0.0", "::") else address
    say(f"page: http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}")
    return server


def load_viser() -> Any:
    """Return the module viser; raises MissingExtraError where it is not installed."""
    try:
        import viser
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "the page for the browser needs viser: pip install 'edslam-ti[viewer]'"
        ) from error
    return viser


def is_local(address: str) -> bool:
    """Return whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def _check_address(address: str) -> None:
    """Raise EdSlamError where nothing can be served at an address."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(address, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as test:
            test.bind(place)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise EdSlamError(
            f"address of the page: expected one of this machine, such as 127.0.0.1, got '{address}' "
            f"({reason})"
        ) from error


# --- eyes ---


def set_up(server: Any, poses: np.ndarray) -> None:  # [F, 4, 4]
    """Tell pages which way is up; their eyes turn about it."""
    server.scene.set_up_direction(tuple(up_direction(poses)))


def place_eye(server: Any, poses: np.ndarray, half_height: float = HALF_HEIGHT) -> None:  # [F, 4, 4]
    """Let new pages open where the first camera stood, with the whole path in sight."""
    view = opening_view(poses, half_height, ASPECT * half_height)
    eye = server.initial_camera
    eye.position = tuple(view[:3, 3])
    eye.look_at = tuple(view[:3, 3] + view[:3, 2])
    eye.up = tuple(-view[:3, 1])
    eye.fov = 2 * float(np.arctan(half_height))
    eye.near = 0.02


def look_through(client: Any, T_world_camera: np.ndarray, angle: float | None = None) -> None:
    """Move a page's eye to a camera with some vertical angle of view (radians)."""
    with client.atomic():
        if angle is not None:
            client.camera.fov = angle
        client.camera.position = T_world_camera[:3, 3]
        client.camera.wxyz = wxyz_of(T_world_camera)


def wxyz_of(T_world_camera: np.ndarray) -> np.ndarray:  # [4, 4] -> [4]
    """Return the rotation of a pose as a quaternion w, x, y, z."""
    return Rotation.from_matrix(T_world_camera[:3, :3]).as_quat(scalar_first=True)


# --- what both pages have ---


def words(*lines: str) -> str:
    """Return lines as HTML in which nothing is markup: names come from recordings."""
    inside = "<br>".join(escape(line) for line in lines)
    return f'<div style="margin: 0.4em 1em; font-size: 0.9em; overflow-wrap: anywhere">{inside}</div>'


def add_lines(server: Any, name: str, lines: Sequence[np.ndarray], color: str, width: float) -> Any:
    """Show lines [2, 3] of one colour, #rrggbb, some pixels wide, in place of those of the same name."""
    segments = np.asarray(lines, np.float32)
    linear = 255 * (np.array(rgb(color)) / 255) ** 2.2  # as pages take the colours of lines
    colors = np.broadcast_to(linear.astype(np.uint8), segments.shape)
    return server.scene.add_line_segments(name, segments, colors, thickness=width, thickness_units="screen")


def add_screenshot_button(server: Any) -> None:
    """Add a button that saves what a page shows as a picture, at its reader's computer."""
    button = server.gui.add_button("Screenshot")

    @button.on_click
    def _(event: Any) -> None:
        client = event.client
        if client is not None:
            picture = client.get_render(720, 1280, timeout=20.0)
            client.send_file_download("ed-slam.png", _png(picture), save_immediately=True)


def _png(picture: np.ndarray) -> bytes:  # [H, W, 3] RGB uint8
    import cv2

    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., 2::-1]))
    return bytes(data) if done else b""
