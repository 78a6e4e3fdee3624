"""Writes small AEDAT4 files byte by byte: header, uncompressed packets of events, by DV's schema."""

import struct
from collections.abc import Sequence
from pathlib import Path

MAGIC = b"#!AER-DAT4.0\r\n"
NODE = """<node name="{number}" path="/mainloop/Recorder/outInfo/{number}/">
<attr key="compression" type="string">NONE</attr>
<attr key="originalModuleName" type="string">capture</attr>
<attr key="originalOutputName" type="string">events</attr>
<attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
<attr key="typeIdentifier" type="string">EVTS</attr>
<node name="info" path="/mainloop/Recorder/outInfo/{number}/info/">
<attr key="sizeX" type="int">{width}</attr>
<attr key="sizeY" type="int">{height}</attr>
<attr key="source" type="string">made</attr>
</node>
</node>"""
INFO = """<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">{nodes}</node></dv>"""


def flatbuffer(identifier: bytes, fields: list[tuple[int, bytes | None]], vector: bytes, at: int) -> bytes:
    """Return a size-prefixed flatbuffer of one table.

    `fields` are pairs of a place in the table and bytes, None for the offset to `vector`, whose data begins
    `at` bytes after the root; a table begins with the distance to its vtable.
    """
    vtable = struct.pack(f"<HH{len(fields)}H", 4 + 2 * len(fields), 24, *(place for place, _ in fields))
    begin = 8 + len(vtable) + -(8 + len(vtable)) % 8  # of the table, after root and identifier
    table = bytearray(24)
    struct.pack_into("<i", table, 0, begin - 8)
    for place, value in fields:
        data = struct.pack("<I", at - (begin + place)) if value is None else value
        table[place : place + len(data)] = data
    body = struct.pack("<I4s", begin, identifier) + vtable
    body = body.ljust(begin, b"\x00") + bytes(table)
    body = body.ljust(at, b"\x00") + vector
    body += b"\x00" * (-len(body) % 8)
    return struct.pack("<I", len(body)) + body


def write_aedat4(
    path: Path, packets: Sequence[tuple[int, Sequence[tuple[int, int, int, int]]]], size: tuple[int, int]
) -> Path:
    """Write packets of a stream's number and its events x, y, t [us], p."""
    numbers = sorted({number for number, _ in packets})
    nodes = "".join(NODE.format(number=number, width=size[0], height=size[1]) for number in numbers)
    text = INFO.format(nodes=nodes).encode()
    vector = struct.pack("<I", len(text)) + text + b"\x00"
    fields = [(4, struct.pack("<i", 0)), (8, struct.pack("<q", -1)), (16, None)]
    content = MAGIC + flatbuffer(b"IOHE", fields, vector, 56)
    for number, events in packets:
        rows = b"".join(struct.pack("<qhh?3x", t, x, y, bool(p)) for x, y, t, p in events)
        packet = flatbuffer(b"EVTS", [(4, None)], struct.pack("<I", len(events)) + rows, 52)
        content += struct.pack("<ii", number, len(packet)) + packet
    path.write_bytes(content)
    return path
