"""Procedural grey textures: wood, plaster, fabric, books, pictures, screens; float32 in [0, 1]."""

import itertools

import numpy as np

Array = np.ndarray


def noise(
    rng: np.random.Generator, height: int, width: int, roughness: float = 1.5, stretch: float = 1.0
) -> Array:
    """Return tileable noise [H, W] of zero mean and unit deviation with spectrum 1 / f^roughness.

    `stretch` > 1 elongates it along x (wood grain).
    """
    fy = np.fft.fftfreq(height)[:, None] * height
    fx = np.fft.rfftfreq(width)[None] * width * stretch * height / width
    frequency = np.sqrt(fx**2 + fy**2)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((height, width))) / np.maximum(frequency, 2.0) ** roughness
    image = np.fft.irfft2(spectrum, s=(height, width))
    return (np.clip(image / image.std(), -3, 3)).astype(np.float32)


def profile(rng: np.random.Generator, width: int, roughness: float = 1.3) -> Array:
    """Return tileable 1D noise [W] of zero mean and unit deviation (skylines, curves)."""
    frequency = np.maximum(np.fft.rfftfreq(width) * width, 1.0)
    line = np.fft.irfft(np.fft.rfft(rng.standard_normal(width)) / frequency**roughness, n=width)
    line -= line.mean()
    return (line / line.std()).astype(np.float32)


def plaster(rng: np.random.Generator, base: float, contrast: float = 0.05) -> Array:
    """Painted wall: faint blotches and fine roller grain."""
    grain = noise(rng, 512, 512, 0.7)
    blotches = noise(rng, 512, 512, 1.8)
    return base * (1 + contrast * (0.6 * grain + 0.8 * blotches))


