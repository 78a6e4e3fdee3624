"""Five procedural furnished rooms, named after the EventReplica scenes that they stand in for.

World: metres, z up; the floor is z = 0 and the room spans x in [0, width], y in [0, depth].
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from edslam_ti.simulation import furniture as f
from edslam_ti.simulation import lighting
from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.lighting import Lamp
from edslam_ti.simulation.scene import Material, Scene, SceneBuilder

Point = tuple[float, float, float]  # metres

ROOM_NAMES = ("room0", "room2", "office0", "office2", "office3")


@dataclass(frozen=True)
class Room:
    """A furnished room, the space where a camera may move, and the points it should look at."""

    name: str
    scene: Scene
    free_low: np.ndarray  # [3] metres, smallest corner of the box free of furniture
    free_high: np.ndarray  # [3]
    sights: np.ndarray  # [S, 3] metres, in the order in which they are looked at
    is_closed: bool = True  # there is something to see in every direction
    tour: np.ndarray | None = None  # [P, 3] metres, a closed walk through several rooms


class RoomBuilder(SceneBuilder):
    """A room's shell with named walls."""

    def __init__(self, seed: int, width: float, depth: float, height: float) -> None:
        super().__init__(seed)
        self.width, self.depth, self.height = width, depth, height
        self.lamps: list[Lamp] = []

    @contextmanager
    def wall(self, side: str, along: float = 0.0, out: float = 0.0) -> Iterator[None]:
        """Enter the frame of a wall at `along` metres from its left end, `out` metres in front of it."""
        x, y, yaw = {
            "north": (0.0, self.depth, 0.0),
            "south": (self.width, 0.0, 180.0),
            "east": (self.width, self.depth, -90.0),
            "west": (0.0, 0.0, 90.0),
        }[side]
        with self.placed(x, y, 0.0, yaw), self.placed(along, -out):
            yield

    def length(self, side: str) -> float:
        """Return the length of a wall."""
        return self.width if side in ("north", "south") else self.depth

    def shell(
        self, walls: dict[str, Material], floor: Material, ceiling: Material, skirting: Material
    ) -> None:
        """Add floor, ceiling, walls and skirting boards."""
        w, d, h = self.width, self.depth, self.height
        self.quad((0, d, 0), (w, 0, 0), (0, -d, 0), floor)
        self.quad((0, 0, h), (w, 0, 0), (0, d, 0), ceiling)
        for side, material in walls.items():
            with self.wall(side):
                self.quad((0, 0, h), (self.length(side), 0, 0), (0, 0, -h), material)
                self.box((0, -0.016, 0), (self.length(side), -0.001, 0.09), skirting, back=None, bottom=None)
                self.box((0, -0.03, h - 0.05), (self.length(side), -0.001, h), skirting, back=None, top=None)

    def lamp_panel(
        self, x: float, y: float, size: tuple[float, float], power: float, frame: Material
    ) -> None:
        """Set a luminous panel into the ceiling."""
        a, c = size[0] / 2, size[1] / 2
        z = self.height - 0.035
        glow = Material(
            self.texture(np.full((16, 16), 0.95, np.float32), repeat=False), texel=None, luminous=True
        )
        self.quad((x - a, y - c, z), (size[0], 0, 0), (0, size[1], 0), glow)
        for low, high in (
            ((x - a - 0.03, y - c - 0.03), (x - a, y + c + 0.03)),
            ((x + a, y - c - 0.03), (x + a + 0.03, y + c + 0.03)),
            ((x - a, y - c - 0.03), (x + a, y - c)),
            ((x - a, y + c), (x + a, y + c + 0.03)),
        ):
            self.box((*low, z - 0.01), (*high, self.height), frame, top=None)
        self.lamps.append(Lamp((x, y, z - 0.02), (a, 0, 0), (0, c, 0), (0, 0, -1), power))

    def window_light(
        self, side: str, along: float, z: float, width: float, height: float, power: float
    ) -> None:
        """Add daylight from a window: an area light just inside."""
        with self.wall(side, along):
            R, t = self._frame[:3, :3], self._frame[:3, 3]
            centre = R @ np.array([0, -0.06, z + height / 2]) + t
            u, n = R @ np.array([width / 2, 0, 0]), R @ np.array([0, -1, 0])
        self.lamps.append(Lamp(_point(centre), _point(u), (0, 0, height / 2), _point(n), power))

    def finish(
        self,
        name: str,
        free_low: Point,
        free_high: Point,
        sights: list[Point],
        ambient: float,
        brightness: float,
        description: str | None = None,
    ) -> Room:
        """Bake the light and return the room."""
        light = lighting.bake(self, self.lamps, ambient, brightness, seed=1)
        description = description or f"procedural stand-in for EventReplica's '{name}', not Replica"
        return Room(
            name,
            self.build(description, light),
            np.array(free_low),
            np.array(free_high),
            np.array(sights, np.float64),
        )


