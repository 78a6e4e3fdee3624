"""Furniture of the built-in rooms.

Every piece stands in a local frame: x to the right along the wall behind it, y = 0 at that wall and
negative towards the viewer, z up, origin on the floor; sizes in metres.
"""

from dataclasses import dataclass

import numpy as np

from edslam_ti.simulation import textures as tx
from edslam_ti.simulation.scene import Material, SceneBuilder


@dataclass(frozen=True)
class Palette:
    """Materials shared by the furniture of one room."""

    wood: Material
    dark_wood: Material
    light_wood: Material
    metal: Material
    black: Material
    white: Material
    fabric: Material
    accent: Material
    cushion: Material
    spines: list[Material]
    pages: Material
    paper: list[Material]
    cardboard: Material
    labels: list[Material]
    leaf: list[Material]
    keyboard: Material
    screens: list[Material]


def make_palette(
    builder: SceneBuilder,
    wood: float,
    dark: float,
    light: float,
    cloth: tuple[float, str],
    accent: tuple[float, str],
) -> Palette:
    """Return a palette of three wood shades and two cloths (shade, pattern)."""
    rng = builder.rng

    def tiled(image: np.ndarray) -> Material:
        return Material(builder.texture(image))

    def stretched(image: np.ndarray, luminous: bool = False) -> Material:
        return Material(builder.texture(image, repeat=False), texel=None, luminous=luminous)

    return Palette(
        wood=tiled(tx.wood(rng, wood)),
        dark_wood=tiled(tx.wood(rng, dark, 0.2)),
        light_wood=tiled(tx.wood(rng, light, 0.12)),
        metal=tiled(tx.metal(rng, 0.5)),
        black=tiled(tx.metal(rng, 0.09)),
        white=tiled(tx.plaster(rng, 0.85, 0.03)),
        fabric=tiled(tx.fabric(rng, *cloth)),
        accent=tiled(tx.fabric(rng, *accent)),
        cushion=tiled(tx.fabric(rng, 0.62, "dots")),
        spines=[stretched(tx.book_spine(rng)) for _ in range(36)],
        pages=Material(builder.texture(tx.metal(rng, 0.82)), texel=0.002),
        paper=[stretched(tx.paper(rng)) for _ in range(4)],
        cardboard=stretched(tx.cardboard(rng, 0.48)),
        labels=[stretched(tx.label(rng, b)) for b in (0.12, 0.3, 0.55, 0.8, 0.9)],
        leaf=[stretched(tx.leaf(rng, b)) for b in (0.2, 0.28, 0.4)],
        keyboard=stretched(tx.keyboard(rng)),
        screens=[stretched(tx.screen(rng, c), luminous=True) for c in ("code", "desktop", "plot", "code")],
    )


def picture(
    b: SceneBuilder, image: np.ndarray, x: float, z: float, width: float, height: float, thick: float = 0.025
) -> None:
    """Hang a picture with its centre at (x, z)."""
    front = Material(b.texture(image, repeat=False), texel=None)
    side = Material(front.texture, texel=0.004, tint=0.6)
    b.box(
        (x - width / 2, -thick, z - height / 2),
        (x + width / 2, -0.001, z + height / 2),
        side,
        front=front,
        back=None,
    )


def window(
    b: SceneBuilder, view: np.ndarray, x: float, sill: float, width: float, height: float, frame: Material
) -> None:
    """Set a window with mullions, a sill and the view outside into a wall."""
    outside = Material(b.texture(view, repeat=False), texel=None, luminous=True)
    x0, x1, z1 = x - width / 2, x + width / 2, sill + height
    b.quad((x0, -0.004, z1), (width, 0, 0), (0, 0, -height), outside)
    bar = 0.05
    for a, c in ((x0 - bar, x0 + 0.01), (x1 - 0.01, x1 + bar), (x - 0.025, x + 0.025)):
        b.box((a, -0.05, sill), (c, -0.003, z1), frame)
    for a, c in (
        (sill - 0.01, sill + 0.05),
        (z1 - 0.02, z1 + bar),
        (sill + 0.62 * height, sill + 0.62 * height + 0.04),
    ):
        b.box((x0 - bar, -0.055, a), (x1 + bar, -0.003, c), frame)
    b.box((x0 - 0.12, -0.2, sill - 0.05), (x1 + 0.12, -0.003, sill - 0.01), frame)


