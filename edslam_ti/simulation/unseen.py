"""Built-in scenes for evaluation on which nothing was tuned, in addition to the five rooms.

Single cues fail in `wall` and `corridor`: geometry does not constrain motion along one flat wall, and a bare
corridor gives few events and does not constrain motion along itself. `kitchen`, `workshop` and `library` are
furnished rooms that differ from the five in size, furniture and light.
"""

from collections.abc import Callable

import numpy as np

from edslam_ti.simulation import furniture as f
from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.rooms import Room, RoomBuilder, door, stretched, tiled


def _wall() -> Room:
    """One flat wall with a mural, seen from 1.6 to 2.5 m; it fills the view."""
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


def _kitchen() -> Room:
    """A small kitchen: tiled walls, a worktop with cupboards over it, a table; hard light from one side."""
    b = RoomBuilder(202, 3.6, 3.9, 2.45)
    rng = b.rng
    p = f.make_palette(b, wood=0.6, dark=0.35, light=0.75, cloth=(0.6, "tartan"), accent=(0.5, "dots"))
    tiled_wall = tiled(b, tx.tiles(rng, 0.68, per_side=8, spread=0.07), texel=0.0022)
    b.shell(
        {"north": tiled_wall, "east": tiled_wall, "south": tiled(b, tx.plaster(rng, 0.7, 0.09)),
         "west": tiled(b, tx.wallpaper(rng, 0.6, "lattice"))},
        tiled(b, tx.tiles(rng, 0.42, per_side=4, spread=0.35), texel=0.0026),
        tiled(b, tx.ceiling(rng, 0.82, panels=False)),
        p.white,
    )  # fmt: skip
    b.lamp_panel(1.8, 1.9, (0.5, 0.5), 0.5, p.metal)
    doors = stretched(b, tx.panelled(rng, tx.wood(rng, 0.62, 0.07), 1, 4))
    drawers = stretched(b, tx.panelled(rng, tx.wood(rng, 0.62, 0.07), 3, 3))
    with b.wall("north", 0.1):
        f.cabinet(b, doors, p.light_wood, 2.2, 0.9, 0.6)
        for k, x in enumerate((0.25, 0.6, 1.35, 1.9)):
            f.vase(b, p, x, -0.2, 0.9, 0.2 + 0.05 * k, 0.08)
        for x in (0.4, 1.05, 1.6):
            f.mug(b, p, x, -0.42, 0.9)
        with b.placed(0.85, -0.3, 0.9, yaw=8):
            b.box((0, 0, 0), (0.36, 0.25, 0.26), p.metal)
    with b.wall("north", 0.1), b.placed(0, 0, 1.5):
        b.box((0, -0.34, 0), (1.5, 0, 0.7), p.light_wood, front=doors)
    with b.wall("north", 2.45):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.metal(rng, 0.7), 2, 1)), p.metal, 0.7, 1.95, 0.62)
    with b.wall("east", 0.75):
        f.cabinet(b, drawers, p.light_wood, 1.9, 0.9, 0.6)
        f.plant(b, p, 0.3, -0.3, 0.5, 18, z=0.9)
        for x in (0.8, 1.0, 1.45):
            f.mug(b, p, x, -0.3, 0.9)
        with b.placed(1.6, -0.4, 0.9):
            f.stack_of_books(b, p, 4)
    with b.wall("east"):
        f.picture(b, tx.clock(rng), 1.2, 1.9, 0.34, 0.34)
        f.picture(b, tx.framed(tx.landscape(rng), 0.4), 2.1, 1.6, 0.7, 0.5)
        f.picture(b, tx.poster(rng), 3.2, 1.55, 0.5, 0.7)
    with b.wall("west"):
        f.window(b, tx.window_view(rng, "trees"), 2.3, 1.0, 1.3, 1.1, p.white)
        f.curtain(b, tx.curtain(rng, 0.55), 1.4, 0.4, 2.3, 0.9)
        f.picture(b, tx.pinboard(rng), 0.6, 1.55, 0.8, 0.6)
    b.window_light("west", 2.3, 1.0, 1.3, 1.1, 2.2)
    with b.wall("west", 1.5):
        f.table(b, p.wood, p.dark_wood, 1.2, 0.7, 0.75)
        f.mug(b, p, 0.3, -0.35, 0.75)
        f.vase(b, p, 0.65, -0.3, 0.75, 0.28, 0.09)
        f.scatter_papers(b, p, 0.2, 1.0, -0.6, -0.2, 0.75, 5)
    with b.wall("west", 3.1):
        f.box_pile(b, p)
    door(b, p, "south", 0.8)
    with b.wall("south", 1.7):
        f.bookshelf(b, p, 1.0, 1.7, 4, fill=0.8)
    f.bin_(b, p, 2.0, 0.3)
    return b.finish(
        "kitchen",
        free_low=(1.35, 1.15, 1.2),
        free_high=(2.35, 2.4, 1.65),
        sights=[
            (1.2, 3.8, 1.1),
            (2.7, 3.7, 1.2),
            (3.5, 2.4, 1.0),
            (3.4, 1.5, 1.2),
            (2.2, 3.8, 0.9),
            (0.7, 3.6, 1.3),
            (0.2, 2.4, 1.0),
        ],
        ambient=0.22,
        brightness=0.55,
        description="simulated kitchen, kept for tests",
    )