def _point(vector: np.ndarray) -> Point:
    return float(vector[0]), float(vector[1]), float(vector[2])


def tiled(b: SceneBuilder, image: np.ndarray, texel: float = 0.004, turned: bool = False) -> Material:
    """Return a material that repeats an image, `texel` metres per pixel."""
    return Material(b.texture(image), texel=texel, turned=turned)


def stretched(b: SceneBuilder, image: np.ndarray) -> Material:
    """Return a material that shows an image once over a whole face."""
    return Material(b.texture(image, repeat=False), texel=None)


def door(b: RoomBuilder, p: f.Palette, side: str, along: float) -> None:
    """Add a panelled door in its frame."""
    leaf = stretched(b, tx.panelled(b.rng, tx.wood(b.rng, 0.5, 0.1), 3, 2, handles=False))
    with b.wall(side, along):
        b.box((-0.45, -0.03, 0), (0.45, -0.001, 2.05), p.light_wood, front=leaf, back=None)
        for x in (-0.53, 0.45):
            b.box((x, -0.05, 0), (x + 0.08, -0.001, 2.13), p.white, back=None)
        b.box((-0.53, -0.05, 2.05), (0.53, -0.001, 2.13), p.white, back=None)
        b.box((0.33, -0.08, 1.0), (0.4, -0.03, 1.03), p.metal)