def curtain(
    b: SceneBuilder, image: np.ndarray, x: float, width: float, top: float, bottom: float = 0.05
) -> None:
    """Hang a folded curtain from `top`: a zigzag of narrow strips."""
    cloth = Material(b.texture(image, repeat=False), texel=None)
    folds = max(int(width / 0.07), 4)
    edges = np.linspace(x - width / 2, x + width / 2, folds + 1)
    depth = [-0.09 - 0.035 * (k % 2) - 0.01 * np.sin(3.1 * k) for k in range(folds + 1)]
    for k in range(folds):
        b.quad(
            (edges[k], depth[k], top),
            (edges[k + 1] - edges[k], depth[k + 1] - depth[k], 0),
            (0, 0, bottom - top),
            cloth,
            (k / folds, (k + 1) / folds),
        )


def book(b: SceneBuilder, p: Palette, thickness: float, height: float, depth: float) -> None:
    """Add an upright book whose spine faces the viewer; its left lower front corner at the origin."""
    rng = b.rng
    spine = p.spines[int(rng.integers(len(p.spines)))]
    cover = Material(spine.texture, texel=0.004, tint=0.9)
    b.box((0, 0, 0), (thickness, depth, height), cover, front=spine, top=p.pages, back=None, bottom=None)


def books(
    b: SceneBuilder, p: Palette, x0: float, x1: float, y: float, z: float, room: float, fill: float = 0.95
) -> None:
    """Fill a shelf from x0 to x1 (front edges near y) with books, gaps, a leaning one, some objects."""
    rng = b.rng
    x = x0 + 0.01
    while x < x1 - 0.06:
        if rng.random() > fill:
            kind = rng.random()
            width = float(rng.uniform(0.10, 0.17))
            if x + width > x1:
                break
            if kind < 0.35:
                vase(b, p, x + width / 2, y + 0.1, z, min(room * 0.75, 0.22), width * 0.36)
            elif kind < 0.65:
                b.box((x, y + 0.03, z), (x + width, y + 0.2, z + min(0.6 * room, 0.16)), p.cardboard)
            else:
                top = z
                for _ in range(int(rng.integers(2, 5))):
                    with b.placed(x, y + rng.uniform(0, 0.03), top):
                        lying_book(b, p, width + 0.05, float(rng.uniform(0.02, 0.035)))
                    top += 0.03
                width += 0.06
            x += width + float(rng.uniform(0.01, 0.05))
            continue
        thickness = float(rng.uniform(0.016, 0.055))
        height = float(rng.uniform(0.62, 0.93)) * room
        if x + thickness > x1:
            break
        with b.placed(x, y + float(rng.uniform(0.0, 0.035)), z):
            book(b, p, thickness, height, 0.17)
        x += thickness + 0.0015
        if rng.random() < 0.04:
            x += float(rng.uniform(0.03, 0.09))


def lying_book(b: SceneBuilder, p: Palette, width: float, thickness: float, depth: float = 0.16) -> None:
    """Add a book lying flat, its spine towards the viewer."""
    spine = p.spines[int(b.rng.integers(len(p.spines)))]
    cover = Material(spine.texture, texel=0.004)
    turned = Material(spine.texture, texel=None, turned=True)
    b.box((0, 0, 0), (width, depth, thickness), cover, front=turned, right=p.pages, left=p.pages)


