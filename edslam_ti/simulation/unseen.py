"""Built-in scenes beside the five rooms, for measuring on what nothing was tuned on.

`wall` and `corridor` are where single cues fail: geometry says nothing about motion along one flat wall,
and a bare corridor gives few events and slides along itself.
"""

from collections.abc import Callable

import numpy as np

from edslam_ti.simulation import furniture as f
from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.rooms import Room, RoomBuilder, door, stretched, tiled


def _wall() -> Room:
    """One flat wall with a mural, seen from 1.6 to 2.5 m; it fills the view and nothing else is there."""
    b = RoomBuilder(200, 28.0, 2.5, 20.0)
    mural = tiled(b, tx.mural(b.rng))
    with b.wall("north"):
        b.quad((0, 0, b.height), (b.width, 0, 0), (0, 0, -b.height), mural)
    x, z = b.width / 2, b.height / 2
    return Room(
        "wall",
        b.build("simulated flat wall with a mural"),
        np.array([x - 0.6, 0.0, z - 0.25]),
        np.array([x + 0.6, 0.9, z + 0.25]),
        np.array([[x + dx, b.depth, z + dz] for dx, dz in _WALL_SIGHTS]),
        is_closed=False,
    )


_WALL_SIGHTS = ((-0.6, 0.3), (0.5, 0.4), (0.7, -0.4), (-0.2, -0.5), (-0.7, 0.0), (0.3, 0.2))  # metres


def _corridor() -> Room:
    """A long corridor: plain painted walls, doors far apart, a dull floor, lamps in a row."""
    b = RoomBuilder(201, 2.2, 16.0, 2.5)
    rng = b.rng
    p = f.make_palette(b, wood=0.5, dark=0.3, light=0.6, cloth=(0.4, "weave"), accent=(0.3, "weave"))
    paint = tiled(b, tx.plaster(rng, 0.66, 0.03))
    b.shell(
        dict.fromkeys(("north", "south", "east", "west"), paint),
        tiled(b, tx.carpet(rng, 0.36, 0.04)),
        tiled(b, tx.ceiling(rng, 0.8, panels=False)),
        p.light_wood,
    )
    for y in (2.0, 5.5, 9.0, 12.5):
        b.lamp_panel(1.1, y, (0.3, 1.2), 0.7, p.white)
    for side, along in (("west", 4.2), ("west", 9.4), ("east", 4.5), ("east", 9.8), ("north", 1.1)):
        door(b, p, side, along)
    with b.wall("west"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.3), 6.6, 1.6, 0.8, 0.6)
    with b.wall("east"):
        f.picture(b, tx.poster(rng), 7.5, 1.6, 0.5, 0.7)
    with b.wall("east", 12.2):
        b.box((0, -0.12, 0.12), (1.3, -0.03, 0.7), p.white, front=stretched(b, tx.radiator(rng)))
    return b.finish(
        "corridor",
        free_low=(0.7, 1.2, 1.2),
        free_high=(1.5, 6.0, 1.6),
        sights=[
            (1.1, 15.9, 1.3),
            (2.1, 9.0, 1.2),
            (2.1, 7.2, 1.2),
            (1.1, 15.9, 1.0),
            (0.1, 7.5, 1.3),
            (0.1, 9.5, 1.4),
        ],
        ambient=0.5,
        brightness=0.6,
        description="simulated corridor with little texture",
    )


UNSEEN_SCENES: dict[str, Callable[[], Room]] = {
    "wall": _wall,
    "corridor": _corridor,
}