def _office0() -> Room:
    """A two-desk study: bookcases, double monitors, whiteboard, window with radiator."""
    b = RoomBuilder(100, 4.8, 4.4, 2.7)
    rng = b.rng
    p = f.make_palette(b, wood=0.42, dark=0.2, light=0.62, cloth=(0.3, "weave"), accent=(0.17, "weave"))
    wall = tiled(b, tx.plaster(rng, 0.66))
    papered = tiled(b, tx.wallpaper(rng, 0.52, "lattice"))
    b.shell(
        {"north": wall, "south": wall, "east": papered, "west": wall},
        tiled(b, tx.carpet(rng, 0.33)),
        tiled(b, tx.ceiling(rng, 0.8, panels=True)),
        p.white,
    )
    for x in (1.5, 3.3):
        for y in (1.4, 3.0):
            b.lamp_panel(x, y, (1.2, 0.3), 0.55, p.metal)
    drawers = stretched(b, tx.panelled(rng, tx.wood(rng, 0.45), 3, 1))
    with b.wall("north", 0.15):
        f.desk(b, p, drawers, 1.9)
        f.workplace(b, p, 1.9, 2)
    with b.wall("north", 2.35):
        f.desk(b, p, drawers, 1.7)
        f.workplace(b, p, 1.7, 1)
    with b.wall("north"):
        f.picture(b, tx.whiteboard(rng), 1.1, 1.78, 1.5, 0.85)
        f.picture(b, tx.poster(rng), 2.35, 1.75, 0.5, 0.7)
        f.picture(b, tx.framed(tx.landscape(rng), 0.2), 3.2, 1.75, 0.75, 0.55)
        f.picture(b, tx.clock(rng), 4.1, 2.1, 0.3, 0.3)
        f.picture(b, tx.poster(rng), 4.25, 1.55, 0.42, 0.6)
    with b.placed(0.95, 3.05, yaw=20):
        f.office_chair(b, p)
    with b.placed(3.1, 3.0, yaw=-25):
        f.office_chair(b, p)
    with b.wall("east", 0.9):
        f.bookshelf(b, p, 1.1, 2.1, 6)
    with b.wall("east", 2.05):
        f.bookshelf(b, p, 0.9, 1.5, 4, fill=0.88)
    with b.wall("east", 2.1):
        f.vase(b, p, 0.2, -0.14, 1.5, 0.26, 0.09)
        with b.placed(0.45, -0.22, 1.5, yaw=10):
            b.box((0, 0, 0), (0.3, 0.2, 0.18), p.cardboard)
        f.picture(b, tx.framed(tx.portrait(rng), 0.55), 0.35, 2.05, 0.42, 0.5)
        f.picture(b, tx.framed(tx.abstract(rng), 0.1), 1.55, 1.7, 0.6, 0.6)
    with b.wall("east", 3.25):
        f.cabinet(b, drawers, p.metal, 0.5, 0.75, 0.5)
        f.plant(b, p, 0.25, -0.25, 0.75, z=0.75)
    with b.wall("west"):
        f.window(b, tx.window_view(rng, "town"), 2.3, 0.95, 1.6, 1.25, p.white)
        f.curtain(b, tx.curtain(rng, 0.5), 1.2, 0.55, 2.4, 0.75)
        f.curtain(b, tx.curtain(rng, 0.5), 3.4, 0.55, 2.4, 0.75)
        b.box((1.6, -0.12, 0.12), (3.0, -0.03, 0.7), p.white, front=stretched(b, tx.radiator(rng)))
        f.picture(b, tx.pinboard(rng), 0.5, 1.6, 0.8, 0.6)
    b.window_light("west", 2.3, 0.95, 1.6, 1.25, 1.1)
    with b.wall("west", 3.75):
        f.plant(b, p, 0.0, -0.35, 1.5, 34)
    with b.wall("west", 0.25):
        f.box_pile(b, p)
    with b.wall("south", 0.4):
        f.bookshelf(b, p, 1.3, 1.9, 5)
    with b.wall("south", 1.9):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.metal(rng, 0.55), 4, 1)), p.metal, 0.5, 1.32, 0.55)
    door(b, p, "south", 3.4)
    with b.wall("south"):
        f.picture(b, tx.poster(rng), 2.2, 1.85, 0.5, 0.7)
    f.bin_(b, p, 2.25, 3.75)
    return b.finish(
        "office0",
        free_low=(1.6, 1.2, 1.15),
        free_high=(3.3, 2.4, 1.65),
        sights=[
            (1.1, 4.2, 1.0),
            (3.2, 4.2, 1.0),
            (4.7, 3.0, 1.1),
            (4.7, 1.9, 1.0),
            (3.1, 4.3, 1.3),
            (1.0, 4.3, 1.2),
            (0.1, 2.6, 1.1),
        ],
        ambient=0.42,
        brightness=0.6,
    )


