"""Addresses of local connections: `unix:PATH`, `PORT`, `HOST:PORT`."""

import contextlib
import errno
import os
import socket
import stat
from dataclasses import dataclass
from pathlib import Path

from edslam_ti.errors import DataError, plain

LOOPBACK = "127.0.0.1"
LOOPBACKS = ("127.0.0.1", "localhost", "::1")
EXPECTED = "expected unix:PATH, PORT or HOST:PORT"


@dataclass(frozen=True)
class Address:
    """Where data are sent to."""

    path: Path | None  # of a Unix socket; None: TCP
    host: str = LOOPBACK
    port: int = 0

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach it."""
        return self.path is not None or self.host in LOOPBACKS

    def __str__(self) -> str:
        return f"unix:{self.path}" if self.path is not None else f"{self.host}:{self.port}"

    def listen(self) -> tuple[socket.socket, "Address"]:
        """Return a socket that listens, and its address, where port 0 is a free one; raises DataError."""
        kind = socket.AF_UNIX if self.path is not None else socket.AF_INET6 if ":" in self.host else None
        server = socket.socket(kind or socket.AF_INET, socket.SOCK_STREAM)
        try:
            if self.path is not None:
                _remove_dead_socket(self.path)
                mask = os.umask(0o177)  # other users of the machine cannot write to it
                try:
                    server.bind(str(self.path))
                finally:
                    os.umask(mask)
                server.listen(1)
                return server, self
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            server.bind((self.host, self.port))
            server.listen(1)
            return server, Address(None, self.host, int(server.getsockname()[1]))
        except OSError as error:
            server.close()
            raise DataError(f"{self}: cannot listen there ({error.strerror or error})") from error

    def connect(self, timeout: float | None = None) -> socket.socket:  # seconds
        """Return a connection; raises OSError where there is none."""
        if self.path is not None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                connection.settimeout(timeout)
                connection.connect(str(self.path))
            except OSError:
                connection.close()
                raise
        else:
            connection = socket.create_connection((self.host, self.port), timeout)
        connection.settimeout(None)
        return connection


def address_of(text: str) -> Address:
    """Return the address that a text names; raises DataError for any other text."""
    if text.startswith("unix:"):
        path = text.removeprefix("unix:")
        if not path or len(os.fsencode(path)) > 100:  # the system's limit is 108 bytes
            raise DataError(f"address: expected a path of 1 to 100 bytes after unix:, got '{plain(path)}'")
        return Address(Path(path))
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise DataError(f"address: {EXPECTED}, got '{plain(text)}'")
    return Address(None, host.strip("[]") or LOOPBACK, int(port))


def _remove_dead_socket(path: Path) -> None:
    """Remove a socket's file that no process listens at; raises DataError where one does."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise DataError(f"unix:{path}: there is a file of that name; choose another")
    except FileNotFoundError:
        return
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
        try:
            probe.connect(str(path))
        except OSError as error:
            if error.errno != errno.ECONNREFUSED:
                raise
            path.unlink(missing_ok=True)
            return
    raise DataError(f"unix:{path}: another process listens there")