def _workshop() -> Room:
    """A large workshop: brick and concrete, benches far from the camera, crates, dim lamps overhead."""
    b = RoomBuilder(203, 8.6, 7.4, 3.6)
    rng = b.rng
    p = f.make_palette(b, wood=0.36, dark=0.14, light=0.48, cloth=(0.2, "weave"), accent=(0.55, "stripes"))
    brick = tiled(b, tx.brick(rng, 0.42), texel=0.0048)
    concrete = tiled(b, tx.plaster(rng, 0.45, 0.12), texel=0.006)
    b.shell(
        {"north": brick, "south": concrete, "east": concrete, "west": brick},
        tiled(b, tx.plaster(rng, 0.34, 0.15), texel=0.005),
        tiled(b, tx.planks(rng, 0.3, boards=10), texel=0.006),
        p.dark_wood,
    )
    for x in (2.0, 4.3, 6.6):
        b.lamp_panel(x, 5.0, (0.2, 1.6), 1.2, p.metal)
    locker = stretched(b, tx.panelled(rng, tx.metal(rng, 0.45), 1, 4))
    chest = stretched(b, tx.panelled(rng, tx.metal(rng, 0.3), 5, 2))
    for along in (0.6, 3.2, 5.8):
        with b.wall("north", along):
            f.table(b, p.wood, p.metal, 2.1, 0.8, 0.85)
            for x in (0.2, 0.9, 1.5):
                with b.placed(x, -0.5, 0.85, yaw=float(rng.uniform(-25, 25))):
                    size = float(rng.uniform(0.2, 0.38))
                    b.box((0, 0, 0), (size, 0.7 * size, 0.8 * size), p.cardboard)
            f.desk_lamp(b, p, 1.95, -0.3, 0.85)
            f.scatter_papers(b, p, 0.2, 1.8, -0.7, -0.3, 0.85, 6)
    with b.wall("north"):
        for x in (1.4, 4.1, 6.7):
            f.picture(b, tx.pinboard(rng), x, 1.75, 1.6, 1.0)
        f.picture(b, tx.clock(rng), 2.8, 2.5, 0.5, 0.5)
        f.picture(b, tx.poster(rng), 5.4, 2.0, 0.7, 1.0)
    with b.wall("east", 0.4):
        f.cabinet(b, locker, p.metal, 2.2, 1.95, 0.55)
    with b.wall("east", 2.9):
        f.cabinet(b, chest, p.black, 1.1, 1.1, 0.6)
        with b.placed(0.2, -0.45, 1.1, yaw=12):
            b.box((0, 0, 0), (0.5, 0.35, 0.3), p.cardboard)
    with b.wall("east", 4.3):
        f.bookshelf(b, p, 2.4, 2.3, 5, depth=0.4, fill=0.5)
    with b.wall("west"):
        f.window(b, tx.window_view(rng, "town"), 2.0, 1.4, 1.8, 1.3, p.metal)
        f.window(b, tx.window_view(rng, "town"), 5.2, 1.4, 1.8, 1.3, p.metal)
        b.box((1.2, -0.12, 0.2), (2.8, -0.03, 0.9), p.white, front=stretched(b, tx.radiator(rng)))
    b.window_light("west", 2.0, 1.4, 1.8, 1.3, 1.6)
    b.window_light("west", 5.2, 1.4, 1.8, 1.3, 1.6)
    for x, y in ((0.7, 5.9), (7.5, 5.3), (1.0, 1.2)):
        with b.placed(x, y, yaw=float(rng.uniform(0, 60))):
            f.box_pile(b, p)
    with b.wall("west", 3.3):
        f.table(b, p.dark_wood, p.black, 1.6, 0.7, 0.8)
        f.vase(b, p, 0.5, -0.3, 0.8, 0.35, 0.12)
    door(b, p, "south", 2.0)
    with b.wall("south", 3.2):
        f.cabinet(b, locker, p.metal, 2.0, 1.8, 0.5)
    with b.wall("south"):
        f.picture(b, tx.whiteboard(rng), 6.6, 1.6, 2.0, 1.2)
    with b.placed(6.2, 4.6, yaw=30):
        f.office_chair(b, p)
    with b.placed(2.6, 5.2, yaw=-40):
        f.chair(b, p)
    return b.finish(
        "workshop",
        free_low=(3.2, 2.4, 1.3),
        free_high=(5.4, 4.2, 1.8),
        sights=[
            (4.3, 7.3, 1.3),
            (2.0, 7.2, 1.1),
            (0.2, 4.6, 1.3),
            (1.5, 7.2, 1.5),
            (5.6, 7.2, 1.2),
            (8.4, 5.2, 1.2),
            (8.5, 3.4, 1.1),
        ],
        ambient=0.5,
        brightness=0.42,
        description="simulated workshop, kept for tests",
    )