def _office2() -> Room:
    """An open-plan corner: island of four desks against brick, pinboards, metal cabinets."""
    b = RoomBuilder(102, 6.2, 5.0, 2.9)
    rng = b.rng
    p = f.make_palette(b, wood=0.55, dark=0.28, light=0.72, cloth=(0.22, "stripes"), accent=(0.38, "weave"))
    brick = tiled(b, tx.brick(rng, 0.33), texel=0.0036)
    wall = tiled(b, tx.plaster(rng, 0.72))
    b.shell(
        {"north": brick, "south": wall, "east": wall, "west": tiled(b, tx.wallpaper(rng, 0.6, "stripes"))},
        tiled(b, tx.planks(rng, 0.46)),
        tiled(b, tx.ceiling(rng, 0.82, panels=True)),
        p.dark_wood,
    )
    for x in (1.6, 4.6):
        for y in (1.2, 3.6):
            b.lamp_panel(x, y, (0.6, 1.2), 0.75, p.white)
    drawers = stretched(b, tx.panelled(rng, tx.metal(rng, 0.6), 3, 1))
    for along, screens in ((0.5, 2), (2.45, 2), (4.35, 1)):
        with b.wall("north", along):
            f.desk(b, p, drawers, 1.7)
            f.workplace(b, p, 1.7, screens)
    for x, yaw in ((1.2, 15), (3.2, -10), (5.1, 30)):
        with b.placed(x, 3.65, yaw=yaw):
            f.office_chair(b, p)
    with b.wall("north"):
        f.picture(b, tx.poster(rng), 0.75, 1.85, 0.55, 0.78)
        f.picture(b, tx.poster(rng), 2.0, 1.9, 0.55, 0.78)
        f.picture(b, tx.framed(tx.abstract(rng), 0.08), 3.3, 1.9, 0.8, 0.8)
        f.picture(b, tx.framed(tx.landscape(rng), 0.6), 4.6, 1.85, 0.9, 0.65)
        f.picture(b, tx.clock(rng), 5.6, 2.2, 0.34, 0.34)
    with b.wall("east"):
        f.window(b, tx.window_view(rng, "trees"), 1.3, 0.9, 1.5, 1.5, p.white)
        f.window(b, tx.window_view(rng, "town"), 3.3, 0.9, 1.5, 1.5, p.white)
        f.curtain(b, tx.curtain(rng, 0.62), 2.3, 0.45, 2.6)
    b.window_light("east", 1.3, 0.9, 1.5, 1.5, 1.2)
    b.window_light("east", 3.3, 0.9, 1.5, 1.5, 1.2)
    with b.wall("east", 0.5):
        f.table(b, p.light_wood, p.metal, 1.9, 0.55, 0.72)
        with b.placed(0.3, -0.3, 0.72):
            f.stack_of_books(b, p, 5)
        f.plant(b, p, 0.9, -0.25, 0.6, z=0.72)
        with b.placed(1.3, -0.35, 0.72, yaw=15):
            b.box((0, 0, 0), (0.42, 0.3, 0.26), p.cardboard)
    with b.wall("east", 3.0):
        f.box_pile(b, p)
    with b.wall("west", 0.3):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.metal(rng, 0.5), 4, 1)), p.metal, 0.55, 1.4, 0.6)
    with b.wall("west", 0.95):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.metal(rng, 0.5), 1, 2)), p.metal, 0.9, 1.9, 0.45)
    with b.wall("west", 2.0):
        f.bookshelf(b, p, 1.6, 1.75, 5)
    with b.wall("west"):
        f.picture(b, tx.pinboard(rng), 4.2, 1.6, 1.1, 0.8)
        f.picture(b, tx.framed(tx.portrait(rng), 0.3), 2.4, 2.2, 0.45, 0.55)
    with b.wall("west", 3.75):
        f.cabinet(b, drawers, p.wood, 0.9, 0.7, 0.45)
        f.vase(b, p, 0.25, -0.22, 0.7, 0.3, 0.1)
        with b.placed(0.5, -0.3, 0.7):
            f.stack_of_books(b, p, 4)
    door(b, p, "south", 1.2)
    with b.wall("south", 2.2):
        f.bookshelf(b, p, 1.8, 2.1, 6)
    with b.wall("south"):
        f.picture(b, tx.whiteboard(rng), 5.0, 1.6, 1.7, 1.0)
    f.plant(b, p, 0.45, 4.5, 1.4, 30)
    f.bin_(b, p, 2.3, 4.4)
    return b.finish(
        "office2",
        free_low=(1.6, 1.3, 1.15),
        free_high=(4.6, 2.9, 1.7),
        sights=[
            (3.2, 4.9, 1.1),
            (1.3, 4.8, 1.0),
            (0.1, 2.9, 1.0),
            (0.2, 1.6, 1.0),
            (1.4, 4.9, 1.2),
            (5.0, 4.8, 1.1),
            (6.1, 3.3, 1.0),
        ],
        ambient=0.4,
        brightness=0.6,
    )