def bookshelf(
    b: SceneBuilder,
    p: Palette,
    width: float,
    height: float,
    shelves: int,
    depth: float = 0.28,
    fill: float = 0.95,
) -> None:
    """Add an open bookcase full of books, its left back corner at the origin."""
    t = 0.025
    wood = p.wood
    b.box((0, -depth, 0), (t, 0, height), wood)
    b.box((width - t, -depth, 0), (width, 0, height), wood)
    b.quad(
        (t, -0.01, height),
        (width - 2 * t, 0, 0),
        (0, 0, -height),
        Material(wood.texture, tint=0.8, turned=True),
    )
    gap = (height - 0.08) / shelves
    for k in range(shelves + 1):
        z = 0.08 + k * gap
        b.box((t, -depth, z - t), (width - t, -0.005, z), wood)
        if k < shelves:
            books(b, p, t, width - t, -depth + 0.02, z, gap - t, fill)
    b.box((t, -depth + 0.02, 0), (width - t, -depth + 0.03, 0.06), p.dark_wood)


def cabinet(
    b: SceneBuilder, face: Material, body: Material, width: float, height: float, depth: float
) -> None:
    """Add a closed cabinet or chest of drawers, its left back corner at the origin."""
    b.box((0, -depth, 0.05), (width, 0, height - 0.03), body, front=face)
    b.box((-0.015, -depth - 0.015, height - 0.03), (width + 0.015, 0, height), body)
    b.box((0.03, -depth + 0.03, 0), (width - 0.03, 0, 0.05), Material(body.texture, tint=0.4))


def table(b: SceneBuilder, top: Material, legs: Material, width: float, depth: float, height: float) -> None:
    """Add a table with four legs and an apron, its left back corner at the origin."""
    b.box((0, -depth, height - 0.035), (width, 0, height), top)
    b.box((0.06, -depth + 0.06, height - 0.1), (width - 0.06, -0.06, height - 0.035), legs)
    for x in (0.04, width - 0.1):
        for y in (-depth + 0.04, -0.1):
            b.box((x, y, 0), (x + 0.06, y + 0.06, height - 0.035), legs)


def desk(
    b: SceneBuilder, p: Palette, drawers: Material, width: float, depth: float = 0.75, height: float = 0.74
) -> None:
    """Add a desk with a drawer block on the right, its left back corner at the origin."""
    b.box((0, -depth, height - 0.035), (width, 0, height), p.light_wood)
    b.box((0.02, -depth + 0.05, 0), (0.06, -0.05, height - 0.035), p.metal)
    b.box((width - 0.46, -depth + 0.04, 0.04), (width - 0.03, -0.03, height - 0.035), p.wood, front=drawers)
    b.box((0.06, -0.06, 0.3), (width - 0.46, -0.04, height - 0.035), p.wood)


def monitor(b: SceneBuilder, p: Palette, which: int, width: float = 0.54) -> None:
    """Add a monitor on its stand, centred at the origin, facing -y."""
    height = width * 9 / 16
    z0 = 0.13
    b.box((-0.11, -0.09, 0), (0.11, 0.09, 0.015), p.black)
    b.box((-0.025, 0.0, 0.015), (0.025, 0.03, z0 + 0.1), p.metal)
    b.box((-width / 2 - 0.015, -0.035, z0 - 0.02), (width / 2 + 0.015, 0.0, z0 + height + 0.015), p.black)
    shown = p.screens[which % len(p.screens)]
    b.quad((-width / 2, -0.037, z0 + height), (width, 0, 0), (0, 0, -height), shown)


