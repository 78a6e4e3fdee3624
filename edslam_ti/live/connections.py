"""Messages from standard input, or from clients that connect one after the other."""

import contextlib
import io
import os
import select
import socket
import sys
import threading
from collections.abc import Iterator
from typing import BinaryIO

from edslam_ti.errors import DataError, plain
from edslam_ti.live.addresses import Address
from edslam_ti.live.items import CameraItem, EndItem, Item, NoteItem
from edslam_ti.live.messages import Read, read_message

POLL = 0.1  # seconds between two looks at whether the source has been closed


class SocketSource:
    """Listens at an address; a client sends messages, and may go and come again (`Source`).

    A malformed message ends the connection, not the session: the client may connect anew. It must then send
    the same camera.
    """

    is_live = True

    def __init__(self, address: Address, wait: float | None = None) -> None:  # s; None: for ever
        """Listen; `wait`: seconds without a client after which the data end. Raises DataError."""
        self._server, self.address = address.listen()
        self._wait = wait
        self.description = f"messages at {self.address}"
        self._camera: CameraItem | None = None
        self._is_closed = threading.Event()

    def items(self) -> Iterator[Item]:
        """Yield what clients send, until one says that it is the end."""
        number = 0
        with contextlib.closing(self._server):
            while True:
                connection = self._next_client()
                if connection is None:
                    return
                number += 1
                yield NoteItem(f"client {number} connected")
                with contextlib.closing(connection):
                    connection.setblocking(True)
                    for item in self._received(connection, number):
                        yield item
                        if isinstance(item, EndItem):
                            return

    def close(self) -> None:
        self._is_closed.set()
        if self.address.path is not None:
            self.address.path.unlink(missing_ok=True)

    def _next_client(self) -> socket.socket | None:
        """Return the next connection; None: the source was closed, or none came for too long."""
        waited = 0.0
        while not self._is_closed.is_set() and (self._wait is None or waited < self._wait):
            ready, _, _ = select.select([self._server], [], [], POLL)
            if ready:
                return self._server.accept()[0]
            waited += POLL
        return None

    def _received(self, connection: socket.socket, number: int) -> Iterator[Item]:
        read = _reader(connection.fileno(), self._is_closed)
        camera: CameraItem | None = None  # of this connection
        while True:
            is_known = self._camera is not None
            try:
                item = read_message(read, camera)
                if isinstance(item, CameraItem):
                    self._check_camera(item, is_second=camera is not None)
                    camera = item
            except (DataError, OSError) as error:
                yield NoteItem(f"client {number}: connection closed: {plain(error)}")
                return
            if item is None:
                yield NoteItem(f"client {number} has gone; waiting for another")
                return
            if not (isinstance(item, CameraItem) and is_known):
                yield item

    def _check_camera(self, item: CameraItem, is_second: bool) -> None:
        if is_second:
            raise DataError("camera: expected one camera message of a connection, got a second")
        if self._camera is None:
            self._camera = item
        elif not self._camera.is_same(item):
            raise DataError("camera: expected the one that the session began with, got another")


class StreamSource:
    """Messages from a stream, such as standard input (`Source`)."""

    is_live = True

    def __init__(self, stream: BinaryIO | None = None) -> None:
        self._stream = sys.stdin.buffer if stream is None else stream
        self.description = "messages from standard input"
        self._is_closed = threading.Event()

    def items(self) -> Iterator[Item]:
        """Yield what the stream holds; raises DataError where it holds anything but messages."""
        read = self._whole_read()
        camera: CameraItem | None = None
        while True:
            item = read_message(read, camera)
            if item is None:
                return
            if isinstance(item, CameraItem):
                if camera is not None:
                    raise DataError("camera: expected one camera message, got a second")
                camera = item
            yield item
            if isinstance(item, EndItem):
                return

    def close(self) -> None:
        self._is_closed.set()

    def _whole_read(self) -> Read:
        try:
            return _reader(self._stream.fileno(), self._is_closed)
        except (OSError, io.UnsupportedOperation):  # bytes in memory
            return self._stream.read


def _reader(descriptor: int, is_closed: threading.Event) -> Read:
    """Return a function that reads so many bytes from a descriptor, fewer where it ends or is closed."""

    def read(size: int) -> bytes:
        parts = bytearray()
        while len(parts) < size:
            ready, _, _ = select.select([descriptor], [], [], POLL)
            if is_closed.is_set():
                break
            if ready:
                data = os.read(descriptor, min(size - len(parts), 1 << 20))
                if not data:
                    break
                parts += data
        return bytes(parts)

    return read
