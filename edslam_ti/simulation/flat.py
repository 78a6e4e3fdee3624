"""A flat of four furnished rooms around a crossing of walls, joined by open doorways in a ring.

A camera that walks through all rooms comes back to where it was: long paths with loops.
"""

import numpy as np

from edslam_ti.simulation import furniture as f
from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.rooms import Room, RoomBuilder, stretched, tiled
from edslam_ti.simulation.scene import Material

WIDTH, DEPTH, HEIGHT = 8.6, 8.0, 2.55  # metres
MIDDLE_X, MIDDLE_Y = 4.3, 4.0
THICKNESS = 0.12
DOORWAY, LINTEL = 1.1, 2.1  # metres, width and height of a doorway
EYE = 1.4  # metres
# Where the doorways are along the inner walls, and the points that a walk passes, through each room's middle
# and straight through each doorway.
NORTH, SOUTH, WEST, EAST = 6.3, 1.6, 1.7, 6.8
TOUR = (
    *((2.3, 5.9), (3.4, 6.3), (MIDDLE_X, NORTH), (5.2, 6.3), (6.4, 5.9)),
    *((6.8, 4.8), (EAST, MIDDLE_Y), (6.8, 3.2), (6.3, 2.1)),
    *((5.2, 1.6), (MIDDLE_X, SOUTH), (3.4, 1.6), (2.2, 2.1)),
    *((1.7, 3.2), (WEST, MIDDLE_Y), (1.7, 4.8)),
)


def flat() -> Room:
    """Build a study, a living room, a bedroom and a kitchen."""
    b = RoomBuilder(300, WIDTH, DEPTH, HEIGHT)
    rng = b.rng
    p = f.make_palette(b, wood=0.45, dark=0.22, light=0.65, cloth=(0.36, "weave"), accent=(0.26, "tartan"))
    plaster = tiled(b, tx.plaster(rng, 0.66))
    papers = [tiled(b, tx.wallpaper(rng, 0.52, kind)) for kind in ("lattice", "petals", "stripes")]
    b.shell(
        {"north": papers[0], "east": plaster, "south": papers[1], "west": papers[2]},
        tiled(b, tx.planks(rng, 0.42)),
        tiled(b, tx.ceiling(rng, 0.8, panels=True)),
        p.white,
    )
    for x in (2.1, 6.5):
        for y in (2.0, 6.0):
            b.lamp_panel(x, y, (1.2, 0.5), 0.9, p.white)
    _inner_walls(b, [tiled(b, tx.brick(rng, 0.4), texel=0.0036), papers[2], plaster, papers[1]])
    _study(b, p)
    _living_room(b, p)
    _kitchen(b, p)
    _bedroom(b, p)
    return _finished(b)


def _inner_walls(b: RoomBuilder, materials: list[Material]) -> None:
    """Add the four inner walls, each with a doorway, a picture on either side of it, and a lintel."""
    rng, h = b.rng, THICKNESS / 2
    arms = (  # along x or y, ends, middle of the doorway
        ("y", MIDDLE_Y, DEPTH, NORTH),
        ("x", MIDDLE_X, WIDTH, EAST),
        ("y", 0.0, MIDDLE_Y, SOUTH),
        ("x", 0.0, MIDDLE_X, WEST),
    )
    for (axis, low, high, door), material in zip(arms, materials):
        a, c = door - DOORWAY / 2, door + DOORWAY / 2
        for start, end, bottom in ((low, a, 0.0), (c, high, 0.0), (a, c, LINTEL)):
            if axis == "y":
                b.box((MIDDLE_X - h, start, bottom), (MIDDLE_X + h, end, HEIGHT), material)
            else:
                b.box((start, MIDDLE_Y - h, bottom), (end, MIDDLE_Y + h, HEIGHT), material)
        for start, end in ((low, a), (c, high)):
            if end - start < 1.0:
                continue
            middle = (start + end) / 2
            for side in (-1, 1):  # the viewer stands at smaller, then at larger coordinates
                if axis == "y":
                    x, y, yaw = MIDDLE_X + side * h, middle, 90.0 * side
                else:
                    x, y, yaw = middle, MIDDLE_Y + side * h, 0.0 if side < 0 else 180.0
                with b.placed(x, y, 0.0, yaw):
                    image = tx.framed(tx.landscape(rng), 0.4) if side < 0 else tx.poster(rng)
                    f.picture(b, image, 0.0, 1.55, 0.7, 0.6)