def workplace(b: SceneBuilder, p: Palette, width: float, screens: int, height: float = 0.74) -> None:
    """Cover a desk (left back corner at the origin) with monitors, keyboard, papers, mug, books, lamp."""
    rng = b.rng
    middle = width * 0.42
    for k in range(screens):
        shift = (k - (screens - 1) / 2) * 0.6
        with b.placed(
            middle + shift, -0.24 + 0.06 * abs(shift), height, yaw=-18 * shift + rng.uniform(-4, 4)
        ):
            monitor(b, p, int(rng.integers(4)))
    with b.placed(middle - 0.22, -0.62, height, yaw=rng.uniform(-6, 6)):
        b.box((0, 0, 0), (0.44, 0.15, 0.022), p.black, top=p.keyboard)
    with b.placed(middle + 0.3, -0.58, height, yaw=rng.uniform(-20, 20)):
        b.box((0, 0, 0), (0.06, 0.1, 0.03), p.metal)
    scatter_papers(b, p, 0.05, middle - 0.27, -0.66, -0.2, height, 4)
    scatter_papers(b, p, middle + 0.42, width - 0.24, -0.66, -0.35, height, 4)
    mug(b, p, width - 0.13, -0.52, height)
    with b.placed(width - 0.3, -0.24, height, yaw=rng.uniform(-12, 12)):
        stack_of_books(b, p, int(rng.integers(3, 6)))
    desk_lamp(b, p, 0.12, -0.16, height)


def scatter_papers(
    b: SceneBuilder, p: Palette, x0: float, x1: float, y0: float, y1: float, z: float, count: int
) -> None:
    """Strew sheets of paper over a table top."""
    rng = b.rng
    for k in range(count):
        if x1 - x0 < 0.05:
            return
        with b.placed(
            float(rng.uniform(x0, x1)),
            float(rng.uniform(y0, y1)),
            z + 0.002 * (k + 1),
            yaw=float(rng.uniform(-35, 35)),
        ):
            b.box((-0.105, -0.148, 0), (0.105, 0.148, 0.0015), p.white, top=p.paper[int(rng.integers(4))])


def stack_of_books(b: SceneBuilder, p: Palette, count: int) -> None:
    """Pile books at the origin."""
    z = 0.0
    for _ in range(count):
        thickness = float(b.rng.uniform(0.018, 0.045))
        with b.placed(
            float(b.rng.uniform(-0.02, 0.02)),
            float(b.rng.uniform(-0.02, 0.02)),
            z,
            yaw=float(b.rng.uniform(-12, 12)),
        ):
            lying_book(b, p, float(b.rng.uniform(0.2, 0.27)), thickness)
        z += thickness


def mug(b: SceneBuilder, p: Palette, x: float, y: float, z: float) -> None:
    """Add a mug with its handle."""
    wrap = p.labels[int(b.rng.integers(len(p.labels)))]
    b.cylinder(x, y, z, z + 0.1, 0.042, wrap, top=Material(p.dark_wood.texture, tint=0.5), sides=12)
    b.box((x + 0.04, y - 0.006, z + 0.02), (x + 0.07, y + 0.006, z + 0.08), p.white)


def vase(b: SceneBuilder, p: Palette, x: float, y: float, z: float, height: float, radius: float) -> None:
    """Add a bellied vase with a patterned wrap."""
    wrap = p.labels[int(b.rng.integers(len(p.labels)))]
    b.cylinder(x, y, z, z + 0.55 * height, 0.7 * radius, wrap, sides=12, top_radius=radius)
    b.cylinder(x, y, z + 0.55 * height, z + height, radius, wrap, p.black, sides=12, top_radius=0.5 * radius)


def desk_lamp(b: SceneBuilder, p: Palette, x: float, y: float, z: float) -> None:
    """Add a lamp: foot, arm, shade."""
    b.cylinder(x, y, z, z + 0.02, 0.08, p.black, sides=12)
    b.cylinder(x, y, z + 0.02, z + 0.4, 0.013, p.metal, sides=6)
    with b.placed(x, y, z + 0.38, yaw=-30):
        b.box((-0.01, -0.22, 0), (0.01, 0.01, 0.02), p.metal)
        b.cylinder(0, -0.2, -0.09, 0.05, 0.09, p.accent, sides=12, top_radius=0.04)