def _office3() -> Room:
    """A meeting room: long table with laptops and cups, chairs around, screen wall, shelf wall."""
    b = RoomBuilder(103, 5.6, 5.2, 2.7)
    rng = b.rng
    p = f.make_palette(b, wood=0.34, dark=0.15, light=0.5, cloth=(0.45, "tartan"), accent=(0.28, "stripes"))
    wall = tiled(b, tx.plaster(rng, 0.58))
    panels = tiled(b, tx.wood(rng, 0.4, 0.15), turned=True)
    b.shell(
        {"north": panels, "south": wall, "east": wall, "west": tiled(b, tx.wallpaper(rng, 0.48, "petals"))},
        tiled(b, tx.tiles(rng, 0.52)),
        tiled(b, tx.ceiling(rng, 0.76, panels=False)),
        p.dark_wood,
    )
    for x in (1.3, 2.8, 4.3):
        b.lamp_panel(x, 2.7, (0.6, 1.8), 0.95, p.white)
    with b.wall("north", 2.8):
        f.television(b, p, 1.7, 1.05)
    with b.wall("north", 1.5):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.3), 1, 4)), p.dark_wood, 2.6, 0.7, 0.45)
        f.vase(b, p, 0.2, -0.2, 0.7, 0.32, 0.1)
        for x in (0.6, 1.2, 1.9):
            with b.placed(x, -0.32, 0.7, yaw=float(rng.uniform(-10, 10))):
                f.stack_of_books(b, p, int(rng.integers(2, 5)))
        f.plant(b, p, 2.4, -0.22, 0.55, 20, z=0.7)
    with b.wall("north"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.7), 0.8, 1.65, 0.9, 0.7)
        f.picture(b, tx.framed(tx.abstract(rng), 0.8), 4.8, 1.65, 0.8, 0.8)
    f.plant(b, p, 0.6, 4.75, 1.5, 32)
    f.floor_lamp(b, p, 5.1, 4.7)
    with b.placed(1.55, 3.85):
        f.table(b, p.wood, p.metal, 2.5, 1.05, 0.74)
        f.scatter_papers(b, p, 0.2, 2.3, -0.85, -0.2, 0.74, 9)
        for x, y in ((0.35, -0.3), (1.25, -0.75), (2.1, -0.35)):
            f.mug(b, p, x, y, 0.74)
        with b.placed(1.7, -0.5, 0.74, yaw=10):
            b.box((-0.17, -0.12, 0), (0.17, 0.12, 0.02), p.metal, top=p.keyboard)
            with b.placed(0, 0.12, 0.02, pitch=-15):
                b.box((-0.17, 0, 0), (0.17, 0.01, 0.23), p.black, front=p.screens[0])
        with b.placed(0.7, -0.6, 0.74):
            f.stack_of_books(b, p, 3)
        f.vase(b, p, 1.2, -0.45, 0.74, 0.3, 0.08)
    for x, y, yaw in (
        (2.0, 4.2, 175),
        (2.9, 4.25, 190),
        (3.7, 4.15, 182),
        (1.15, 3.3, -85),
        (4.5, 3.3, 95),
        (2.2, 2.5, 5),
        (3.4, 2.45, -12),
    ):
        with b.placed(x, y, yaw=yaw):
            f.chair(b, p)
    with b.wall("east", 0.5):
        f.bookshelf(b, p, 1.5, 2.0, 5)
    with b.wall("east", 2.1):
        f.bookshelf(b, p, 1.2, 2.0, 5, fill=0.85)
    with b.wall("east"):
        f.picture(b, tx.poster(rng), 3.9, 1.6, 0.6, 0.85)
        f.picture(b, tx.poster(rng), 4.7, 1.6, 0.6, 0.85)
    with b.wall("west"):
        f.window(b, tx.window_view(rng, "trees"), 3.4, 0.9, 1.5, 1.35, p.white)
        f.curtain(b, tx.curtain(rng, 0.36), 2.4, 0.5, 2.45)
        f.curtain(b, tx.curtain(rng, 0.36), 4.4, 0.5, 2.45)
        f.picture(b, tx.framed(tx.portrait(rng), 0.15), 1.6, 1.6, 0.55, 0.68)
        f.picture(b, tx.whiteboard(rng), 0.7, 1.6, 0.8, 0.55)
        b.box((2.75, -0.12, 0.12), (4.05, -0.03, 0.7), p.white, front=stretched(b, tx.radiator(rng)))
    b.window_light("west", 3.4, 0.9, 1.5, 1.35, 1.0)
    with b.wall("west", 0.3):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.42), 3, 2)), p.wood, 1.2, 0.95, 0.45)
        f.desk_lamp(b, p, 0.25, -0.2, 0.95)
        with b.placed(0.6, -0.3, 0.95, yaw=-8):
            b.box((0, 0, 0), (0.4, 0.26, 0.22), p.cardboard)
    door(b, p, "south", 1.0)
    with b.wall("south", 2.2):
        f.sofa(b, p, 1.9, 2)
    with b.wall("south"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.25), 3.1, 1.65, 1.1, 0.7)
        f.picture(b, tx.pinboard(rng), 4.7, 1.6, 0.8, 0.6)
    return b.finish(
        "office3",
        free_low=(1.3, 1.0, 1.2),
        free_high=(4.4, 1.9, 1.7),
        sights=[
            (2.8, 5.1, 1.1),
            (1.6, 4.6, 0.9),
            (0.2, 3.4, 1.0),
            (2.2, 3.6, 0.8),
            (3.6, 4.8, 1.0),
            (5.5, 3.4, 1.0),
            (5.5, 4.2, 1.1),
        ],
        ambient=0.42,
        brightness=0.6,
    )


