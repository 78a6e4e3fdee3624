"""Sequences that show another one: no attribute is lost, and what depends on time is repeated in time."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from edslam_ti.camera import Camera
from edslam_ti.datasets import EventDepthSequence, WrappedSequence
from edslam_ti.datasets.altered import AlteredSequence, RepeatedSequence
from edslam_ti.datasets.base import NovelView
from edslam_ti.events import Events
from edslam_ti.trajectory import Trajectory

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)
START, PERIOD = 2.0, 0.4  # s; the first pose is not at time 0

# Arguments for the methods that need some. A new method without arguments needs no line here.
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "depth": (2,),
    "image": (1,),
    "events": (START + 0.1, START + 0.3),
    "image_at": (START + 0.1,),
    "true_pose": (START + 0.15,),
    "depth_or_none": (2,),
    "image_or_none": (1,),
    "note": ("left out",),
}
# They follow from what the wrapper itself shows.
DERIVED = {"image_at", "true_pose", "depth_or_none", "image_or_none", "note"}


class LoopSequence(EventDepthSequence):
    """Comes back to where it began; every attribute of the base class differs from its default."""

    def __init__(self) -> None:
        for name in inspect.get_annotations(EventDepthSequence):
            setattr(self, name, object())  # stands for an attribute that does not exist yet
        stamps = START + np.arange(5) * 0.1
        poses = np.tile(np.eye(4), (5, 1, 1))
        poses[:, 0, 3] = [0.0, 0.1, 0.2, 0.1, 0.0]
        self.scene = "loop"
        self.camera = CAMERA
        self.truth = Trajectory(stamps, poses)
        self.depth_timestamps, self.image_timestamps = stamps, stamps
        t = START + np.arange(0.005, PERIOD, 0.01)
        zeros = np.zeros(len(t), np.int16)
        self._events = Events(zeros, zeros, t, np.ones(len(t), np.int8))

    def depth(self, index: int) -> np.ndarray:
        return np.arange(index + 1, index + 13, dtype=np.float32).reshape(CAMERA.shape)

    def image(self, index: int) -> np.ndarray:
        return np.full(CAMERA.shape, index / 10, np.float32)

    def events(self, start: float, end: float) -> Events:
        return self._events.between(start, end)

    @property
    def time_range(self) -> tuple[float, float]:
        return float(self._events.t[0]), float(self._events.t[-1])

    def novel_views(self) -> list[NovelView]:
        blank = np.zeros(CAMERA.shape, np.float32)
        return [NovelView(START + 0.05, blank, blank, np.eye(4))]


def public_names() -> list[str]:
    names = {*inspect.get_annotations(EventDepthSequence), *dir(EventDepthSequence)}
    return sorted(name for name in names if not name.startswith("_"))


def value(sequence: EventDepthSequence, name: str) -> Any:
    """Return an attribute, or what a method returns."""
    attribute = getattr(sequence, name)
    return attribute(*ARGUMENTS.get(name, ())) if inspect.ismethod(attribute) else attribute


def is_same(a: Any, b: Any) -> bool:
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(is_same(x, y) for x, y in zip(a, b))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, Events | NovelView | Trajectory):
        return is_same(list(vars(a).values()), list(vars(b).values()))
    return bool(a == b)


WRAPPERS: dict[str, tuple[Callable[[EventDepthSequence], EventDepthSequence], set[str]]] = {
    # how it is made, and what differs even when nothing is altered
    "wrapped": (lambda s: _Shown(s), set()),
    "altered": (AlteredSequence, set()),
    "repeated once": (lambda s: RepeatedSequence(s, 1), {"description"}),
    "repeated twice": (
        lambda s: RepeatedSequence(s, 2),
        {"description", "depth_timestamps", "image_timestamps", "truth", "time_range", "novel_views"},
    ),
}


class _Shown(WrappedSequence):
    """Changes nothing."""


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_no_attribute_is_lost(wrapper: str) -> None:
    make, changed = WRAPPERS[wrapper]
    original = LoopSequence()
    wrapped = make(original)
    names = public_names()
    different = {name for name in names if not is_same(value(wrapped, name), value(original, name))}
    assert {"exposure", "surfaces_file", "time_offset", "novel_views"} < set(names)
    assert different == changed


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_every_method_is_passed_on(wrapper: str) -> None:
    """Also one that has an answer in the base class, such as "no novel views"."""
    original = LoopSequence()
    wrapped = WRAPPERS[wrapper][0](original)
    called: set[str] = set()
    methods = {name for name in public_names() if inspect.ismethod(getattr(original, name))} - DERIVED
    for name in methods:
        setattr(original, name, functools.partial(_noted, called, name, getattr(original, name)))
    for name in methods:
        value(wrapped, name)
    assert called == methods


def _noted(called: set[str], name: str, method: Callable[..., Any], *arguments: Any) -> Any:
    called.add(name)
    return method(*arguments)


def test_every_round_repeats_data_that_depends_on_time() -> None:
    once = LoopSequence()
    thrice = RepeatedSequence(once, 3)
    rounds = START + np.arange(13) * 0.1
    np.testing.assert_allclose(thrice.depth_timestamps, rounds)
    np.testing.assert_allclose(thrice.image_timestamps, rounds)
    assert [v.timestamp for v in thrice.novel_views()] == pytest.approx(START + np.array([0.05, 0.45, 0.85]))
    assert thrice.truth is not None
    np.testing.assert_allclose(thrice.truth.timestamps, rounds)
    across = thrice.events(START + PERIOD - 0.1, START + PERIOD + 0.1)
    assert len(across) == 20  # one every 10 ms, on both sides of the seam
    np.testing.assert_allclose(np.diff(across.t), 0.01)
    assert len(thrice.events(0.0, 10.0)) == 3 * len(once.events(0.0, 10.0))