def floor_lamp(b: SceneBuilder, p: Palette, x: float, y: float, height: float = 1.6) -> None:
    """Add a standing lamp with a cloth shade."""
    b.cylinder(x, y, 0, 0.03, 0.15, p.black, sides=14)
    b.cylinder(x, y, 0.03, height - 0.25, 0.017, p.metal, sides=8)
    bright = Material(p.white.texture, tint=1.08, luminous=True)
    b.cylinder(x, y, height - 0.28, height, 0.2, bright, p.white, sides=16, top_radius=0.14)


def plant(
    b: SceneBuilder, p: Palette, x: float, y: float, height: float, leaves: int = 26, z: float = 0.0
) -> None:
    """Add a potted plant with drooping leaves."""
    rng = b.rng
    pot = 0.16 * height
    b.cylinder(
        x,
        y,
        z,
        z + 1.6 * pot,
        0.75 * pot,
        p.labels[int(rng.integers(5))],
        p.dark_wood,
        sides=12,
        top_radius=pot,
    )
    b.cylinder(x, y, z + 1.6 * pot, z + 0.7 * height, 0.012, p.dark_wood, sides=6)
    for k in range(leaves):
        angle = 2.4 * k + float(rng.uniform(-0.3, 0.3))
        base = 0.3 * height + 0.5 * height * k / leaves
        length = float(rng.uniform(0.28, 0.42)) * height * (1.1 - 0.5 * k / leaves)
        rise = float(rng.uniform(-0.1, 0.9))
        out = np.array([np.cos(angle), np.sin(angle), rise])
        out *= length / np.linalg.norm(out)
        side = np.array([-np.sin(angle), np.cos(angle), 0.25]) * 0.3 * length
        start = np.array([x, y, z + base])
        corner = start + out - side / 2
        drop = -out
        b.quad(tuple(corner), tuple(side), tuple(drop), p.leaf[int(rng.integers(3))])


def office_chair(b: SceneBuilder, p: Palette) -> None:
    """Add a swivel chair centred at the origin, facing +y."""
    for k in range(5):
        with b.placed(yaw=72 * k + 10):
            b.box((0, -0.025, 0.05), (0.3, 0.025, 0.09), p.black)
            b.box((0.26, -0.02, 0), (0.31, 0.02, 0.05), p.black)
    b.cylinder(0, 0, 0.08, 0.42, 0.03, p.metal, sides=8)
    b.box((-0.24, -0.23, 0.42), (0.24, 0.24, 0.5), p.accent)
    b.box((-0.03, -0.27, 0.4), (0.03, -0.24, 0.75), p.black)
    with b.placed(0, -0.25, 0.62, pitch=8):
        b.box((-0.22, -0.03, 0), (0.22, 0.03, 0.46), p.accent)
    for x in (-0.29, 0.25):
        b.box((x, -0.15, 0.66), (x + 0.05, 0.12, 0.69), p.black)
        b.box((x + 0.01, -0.02, 0.46), (x + 0.03, 0.02, 0.66), p.black)


def chair(b: SceneBuilder, p: Palette) -> None:
    """Add a wooden chair centred at the origin, facing +y."""
    for x in (-0.2, 0.16):
        b.box((x, -0.2, 0), (x + 0.04, -0.16, 0.92), p.dark_wood)
        b.box((x, 0.16, 0), (x + 0.04, 0.2, 0.44), p.dark_wood)
    b.box((-0.22, -0.21, 0.43), (0.22, 0.22, 0.47), p.wood)
    b.box((-0.19, -0.17, 0.47), (0.19, 0.2, 0.5), p.accent)
    for z in (0.58, 0.7, 0.82):
        b.box((-0.17, -0.19, z), (0.17, -0.17, z + 0.07), p.wood)