def _room0() -> Room:
    """A living room: sofa and armchair around a table on a rug, television, bookcase, plants."""
    b = RoomBuilder(110, 5.4, 5.0, 2.6)
    rng = b.rng
    p = f.make_palette(b, wood=0.38, dark=0.18, light=0.58, cloth=(0.42, "weave"), accent=(0.3, "tartan"))
    wall = tiled(b, tx.plaster(rng, 0.7))
    b.shell(
        {"north": tiled(b, tx.wallpaper(rng, 0.55, "petals")), "south": wall, "east": wall, "west": wall},
        tiled(b, tx.planks(rng, 0.4)),
        tiled(b, tx.ceiling(rng, 0.85, panels=False)),
        p.white,
    )
    b.lamp_panel(2.7, 2.6, (1.0, 1.0), 1.6, p.dark_wood)
    b.lamp_panel(1.0, 4.2, (0.35, 0.35), 0.35, p.metal)
    b.lamp_panel(4.4, 4.2, (0.35, 0.35), 0.35, p.metal)
    rug = stretched(b, tx.rug(rng, 0.5))
    with b.placed(1.35, 3.75):
        b.box((0, -1.7, 0), (2.6, 0, 0.012), p.fabric, top=rug)
    with b.wall("north", 1.5):
        f.sofa(b, p, 2.2, 3)
    with b.wall("north"):
        f.picture(b, tx.framed(tx.landscape(rng), 0.2), 2.6, 1.62, 1.1, 0.75)
        f.picture(b, tx.framed(tx.portrait(rng), 0.5), 1.5, 1.6, 0.5, 0.62)
        f.picture(b, tx.framed(tx.abstract(rng), 0.1), 3.65, 1.6, 0.6, 0.6)
        f.floor_lamp(b, p, 1.15, -0.35)
        f.plant(b, p, 4.15, -0.4, 1.25, 30)
    with b.wall("north", 0.15):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.4), 3, 1)), p.wood, 0.65, 0.6, 0.45)
        f.vase(b, p, 0.2, -0.2, 0.6, 0.3, 0.1)
        with b.placed(0.36, -0.3, 0.6):
            f.stack_of_books(b, p, 3)
    with b.placed(2.05, 3.45):
        f.table(b, p.wood, p.dark_wood, 1.15, 0.65, 0.42)
        with b.placed(0.15, -0.4, 0.42, yaw=15):
            f.stack_of_books(b, p, 4)
        f.mug(b, p, 0.6, -0.2, 0.42)
        f.vase(b, p, 0.75, -0.4, 0.42, 0.24, 0.07)
        f.scatter_papers(b, p, 0.5, 1.0, -0.5, -0.2, 0.42, 3)
    with b.placed(0.85, 2.6, yaw=80), b.placed(-0.5, 0.45):
        f.sofa(b, p, 1.0, 1)
    with b.wall("east", 0.6):
        f.bookshelf(b, p, 1.4, 2.05, 6)
    with b.wall("east", 2.15):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.3), 1, 3)), p.dark_wood, 1.6, 0.55, 0.45)
        with b.placed(0.3, -0.32, 0.55):
            f.stack_of_books(b, p, 3)
        f.vase(b, p, 1.4, -0.2, 0.55, 0.34, 0.1)
    with b.wall("east", 2.95):
        f.television(b, p, 1.25, 0.85)
    with b.wall("east"):
        f.picture(b, tx.poster(rng), 4.2, 1.6, 0.6, 0.85)
    with b.wall("west"):
        f.window(b, tx.window_view(rng, "trees"), 3.0, 0.85, 1.7, 1.35, p.white)
        f.curtain(b, tx.curtain(rng, 0.42), 1.9, 0.6, 2.4)
        f.curtain(b, tx.curtain(rng, 0.42), 4.1, 0.6, 2.4)
        f.picture(b, tx.framed(tx.landscape(rng), 0.45), 0.9, 1.6, 0.8, 0.6)
    b.window_light("west", 3.0, 0.85, 1.7, 1.35, 1.3)
    with b.wall("west", 0.3):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.45), 2, 2)), p.light_wood, 1.2, 0.8, 0.42)
        f.desk_lamp(b, p, 0.25, -0.2, 0.8)
        f.plant(b, p, 0.85, -0.2, 0.5, 18, z=0.8)
    door(b, p, "south", 4.3)
    with b.wall("south", 0.5):
        f.bookshelf(b, p, 1.1, 1.2, 3)
    with b.wall("south"):
        f.picture(b, tx.framed(tx.abstract(rng), 0.6), 1.1, 1.75, 0.9, 0.7)
        f.picture(b, tx.clock(rng), 2.5, 2.0, 0.36, 0.36)
    with b.wall("south", 2.1):
        f.table(b, p.light_wood, p.wood, 1.2, 0.7, 0.75)
        f.mug(b, p, 0.3, -0.3, 0.75)
        f.scatter_papers(b, p, 0.4, 1.0, -0.5, -0.2, 0.75, 3)
    with b.placed(2.7, 1.0, yaw=185):
        f.chair(b, p)
    return b.finish(
        "room0",
        free_low=(1.8, 1.4, 1.15),
        free_high=(3.8, 2.4, 1.6),
        sights=[
            (2.6, 4.8, 0.9),
            (4.0, 4.7, 0.9),
            (5.3, 3.6, 0.9),
            (5.3, 2.2, 0.9),
            (3.0, 4.8, 1.0),
            (1.4, 4.7, 0.9),
            (0.1, 3.2, 0.9),
        ],
        ambient=0.42,
        brightness=0.6,
    )