def _study(b: RoomBuilder, p: f.Palette) -> None:
    """Furnish the room in the north west."""
    rng = b.rng
    drawers = stretched(b, tx.panelled(rng, tx.wood(rng, 0.45), 3, 1))
    with b.wall("north", 0.4):
        f.desk(b, p, drawers, 1.8)
        f.workplace(b, p, 1.8, 2)
    with b.wall("north"):
        f.picture(b, tx.whiteboard(rng), 1.2, 1.75, 1.4, 0.8)
        f.picture(b, tx.poster(rng), 2.6, 1.7, 0.5, 0.7)
    with b.wall("north", 2.4):
        f.cabinet(b, drawers, p.wood, 1.0, 0.9, 0.45)
        f.plant(b, p, 0.5, -0.25, 0.6, z=0.9)
    with b.wall("west", 4.5):
        f.bookshelf(b, p, 1.2, 2.0, 5)
    with b.wall("west", 5.9):
        f.bookshelf(b, p, 1.0, 1.6, 4, fill=0.85)
    f.bin_(b, p, 2.5, 7.5)


def _living_room(b: RoomBuilder, p: f.Palette) -> None:
    """Furnish the room in the north east."""
    rng = b.rng
    with b.wall("north", 5.3):
        f.sofa(b, p, 2.1, 2)
    with b.wall("north"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.6), 6.2, 1.6, 1.2, 0.7)
        f.picture(b, tx.framed(tx.abstract(rng), 0.1), 7.6, 1.6, 0.6, 0.6)
    f.floor_lamp(b, p, 8.1, 7.4)
    with b.wall("east", 0.8):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.3), 1, 4)), p.dark_wood, 2.2, 0.65, 0.45)
        f.vase(b, p, 0.3, -0.2, 0.65, 0.3, 0.1)
    with b.wall("east", 1.9):
        f.television(b, p, 1.4, 1.1)
    with b.wall("east"):
        f.picture(b, tx.poster(rng), 3.3, 1.6, 0.55, 0.8)


def _kitchen(b: RoomBuilder, p: f.Palette) -> None:
    """Furnish the room in the south east."""
    rng = b.rng
    doors = stretched(b, tx.panelled(rng, tx.wood(rng, 0.62, 0.07), 1, 4))
    with b.wall("east", 4.6):
        f.cabinet(b, doors, p.light_wood, 2.6, 0.9, 0.6)
        for k, x in enumerate((0.3, 0.9, 1.6, 2.2)):
            f.vase(b, p, x, -0.25, 0.9, 0.2 + 0.05 * k, 0.08)
            f.mug(b, p, x + 0.25, -0.35, 0.9)
    with b.wall("east"):
        f.picture(b, tx.clock(rng), 5.2, 1.9, 0.34, 0.34)
        f.picture(b, tx.pinboard(rng), 6.4, 1.65, 0.9, 0.6)
    with b.wall("south", 0.9):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.metal(rng, 0.6), 2, 1)), p.metal, 0.7, 1.9, 0.6)
    with b.wall("south", 1.8):
        f.bookshelf(b, p, 1.1, 1.7, 4, fill=0.8)
    with b.wall("south"):
        f.picture(b, tx.framed(tx.portrait(rng), 0.3), 3.4, 1.6, 0.5, 0.6)


def _bedroom(b: RoomBuilder, p: f.Palette) -> None:
    """Furnish the room in the south west."""
    rng = b.rng
    drawers = stretched(b, tx.panelled(rng, tx.wood(rng, 0.5), 3, 2))
    with b.wall("south", 5.0):
        f.cabinet(b, drawers, p.wood, 1.4, 0.85, 0.45)
        f.desk_lamp(b, p, 0.3, -0.2, 0.85)
        with b.placed(0.9, -0.25, 0.85):
            f.stack_of_books(b, p, 4)
    with b.wall("south", 6.8):
        f.box_pile(b, p)
    with b.wall("south"):
        f.picture(b, tx.framed(tx.abstract(rng), 0.7), 5.7, 1.6, 0.8, 0.7)
        f.picture(b, tx.poster(rng), 7.2, 1.7, 0.5, 0.7)
    with b.wall("west", 0.7):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.4), 1, 3)), p.dark_wood, 1.6, 2.0, 0.55)
    with b.wall("west"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.2), 3.1, 1.6, 0.8, 0.6)


def _finished(b: RoomBuilder) -> Room:
    """Bake the light; set where a camera may move in the first room, and the walk through all."""
    room = b.finish(
        "flat",
        free_low=(1.7, 5.2, 1.15),
        free_high=(2.9, 6.2, 1.65),
        sights=[
            (1.2, 7.9, 1.1),
            (2.8, 7.8, 1.2),
            (4.2, 7.2, 1.3),
            (2.6, 7.8, 0.9),
            (1.0, 7.8, 1.3),
            (0.2, 6.4, 1.0),
            (0.2, 5.2, 1.1),
        ],
        ambient=0.42,
        brightness=0.55,
        description="simulated flat of four rooms",
    )
    tour = np.array([(x, y, EYE) for x, y in TOUR])
    return Room(room.name, room.scene, room.free_low, room.free_high, room.sights, tour=tour)