def sofa(b: SceneBuilder, p: Palette, width: float, seats: int, depth: float = 0.88) -> None:
    """Add a sofa with cushions, its left back corner at the origin."""
    rng = b.rng
    arm = 0.18
    b.box((0, -depth, 0.08), (width, 0, 0.3), p.fabric)
    b.box((0, -0.22, 0.3), (width, 0, 0.82), p.fabric)
    for x in (0, width - arm):
        b.box((x, -depth, 0.3), (x + arm, -0.02, 0.6), p.fabric)
    seat = (width - 2 * arm) / seats
    for k in range(seats):
        x = arm + k * seat
        b.box(
            (x + 0.01, -depth - 0.03, 0.3),
            (x + seat - 0.01, -0.22, 0.46),
            Material(p.fabric.texture, tint=1.15),
        )
        with b.placed(x + 0.02, -0.36, 0.46, pitch=-10):
            b.box((0, 0, 0), (seat - 0.04, 0.14, 0.42), Material(p.fabric.texture, tint=1.08))
    for x in (arm + 0.12, width - arm - 0.5):
        with b.placed(x, -0.53, 0.47, yaw=float(rng.uniform(-8, 8)), pitch=-18):
            b.box((0, 0, 0), (0.4, 0.12, 0.38), p.cushion if rng.random() < 0.5 else p.accent)
    for x in (0.05, width - 0.1):
        for y in (-depth + 0.04, -0.1):
            b.box((x, y, 0), (x + 0.05, y + 0.05, 0.08), p.dark_wood)


def bed(b: SceneBuilder, p: Palette, width: float = 1.5, length: float = 2.0) -> None:
    """Add a bed with its head at the wall, left back corner at the origin."""
    b.box((-0.04, -0.08, 0), (width + 0.04, 0, 1.05), p.dark_wood)
    b.box((0, -length, 0.1), (width, -0.08, 0.3), p.wood)
    b.box((0.02, -length + 0.02, 0.3), (width - 0.02, -0.08, 0.5), p.white)
    b.box((-0.03, -length - 0.02, 0.34), (width + 0.03, -0.75, 0.56), p.fabric)
    b.box((-0.035, -length - 0.025, 0.42), (width + 0.035, -length + 0.55, 0.575), p.accent)
    for x in (0.1, width / 2 + 0.06):
        with b.placed(x, -0.32, 0.5, pitch=-38):
            b.box((0, 0, 0), (width / 2 - 0.16, 0.15, 0.4), p.cushion)


def box_pile(b: SceneBuilder, p: Palette) -> None:
    """Pile cardboard boxes around the origin."""
    rng = b.rng
    for x, y, z, size in ((0, -0.25, 0, 0.42), (0.48, -0.2, 0, 0.34), (0.08, -0.22, 0.36, 0.32)):
        with b.placed(x, y, z, yaw=float(rng.uniform(-20, 20))):
            b.box((0, -size / 2, 0), (size, size / 2, 0.85 * size), p.cardboard)


def bin_(b: SceneBuilder, p: Palette, x: float, y: float) -> None:
    """Add a waste-paper bin with crumpled paper."""
    b.cylinder(x, y, 0, 0.32, 0.11, p.metal, p.black, sides=14, top_radius=0.14)
    for k in range(3):
        with b.placed(x - 0.03 + 0.04 * k, y - 0.02, 0.3, yaw=40.0 * k, pitch=25):
            b.box((-0.04, -0.04, 0), (0.04, 0.04, 0.07), p.paper[k])


def television(b: SceneBuilder, p: Palette, width: float, z: float) -> None:
    """Hang a television, centred on x = 0."""
    height = width * 9 / 16
    b.box((-width / 2 - 0.02, -0.06, z - 0.02), (width / 2 + 0.02, -0.01, z + height + 0.02), p.black)
    shown = Material(b.texture(tx.screen(b.rng, "desktop"), repeat=False), texel=None, luminous=True)
    b.quad((-width / 2, -0.062, z + height), (width, 0, 0), (0, 0, -height), shown)
