"""Sends data to `edslam live --listen`: the client's side of the messages.

with Client("127.0.0.1:5700", camera) as client:
    client.send(EventsItem(x, y, t, p))
    client.send(DepthItem(t, depth))
"""

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from edslam_ti.errors import DataError
from edslam_ti.live.addresses import Address, address_of
from edslam_ti.live.items import CameraItem, DepthItem, EventsItem, Item
from edslam_ti.live.messages import MOST_EVENTS, encoded
from edslam_ti.live.recording import RecordingSource

FIRST_PAUSE, LONGEST_PAUSE = 0.05, 1.0  # seconds between two tries to connect


class Client:
    """A connection to a session, which gets the camera first."""

    def __init__(
        self,
        address: Address | str,
        camera: CameraItem,
        patience: float = 10.0,  # seconds to wait until the session listens
    ) -> None:
        """Connect; raises DataError where nothing listens there."""
        address = address_of(address) if isinstance(address, str) else address
        self._camera, self._address = camera, address
        end, pause = time.monotonic() + patience, FIRST_PAUSE
        while True:
            try:
                self._socket = address.connect(timeout=patience)
                break
            except OSError as error:
                if time.monotonic() + pause > end:
                    raise DataError(
                        f"{address}: nothing listens there ({error.strerror or error}); start "
                        f"`edslam live --listen {address}` first"
                    ) from error
                time.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
        self.send(camera)

    def send(self, item: Item) -> None:
        """Send an item; waits while the session is busy. Raises DataError where the session has gone."""
        if isinstance(item, EventsItem) and len(item.t) > MOST_EVENTS:
            for k in range(0, len(item.t), MOST_EVENTS):
                part = slice(k, k + MOST_EVENTS)
                self.send(EventsItem(item.x[part], item.y[part], item.t[part], item.p[part]))
            return
        try:
            self._socket.sendall(encoded(item, self._camera))
        except OSError as error:
            raise DataError(f"{self._address}: the session has gone ({error.strerror or error})") from error

    def close(self) -> None:
        """Leave; the session waits for the next client unless an `EndItem` was sent."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()


def send_all(
    source: RecordingSource,
    address: Address,
    report: Callable[[float], None] = lambda seconds: None,  # receives how far the recording has been sent
) -> int:
    """Send a recording, its end too; return the number of messages."""
    number, client = 0, None
    try:
        for item in source.items():
            if isinstance(item, CameraItem):
                client = Client(address, item)
            elif client is not None:
                client.send(item)
            number += 1
            if isinstance(item, DepthItem):
                report(item.t - source.first)
    finally:
        source.close()
        if client is not None:
            client.close()
    return number