def _room2() -> Room:
    """A bedroom-cum-dining room: bed, wardrobe, laid table with chairs, shelves, two windows."""
    b = RoomBuilder(112, 5.8, 4.8, 2.65)
    rng = b.rng
    p = f.make_palette(b, wood=0.5, dark=0.25, light=0.68, cloth=(0.5, "stripes"), accent=(0.25, "dots"))
    wall = tiled(b, tx.wallpaper(rng, 0.62, "stripes"))
    b.shell(
        {"north": wall, "south": wall, "east": tiled(b, tx.plaster(rng, 0.5)), "west": wall},
        tiled(b, tx.planks(rng, 0.55, boards=8)),
        tiled(b, tx.ceiling(rng, 0.84, panels=False)),
        p.light_wood,
    )
    b.lamp_panel(1.7, 2.8, (0.7, 0.7), 1.0, p.white)
    b.lamp_panel(4.2, 2.8, (0.7, 0.7), 1.0, p.white)
    with b.wall("north", 0.75):
        f.bed(b, p)
    with b.wall("north"):
        for x in (0.15, 2.4):
            with b.placed(x):
                f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.5), 2, 1)), p.wood, 0.48, 0.52, 0.4)
        f.desk_lamp(b, p, 0.4, -0.15, 0.52)
        with b.placed(2.5, -0.3, 0.52):
            f.stack_of_books(b, p, 4)
        f.picture(b, tx.framed(tx.landscape(rng), 0.3), 1.5, 1.7, 1.1, 0.75)
        f.picture(b, tx.framed(tx.abstract(rng), 0.7), 2.65, 1.65, 0.6, 0.6)
        f.window(b, tx.window_view(rng, "town"), 4.2, 0.9, 1.4, 1.3, p.white)
        f.curtain(b, tx.curtain(rng, 0.4), 3.3, 0.45, 2.45)
        f.curtain(b, tx.curtain(rng, 0.4), 5.1, 0.45, 2.45)
    b.window_light("north", 4.2, 0.9, 1.4, 1.3, 1.2)
    rug = stretched(b, tx.rug(rng, 0.42))
    with b.placed(2.9, 4.1):
        b.box((0, -1.5, 0), (2.3, 0, 0.012), p.fabric, top=rug)
    with b.placed(3.45, 3.85):
        f.table(b, p.light_wood, p.dark_wood, 1.4, 0.9, 0.75)
        f.vase(b, p, 0.7, -0.4, 0.75, 0.3, 0.09)
        for x, y in ((0.25, -0.25), (1.1, -0.65), (1.15, -0.2)):
            f.mug(b, p, x, y, 0.75)
        f.scatter_papers(b, p, 0.2, 1.2, -0.7, -0.2, 0.75, 4)
        with b.placed(0.3, -0.7, 0.75, yaw=12):
            f.stack_of_books(b, p, 3)
    for x, y, yaw in ((3.8, 4.15, 178), (4.5, 4.1, 190), (3.9, 2.65, 4), (4.6, 2.7, -10), (5.15, 3.4, 92)):
        with b.placed(x, y, yaw=yaw):
            f.chair(b, p)
    with b.wall("east", 0.25):
        f.plant(b, p, 0.1, -0.4, 1.3, 30)
    with b.wall("east", 1.4):
        f.bookshelf(b, p, 1.5, 1.9, 5)
    with b.wall("east", 3.0):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.45), 4, 2)), p.wood, 1.1, 1.0, 0.5)
        f.vase(b, p, 0.3, -0.25, 1.0, 0.34, 0.11)
        with b.placed(0.6, -0.35, 1.0, yaw=-6):
            b.box((0, 0, 0), (0.36, 0.26, 0.2), p.cardboard)
    with b.wall("east"):
        f.picture(b, tx.poster(rng), 0.9, 1.7, 0.55, 0.78)
        f.picture(b, tx.framed(tx.portrait(rng), 0.2), 3.6, 1.85, 0.5, 0.62)
        f.picture(b, tx.clock(rng), 4.4, 2.0, 0.32, 0.32)
    with b.wall("west", 1.4):
        f.cabinet(b, stretched(b, tx.panelled(rng, tx.wood(rng, 0.55), 1, 3)), p.light_wood, 1.8, 2.2, 0.6)
    with b.wall("west", 0.2):
        f.box_pile(b, p)
    with b.wall("west"):
        f.picture(b, tx.framed(tx.abstract(rng), 0.2), 3.9, 1.65, 0.7, 0.7)
        f.picture(b, tx.poster(rng), 0.7, 1.65, 0.55, 0.78)
    door(b, p, "south", 4.9)
    with b.wall("south", 0.6):
        f.desk(b, p, stretched(b, tx.panelled(rng, tx.wood(rng, 0.5), 3, 1)), 1.6)
        f.workplace(b, p, 1.6, 1)
    with b.wall("south", 2.4):
        f.bookshelf(b, p, 1.2, 1.7, 4)
    with b.wall("south"):
        f.picture(b, tx.pinboard(rng), 1.4, 1.75, 1.0, 0.7)
    return b.finish(
        "room2",
        free_low=(1.9, 1.2, 1.2),
        free_high=(3.9, 1.9, 1.65),
        sights=[
            (1.6, 4.4, 0.8),
            (2.7, 4.6, 1.0),
            (4.2, 4.4, 0.9),
            (5.6, 2.8, 1.0),
            (4.3, 3.6, 0.8),
            (2.4, 4.6, 0.9),
            (0.3, 2.9, 1.0),
        ],
        ambient=0.42,
        brightness=0.6,
    )


ROOMS: dict[str, Callable[[], Room]] = {
    "room0": _room0,
    "room2": _room2,
    "office0": _office0,
    "office2": _office2,
    "office3": _office3,
}