def mural(rng: np.random.Generator, height: int = 2048, width: int = 3072) -> Array:
    """A painted wall without repeats: grain of every size under overlapping discs and bars."""
    image = 0.45 * (1 + 0.18 * noise(rng, height, width, 1.2) + 0.06 * noise(rng, height, width, 0.4))
    for _ in range(height * width // 12_000):
        size = float(rng.uniform(12, 70))
        reach = int(1.5 * size) + 1
        cy, cx = int(rng.integers(reach, height - reach)), int(rng.integers(reach, width - reach))
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        if rng.random() < 0.5:
            inside = np.hypot(x, y) < size / 2
        else:
            angle = rng.uniform(0, np.pi)
            along = x * np.cos(angle) + y * np.sin(angle)
            across = y * np.cos(angle) - x * np.sin(angle)
            inside = (np.abs(along) < size) & (np.abs(across) < size / 6)
        patch = image[cy - reach : cy + reach + 1, cx - reach : cx + reach + 1]
        patch[inside] *= rng.uniform(0.35, 1.9)
    return np.clip(image, 0.04, 0.96).astype(np.float32)


def wallpaper(rng: np.random.Generator, base: float, pattern: str) -> Array:
    """Wallpaper with stripes, a damask of petals, or a lattice."""
    y, x = np.mgrid[0:512, 0:512] / 512.0
    if pattern == "stripes":
        figure = np.tanh(4 * np.sin(2 * np.pi * 8 * x)) + 0.4 * np.sign(np.sin(2 * np.pi * 64 * x))
    elif pattern == "petals":
        u, v = (x * 4) % 1 - 0.5, (y * 4 + 0.5 * np.floor(x * 4)) % 1 - 0.5
        radius, angle = np.hypot(u, v * 0.8), np.arctan2(v, u)
        figure = 2.0 * (radius < 0.26 + 0.12 * np.cos(5 * angle)) - 1.2 * (radius < 0.09) - 0.6
        figure = figure + 0.8 * (np.abs(radius - 0.45) < 0.02)
    else:
        u, v = (x + y) * 6, (x - y) * 6
        figure = 1.5 * ((np.abs(u % 1 - 0.5) > 0.44) | (np.abs(v % 1 - 0.5) > 0.44)) - 0.4
    return (base * (1 + 0.09 * figure + 0.04 * noise(rng, 512, 512, 0.8))).astype(np.float32)


def wood(rng: np.random.Generator, base: float, contrast: float = 0.11) -> Array:
    """Grain along x with year rings and pores."""
    y = np.linspace(0, 1, 512, endpoint=False)[:, None]
    warp = noise(rng, 512, 1024, 1.9, stretch=5)
    rings = np.sin(2 * np.pi * (9 * y + 0.55 * warp))
    pores = noise(rng, 512, 1024, 0.6, stretch=25)
    return (base * (1 + contrast * (0.7 * rings + 0.45 * pores + 0.5 * warp))).astype(np.float32)


def planks(rng: np.random.Generator, base: float, boards: int = 12) -> Array:
    """Floor boards of 1024 x 768 texels, each cut from its own piece of wood, with dark joints."""
    height, width = 768, 1024
    source = np.concatenate([wood(rng, 1.0, 0.11), wood(rng, 1.0, 0.14)], 0)
    image = np.empty((height, width), np.float32)
    rows = np.linspace(0, height, boards + 1).astype(int)
    for a, b in itertools.pairwise(rows):
        start, shade = 0, 1.0
        cuts = sorted(int(c) for c in (rng.uniform(0.1, 0.45) * width, rng.uniform(0.55, 0.95) * width))
        for end in [*cuts, width]:
            shade = rng.uniform(0.72, 1.18)
            oy, ox = rng.integers(0, source.shape[0] - (b - a)), rng.integers(0, width)
            strip = np.roll(source[oy : oy + b - a], ox, 1)[:, start:end]
            image[a:b, start:end] = base * shade * strip
            image[a:b, max(end - 2, 0) : end] *= 0.45
            start = end
        image[a : a + 2] *= 0.45
    return image


def tiles(
    rng: np.random.Generator, base: float, per_side: int = 6, spread: float = 0.12, grout: float = 0.5
) -> Array:
    """Square tiles with marbling, their own shades and grout."""
    size = 768
    image = base * (1 + 0.10 * noise(rng, size, size, 1.3) + 0.05 * noise(rng, size, size, 0.4))
    edges = np.linspace(0, size, per_side + 1).astype(int)
    for a, b in itertools.pairwise(edges):
        for c, d in itertools.pairwise(edges):
            image[a:b, c:d] *= 1 + spread * rng.standard_normal()
        image[a : a + 3] = base * grout
    for c in edges[:-1]:
        image[:, c : c + 3] = base * grout
    return image.astype(np.float32)


def brick(rng: np.random.Generator, base: float) -> Array:
    """Running-bond brick, 24 courses over 512 texels by 8 bricks."""
    height, width, courses, per_row = 480, 512, 24, 8
    image = np.empty((height, width), np.float32)
    h, w = height // courses, width // per_row
    for r in range(courses):
        row = np.repeat(rng.uniform(0.62, 1.3, per_row), w)
        image[r * h : (r + 1) * h] = np.roll(row, (r % 2) * w // 2)
    image *= base * (1 + 0.12 * noise(rng, height, width, 0.9))
    for r in range(courses):
        image[r * h : r * h + 3] = base * 1.6
        for k in range(per_row):
            c = (k * w + (r % 2) * w // 2) % width
            image[r * h : (r + 1) * h, c : c + 3] = base * 1.6
    return image


def carpet(rng: np.random.Generator, base: float, contrast: float = 0.09) -> Array:
    """Short-pile carpet: fine tufts with large worn patches and carpet-tile joints."""
    image = base * (1 + contrast * (noise(rng, 512, 512, 0.35) + 0.55 * noise(rng, 512, 512, 1.6)))
    flecks = noise(rng, 512, 512, 0.2) > 1.9
    image[flecks] *= 1.5
    image[:, ::256] *= 0.8
    image[::256] *= 0.8
    return image.astype(np.float32)


def rug(rng: np.random.Generator, base: float, height: int = 384, width: int = 576) -> Array:
    """A bordered rug with medallions and a geometric field."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    edge = np.minimum.reduce([x, y, width - 1 - x, height - 1 - y])
    u, v = np.abs(x - width / 2) / (width / 2), np.abs(y - height / 2) / (height / 2)
    field = 0.5 + 0.3 * np.sign(np.sin(x / 9) * np.sin(y / 9)) * (u + v < 0.75)
    field += 0.35 * (np.abs((u + v) % 0.3 - 0.15) < 0.03) - 0.25 * (np.hypot(u, v) < 0.22)
    field += 0.5 * (np.hypot(u, v) < 0.12)
    image = np.where(edge < 10, 0.9, np.where(edge < 46, 0.25, np.where(edge < 54, 0.95, field)))
    border = (edge >= 14) & (edge < 42) & ((x // 14 + y // 14) % 2 == 0)
    image = np.where(border, 0.75, image)
    return (base * 1.5 * image * (1 + 0.12 * noise(rng, height, width, 0.3))).astype(np.float32)


def fabric(rng: np.random.Generator, base: float, pattern: str = "weave") -> Array:
    """Cloth: weave, tartan, or stripes."""
    y, x = np.mgrid[0:256, 0:256]
    weave = 0.06 * np.sign(np.sin(2 * np.pi * x / 8) * np.sin(2 * np.pi * y / 8))
    image = 1 + weave + 0.07 * noise(rng, 256, 256, 1.0) + 0.05 * noise(rng, 256, 256, 0.2)
    if pattern == "tartan":
        for period, width, gain in ((64, 20, 0.62), (128, 8, 1.5), (64, 4, 0.7)):
            image = image * np.where(x % period < width, gain, 1) * np.where(y % period < width, gain, 1)
    elif pattern == "stripes":
        image = image * np.where(x % 64 < 26, 0.55, 1.15)
    elif pattern == "dots":
        image = image * np.where(np.hypot(x % 32 - 16, y % 32 - 16) < 8, 1.7, 0.9)
    return (base * image).astype(np.float32)


def curtain(rng: np.random.Generator, base: float) -> Array:
    """Hanging folds."""
    x = np.linspace(0, 1, 256, endpoint=False)[None]
    folds = np.sin(2 * np.pi * 7 * x + 0.8 * np.sin(2 * np.pi * 3 * x)) + 0.4 * np.sin(2 * np.pi * 17 * x)
    return (base * (1 + 0.28 * folds + 0.05 * noise(rng, 512, 256, 0.7))).astype(np.float32)


def leaf(rng: np.random.Generator, base: float) -> Array:
    """A leaf's blade with midrib and veins (opaque, stretched over a narrow quad)."""
    y, x = np.mgrid[0:128, 0:64] / np.array([128.0, 64.0])[:, None, None]
    veins = np.abs(((y * 7 + np.abs(x - 0.5) * 5) % 1) - 0.5) < 0.07
    image = base * (1 + 0.5 * (np.abs(x - 0.5) < 0.05) + 0.35 * veins + 0.15 * noise(rng, 128, 64, 1.0))
    return image.astype(np.float32)


def cardboard(rng: np.random.Generator, base: float) -> Array:
    """A parcel's face: tape, label, arrows, fibres."""
    image = base * (1 + 0.07 * noise(rng, 192, 256, 0.9))
    image[:, 118:140] *= 1.25
    image[60:130, 24:100] = 0.9
    for r in range(68, 124, 8):
        image[r : r + 3, 30 : 30 + int(rng.integers(20, 64))] = 0.15
    for c in range(160, 236, 3):
        if rng.random() < 0.6:
            image[140:172, c : c + 2] = 0.1
    image[10:40, 190:196] = image[10:16, 180:206] = 0.2
    return image.astype(np.float32)


def _text(
    image: Array,
    rng: np.random.Generator,
    top: int,
    left: int,
    bottom: int,
    right: int,
    line: int,
    ink: float,
) -> None:
    """Fill a rectangle with lines of word-like marks."""
    for y in range(top, bottom - line // 2, line):
        x, end = left, right - int(rng.integers(0, max((right - left) // 3, 1)))
        while x < end:
            word = int(rng.integers(2, 7)) * max(line // 4, 1)
            for c in range(x, min(x + word, end), max(line // 4, 1)):
                height = int(rng.integers(line // 3, line // 2 + 2))
                image[y + line // 2 + 1 - height : y + line // 2 + 1, c : c + max(line // 6, 1)] = ink
            x += word + max(line // 3, 2)


def paper(rng: np.random.Generator) -> Array:
    """A printed sheet: title, two paragraphs, a figure."""
    image = np.full((256, 180), 0.9, np.float32) + 0.01 * noise(rng, 256, 180, 1)
    _text(image, rng, 14, 20, 40, 150, 18, 0.1)
    _text(image, rng, 48, 16, 130, 166, 9, 0.2)
    image[140:196, 24:150] = 0.5 + 0.15 * noise(rng, 56, 126, 1.6)
    _text(image, rng, 204, 16, 246, 166, 9, 0.2)
    return image


def book_spine(rng: np.random.Generator) -> Array:
    """A spine, top up: cloth shade, bands, a vertical title, a publisher's mark."""
    base = float(rng.choice([0.16, 0.2, 0.25, 0.32, 0.42, 0.55, 0.68, 0.8]))
    ink = 0.8 if base < 0.45 else 0.14
    image = base * (1 + 0.08 * noise(rng, 192, 40, 0.8))
    for r in rng.choice([10, 16, 24, 160, 170, 180], 3, replace=False):
        image[r : r + int(rng.integers(2, 5))] = ink
    turned = np.ascontiguousarray(image[40:150].T)
    if rng.random() < 0.85:
        _text(turned, rng, 8, 6, 24, 104, 20, ink)
    else:
        turned[8:32, 15:90] = ink
    image[40:150] = turned.T
    image[:, :3] *= 0.7
    image[:, -3:] *= 0.7
    return image.astype(np.float32)


def landscape(rng: np.random.Generator, height: int = 240, width: int = 320) -> Array:
    """Sky with clouds, sun, ranges of mountains, a lake."""
    y, x = np.mgrid[0:height, 0:width] / np.array([height, width], np.float64)[:, None, None]
    image = 0.75 - 0.25 * (1 - y) + 0.08 * noise(rng, height, width, 1.8, stretch=2.5)
    cx, cy = rng.uniform(0.2, 0.8), rng.uniform(0.12, 0.3)
    image = np.where(np.hypot((x - cx) * width / height, y - cy) < 0.08, 0.97, image)
    for k, shade in enumerate((0.55, 0.36, 0.2)):
        ridge = 0.38 + 0.15 * k + 0.07 * profile(rng, width, 1.4)
        rough = 1 + 0.18 * noise(rng, height, width, 0.9)
        image = np.where(y > ridge[None], shade * rough, image)
    water = 0.5 + 0.25 * noise(rng, height, width, 1.0, stretch=9)
    return np.where(y > 0.86, water, image).astype(np.float32)


def portrait(rng: np.random.Generator, height: int = 280, width: int = 220) -> Array:
    """A painted head and shoulders against a mottled ground."""
    y, x = np.mgrid[0:height, 0:width] / np.array([height, width], np.float64)[:, None, None]
    image = 0.3 * (1 + 0.25 * noise(rng, height, width, 1.4))
    image = np.where(np.hypot((x - 0.5) / 0.42, (y - 1.02) / 0.36) < 1, 0.14, image)
    image = np.where(np.hypot((x - 0.5) / 0.25, (y - 0.38) / 0.27) < 1, 0.1, image)  # hair
    face = np.hypot((x - 0.5) / 0.19, (y - 0.43) / 0.23) < 1
    image = np.where(face, 0.72 - 0.5 * (x - 0.45), image)
    for dx in (-0.075, 0.075):
        image = np.where(np.hypot((x - 0.5 - dx) / 0.035, (y - 0.4) / 0.016) < 1, 0.08, image)
    image = np.where((np.abs(x - 0.5) < 0.06) & (np.abs(y - 0.55) < 0.012), 0.3, image)
    image = np.where((np.abs(x - 0.5) < 0.012) & (np.abs(y - 0.46) < 0.04), 0.5, image)
    return (image * (1 + 0.06 * noise(rng, height, width, 0.6))).astype(np.float32)


def abstract(rng: np.random.Generator, height: int = 260, width: int = 260) -> Array:
    """Overlapping discs and bars on a plain ground."""
    y, x = np.mgrid[0:height, 0:width]
    image = np.full((height, width), rng.uniform(0.6, 0.9))
    for _ in range(9):
        shade = rng.uniform(0.05, 0.95)
        cy, cx = rng.uniform(0, height), rng.uniform(0, width)
        if rng.random() < 0.5:
            image = np.where(np.hypot(x - cx, y - cy) < rng.uniform(14, 60), shade, image)
        else:
            angle, thick = rng.uniform(0, np.pi), rng.uniform(5, 26)
            image = np.where(
                np.abs((x - cx) * np.sin(angle) - (y - cy) * np.cos(angle)) < thick, shade, image
            )
    return (image * (1 + 0.05 * noise(rng, height, width, 0.8))).astype(np.float32)


def poster(rng: np.random.Generator) -> Array:
    """A printed poster: picture, headline, small print."""
    height, width = 340, 240
    ground = float(rng.choice([0.12, 0.85, 0.92]))
    ink = 0.95 if ground < 0.5 else 0.06
    image = np.full((height, width), ground, np.float32)
    picture = [landscape, abstract][int(rng.integers(2))](rng, 170, 200)
    image[20:190, 20:220] = picture
    _text(image, rng, 204, 20, 240, 224, 36, ink)
    _text(image, rng, 246, 20, 330, 224, 12, ink)
    return image


def framed(picture: Array, frame: float, mat: float | None = 0.92) -> Array:
    """Return a picture with a passe-partout and a wooden frame."""
    image = picture if mat is None else np.pad(picture, 22, constant_values=mat)
    image = np.pad(image, 3, constant_values=frame * 0.5)
    image = np.pad(image, 9, constant_values=frame)
    return np.pad(image, 2, constant_values=frame * 0.6).astype(np.float32)


def screen(rng: np.random.Generator, content: str) -> Array:
    """A lit monitor: program text, a desktop with windows, or a photograph."""
    height, width = 216, 384
    if content == "code":
        image = np.full((height, width), 0.10, np.float32)
        image[:12] = 0.3
        image[12:, :60] = 0.16
        _text(image, rng, 16, 5, 206, 56, 12, 0.55)
        for y in range(18, 206, 11):
            indent = 70 + 14 * int(rng.integers(0, 5))
            if rng.random() < 0.88:
                ink = float(rng.choice([0.5, 0.65, 0.85]))
                _text(
                    image,
                    rng,
                    y,
                    indent,
                    y + 10,
                    min(indent + int(rng.integers(60, 260)), width - 6),
                    10,
                    ink,
                )
        return image
    if content == "desktop":
        image = landscape(rng, height, width)
        image[200:] = 0.12
        for c in range(10, 180, 22):
            image[204:213, c : c + 12] = rng.uniform(0.4, 0.95)
        for _ in range(3):
            top, left = int(rng.integers(8, 80)), int(rng.integers(10, 190))
            image[top : top + 100, left : left + 170] = 0.93
            image[top : top + 12, left : left + 170] = 0.35
            _text(image, rng, top + 18, left + 8, top + 94, left + 160, 11, 0.15)
        return image
    image = np.full((height, width), 0.88, np.float32)  # a plot
    for k in range(4):
        curve = 110 + 25 * profile(rng, width, 1.6) - 20 * k + 12
        rows = np.clip(curve, 4, height - 5).astype(int)
        for d in range(-1, 2):
            image[rows + d, np.arange(width)] = 0.15 + 0.15 * k
    image[::36] *= 0.8
    image[:, ::48] *= 0.8
    image[:14] = 0.3
    return image


def keyboard(rng: np.random.Generator) -> Array:
    """Rows of keys with legends."""
    image = np.full((84, 240), 0.08, np.float32)
    for r in range(5):
        x = 5
        while x < 228:
            key = int(rng.choice([13, 13, 13, 13, 20])) if not (r == 4 and 60 < x < 90) else 80
            image[5 + r * 15 : 17 + r * 15, x : min(x + key - 2, 234)] = 0.24
            image[8 + r * 15 : 12 + r * 15, x + 3 : x + 6] = 0.7
            x += key + 1
    return image


def window_view(rng: np.random.Generator, kind: str) -> Array:
    """The view outside: a town or trees under a bright sky."""
    height, width = 360, 320
    y = np.linspace(0, 1, height)[:, None]
    image = 0.95 - 0.10 * y + 0.05 * noise(rng, height, width, 1.8, stretch=2)
    if kind == "town":
        left = 0
        while left < width:
            wide, top = int(rng.integers(30, 75)), int(rng.integers(110, 220))
            shade = rng.uniform(0.35, 0.75)
            image[top:, left : left + wide] = shade
            for r in range(top + 8, height - 8, 18):
                for c in range(left + 5, min(left + wide, width) - 8, 13):
                    image[r : r + 10, c : c + 7] = shade * rng.uniform(0.35, 0.6)
            left += wide
    else:
        crowns = 0.45 + 0.1 * profile(rng, width, 1.2)
        foliage = 0.38 * (1 + 0.4 * noise(rng, height, width, 1.0))
        image = np.where(y > crowns[None], foliage, image)
        for c in rng.integers(10, width - 14, 4):
            image[200:330, c : c + int(rng.integers(5, 12))] = 0.15
        image = np.where(y > 0.9, 0.55 * (1 + 0.15 * noise(rng, height, width, 0.8)), image)
    return image.astype(np.float32)


def whiteboard(rng: np.random.Generator) -> Array:
    """Handwriting, boxes and arrows on a white board."""
    height, width = 280, 440
    image = np.full((height, width), 0.93, np.float32) + 0.015 * noise(rng, height, width, 2)
    for r in range(30, 250, 26):
        x = float(rng.uniform(14, 40))
        end = rng.uniform(150, 215)
        phase = rng.uniform(0, 6)
        while x < end:
            yy = r + 4 * np.sin(x * 0.8 + phase) + 3 * np.sin(x * 0.31 + 2 * phase)
            image[int(yy) : int(yy) + 3, int(x) : int(x) + 2] = 0.12
            x += 0.6 if rng.random() < 0.97 else 9
    boxes = [(40, 240), (40, 350), (130, 295), (200, 240), (200, 350)]
    for r, c in boxes:
        image[r : r + 44, c : c + 70] = 0.2
        image[r + 3 : r + 41, c + 3 : c + 67] = 0.9
        _text(image, rng, r + 10, c + 8, r + 38, c + 62, 14, 0.15)
    for r, c, d in ((84, 274, 46), (84, 384, 46), (174, 310, 26)):
        image[r : r + d, c : c + 3] = 0.15
    image[60:63, 310:350] = 0.15
    return image


def pinboard(rng: np.random.Generator) -> Array:
    """Cork with notes and photographs."""
    image = 0.42 * (1 + 0.16 * noise(rng, 260, 380, 0.4))
    for _ in range(11):
        h, w = int(rng.integers(40, 78)), int(rng.integers(34, 70))
        r, c = int(rng.integers(6, 254 - h)), int(rng.integers(6, 374 - w))
        if rng.random() < 0.35:
            image[r : r + h, c : c + w] = landscape(rng, h, w)
        else:
            image[r : r + h, c : c + w] = rng.uniform(0.7, 0.95)
            _text(image, rng, r + 8, c + 5, r + h - 4, c + w - 5, 9, 0.15)
        image[r + 2 : r + 6, c + w // 2 : c + w // 2 + 4] = 0.05
    return image.astype(np.float32)


def clock(rng: np.random.Generator) -> Array:
    """A clock's face on a dark square rim."""
    y, x = np.mgrid[0:128, 0:128] - 63.5
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    image = np.where(radius < 60, 0.93, 0.3)
    image = np.where((radius > 56) & (radius < 62), 0.08, image)
    ticks = (radius > 44) & (radius < 53) & (np.abs((angle / (np.pi / 6) + 0.5) % 1 - 0.5) < 0.09)
    image = np.where(ticks, 0.05, image)
    for hand, length, thick in ((rng.uniform(0, 6), 28, 3), (rng.uniform(0, 6), 42, 2)):
        along, across = x * np.cos(hand) + y * np.sin(hand), -x * np.sin(hand) + y * np.cos(hand)
        image = np.where((along > -6) & (along < length) & (np.abs(across) < thick), 0.05, image)
    return image.astype(np.float32)


def panelled(rng: np.random.Generator, source: Array, rows: int, columns: int, handles: bool = True) -> Array:
    """Doors or drawers cut into a face: joints, bevels, handles."""
    height, width = 400, 300
    image = np.tile(source, (2, 2))[:height, :width].copy()
    edges_y = np.linspace(0, height, rows + 1).astype(int)
    edges_x = np.linspace(0, width, columns + 1).astype(int)
    for a, b in itertools.pairwise(edges_y):
        for k, (c, d) in enumerate(itertools.pairwise(edges_x)):
            image[a : a + 3, c:d] *= 0.35
            image[a:b, c : c + 3] *= 0.35
            image[a + 10 : a + 13, c + 10 : d - 10] *= 0.7
            image[b - 13 : b - 10, c + 10 : d - 10] *= 1.3
            image[a + 10 : b - 10, c + 10 : c + 13] *= 0.7
            image[a + 10 : b - 10, d - 13 : d - 10] *= 1.3
            if handles and b - a < 1.6 * (d - c):
                image[a + 22 : a + 29, (c + d) // 2 - 24 : (c + d) // 2 + 24] = 0.85
                image[a + 29 : a + 32, (c + d) // 2 - 24 : (c + d) // 2 + 24] = 0.1
            elif handles:
                x = d - 26 if k % 2 == 0 else c + 20
                image[(a + b) // 2 - 30 : (a + b) // 2 + 30, x : x + 7] = 0.85
    return image


def radiator(rng: np.random.Generator) -> Array:
    """Vertical fins."""
    x = np.arange(320)[None]
    fins = np.where(x % 16 < 9, 1.0, 0.45) * np.where(x % 16 < 2, 0.8, 1)
    return (0.75 * fins * (1 + 0.04 * noise(rng, 160, 320, 0.8))).astype(np.float32)


def ceiling(rng: np.random.Generator, base: float, panels: bool) -> Array:
    """Acoustic ceiling panels with perforations, or plain plaster."""
    image = base * (1 + 0.035 * noise(rng, 450, 450, 0.9))
    if panels:
        holes = noise(rng, 450, 450, 0.1) > 2.0
        image[holes] *= 0.72
        image[::150] = image[1::150] = base * 0.6
        image[:, ::150] = image[:, 1::150] = base * 0.6
    return image.astype(np.float32)


def metal(rng: np.random.Generator, base: float) -> Array:
    """Brushed or painted metal."""
    return (base * (1 + 0.07 * noise(rng, 256, 256, 0.8, stretch=14))).astype(np.float32)


def label(rng: np.random.Generator, base: float) -> Array:
    """A printed wrapper for mugs, tins and vases: bands, dots and letters once around."""
    image = np.full((96, 256), base, np.float32) * (1 + 0.04 * noise(rng, 96, 256, 0.8))
    ink = 0.9 if base < 0.5 else 0.12
    style = int(rng.integers(3))
    if style == 0:
        image[14:24] = image[70:82] = ink
        _text(image, rng, 32, 10, 66, 250, 30, ink)
    elif style == 1:
        y, x = np.mgrid[0:96, 0:256]
        image = np.where(np.hypot(x % 32 - 16, y % 32 - 16) < 9, ink, image)
    else:
        y, x = np.mgrid[0:96, 0:256]
        image = np.where((x + 2 * y) % 40 < 16, ink, image)
    return image.astype(np.float32)