def _library() -> Room:
    """A long reading room: shelves of books on every side, a table with lamps, much fine repetition."""
    b = RoomBuilder(204, 7.0, 4.6, 3.1)
    rng = b.rng
    p = f.make_palette(b, wood=0.28, dark=0.12, light=0.44, cloth=(0.26, "dots"), accent=(0.4, "tartan"))
    wall = tiled(b, tx.wallpaper(rng, 0.4, "petals"))
    b.shell(
        dict.fromkeys(("north", "south", "east", "west"), wall),
        tiled(b, tx.carpet(rng, 0.28, 0.12)),
        tiled(b, tx.ceiling(rng, 0.7, panels=True)),
        p.dark_wood,
    )
    for x in (1.4, 3.5, 5.6):
        b.lamp_panel(x, 2.3, (0.6, 0.6), 0.8, p.dark_wood)
    for along, width, height, shelves in ((0.2, 1.9, 2.5, 7), (2.2, 1.3, 1.4, 4), (3.6, 2.0, 2.5, 7)):
        with b.wall("north", along):
            f.bookshelf(b, p, width, height, shelves, fill=0.97)
    with b.wall("north"):
        f.picture(b, tx.framed(tx.portrait(rng), 0.2), 2.85, 1.95, 0.6, 0.75)
        f.window(b, tx.window_view(rng, "trees"), 6.3, 0.9, 1.0, 1.5, p.dark_wood)
    b.window_light("north", 6.3, 0.9, 1.0, 1.5, 0.8)
    with b.wall("east", 0.2):
        f.bookshelf(b, p, 2.0, 2.3, 6, fill=0.93)
    with b.wall("east", 2.4):
        f.sofa(b, p, 1.8, 2)
    with b.wall("east"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.15), 3.3, 1.7, 1.3, 0.8)
    with b.wall("west", 0.4):
        f.bookshelf(b, p, 1.6, 2.5, 7, fill=0.97)
    with b.wall("west", 2.2):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.25), 4, 4)), p.wood, 1.3, 1.2, 0.45)
        f.plant(b, p, 0.3, -0.22, 0.6, 22, z=1.2)
        f.vase(b, p, 1.0, -0.22, 1.2, 0.3, 0.1)
    with b.wall("west"):
        f.picture(b, tx.framed(tx.abstract(rng), 0.5), 4.1, 1.7, 0.7, 0.7)
    with b.placed(2.3, 4.0):
        f.table(b, p.wood, p.dark_wood, 2.3, 0.9, 0.76)
        for x in (0.4, 1.9):
            f.desk_lamp(b, p, x, -0.4, 0.76)
        for x, count in ((0.8, 4), (1.4, 6)):
            with b.placed(x, -0.6, 0.76, yaw=float(rng.uniform(-20, 20))):
                f.stack_of_books(b, p, count)
        f.scatter_papers(b, p, 0.3, 2.1, -0.75, -0.2, 0.76, 8)
    for x, yaw in ((2.8, 5), (3.9, -8)):
        with b.placed(x, 2.95, yaw=yaw):
            f.chair(b, p)
    door(b, p, "south", 1.0)
    with b.wall("south", 1.8):
        f.bookshelf(b, p, 1.4, 2.0, 4, fill=0.95)
    with b.wall("south", 4.2):
        f.bookshelf(b, p, 2.2, 1.1, 3, fill=0.85)
    with b.wall("south"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.4), 5.3, 1.8, 1.1, 0.75)
    f.floor_lamp(b, p, 6.4, 3.9)
    return b.finish(
        "library",
        free_low=(2.0, 1.1, 1.35),
        free_high=(4.8, 2.1, 1.75),
        sights=[
            (3.4, 4.5, 1.2),
            (1.4, 4.4, 1.3),
            (0.2, 3.0, 1.2),
            (1.0, 4.4, 1.0),
            (4.3, 4.4, 1.3),
            (6.6, 3.4, 1.1),
            (6.8, 2.2, 1.2),
        ],
        ambient=0.35,
        brightness=0.4,
        description="simulated library, kept for tests",
    )


UNSEEN_SCENES: dict[str, Callable[[], Room]] = {
    "wall": _wall,
    "corridor": _corridor,
    "kitchen": _kitchen,
    "workshop": _workshop,
    "library": _library,
}
