"""Objects come back as they were: values, memory layout, what is shared, random numbers still to come."""

import functools
import json
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from edslam_ti import object_graph
from edslam_ti.camera import Camera
from edslam_ti.config import Config
from edslam_ti.mapping.gaussians import Moments
from edslam_ti.object_graph import Graph, StateError, from_graph, outside_of, to_graph


def to_json(graph: Graph) -> str:
    """Return all but the arrays, as a checkpoint writes it."""
    return json.dumps({"root": graph.root, "nodes": graph.nodes}, separators=(",", ":"))


@dataclass
class Thing:
    """Stands for a class of ours."""

    parts: Any = None
    settings: Config | None = None
    extra: list[Any] = field(default_factory=list)

    @functools.cached_property
    def computed(self) -> np.ndarray:
        return np.zeros(10)


@pytest.fixture(autouse=True)
def things_are_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_graph, "STATE_MODULES", (*object_graph.STATE_MODULES, __name__))


def is_outside(value: Any) -> bool:
    return isinstance(value, Config)


def copied(value: Any, fresh: Any = None) -> Any:
    """Return what comes back of a value through JSON and raw arrays."""
    fresh = value if fresh is None else fresh
    graph = to_graph(value, outside_of(value, is_outside))
    content = json.loads(to_json(graph))
    arrays = [np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape).copy() for a in graph.arrays]
    return from_graph(Graph(content["root"], content["nodes"], arrays), outside_of(fresh, is_outside))


@pytest.mark.parametrize(
    "value",
    [
        *(None, True, 3, 2**100, 0.1, -0.0, float("inf"), "text \ud800", (1, (2.5, None)), [1, [2]], {3, 1}),
        *({1: "a", (2, 3): [4]}, deque([1, 2], maxlen=3), Camera(4, 3, 1.5, 1.5, 1.0, 1.0)),
    ],
    ids=repr,
)
def test_plain_values_and_containers_come_back(value: Any) -> None:
    result = copied(value)
    assert result == value
    assert type(result) is type(value)
    if isinstance(value, deque):
        assert result.maxlen == value.maxlen
    if isinstance(value, dict):
        assert list(result) == list(value)


@pytest.mark.parametrize(
    "array",
    [
        *(np.arange(6.0).reshape(2, 3), np.zeros((0, 4), np.int16), np.array(7), np.array([np.nan, np.inf])),
        *(np.arange(24).reshape(2, 3, 4).transpose(2, 0, 1), np.arange(10)[::2], np.array([True, False])),
    ],
    ids=["C", "empty", "of no dimension", "not finite", "transposed", "every other", "bool"],
)
def test_arrays_come_back_in_the_same_layout(array: np.ndarray) -> None:
    result = copied(array)
    np.testing.assert_array_equal(result, array)
    assert (result.dtype, result.shape) == (array.dtype, array.shape)
    assert result.flags.writeable
    order = np.argsort([-s for s in array.strides], kind="stable")
    if array.flags.owndata or array.ndim > 1:  # sums add up in the order of the memory
        assert list(np.argsort([-s for s in result.strides], kind="stable")) == list(order)


def test_scalars_stay_numpys() -> None:
    for value in (np.float32(0.1), np.int64(5), np.bool_(True), np.float64(0.1)):
        result = copied([value])[0]
        assert type(result) is type(value)
        assert result == value


def test_tensors_keep_what_they_need() -> None:
    value = torch.randn(3, 4, generator=torch.Generator().manual_seed(0)).requires_grad_()
    result = copied({"raw": value, "moments": Moments.zeros_like(value), "of ints": torch.arange(3)})
    assert torch.equal(result["raw"], value)
    assert result["raw"].requires_grad
    assert result["raw"].is_leaf
    assert isinstance(result["moments"], Moments)
    assert result["of ints"].dtype == torch.int64


def test_what_is_held_twice_is_one_object() -> None:
    array, inner = np.arange(3), Thing(1)
    thing = Thing([array, inner], extra=[inner, array])
    thing.extra.append(thing)  # and even itself
    result = copied(thing)
    assert result.parts[0] is result.extra[1]
    assert result.parts[1] is result.extra[0]
    assert result.extra[2] is result
    result.parts[0][0] = 9
    assert result.extra[1][0] == 9


def test_generators_go_on_with_the_same_numbers() -> None:
    numpy, of_torch = np.random.default_rng(3), torch.Generator().manual_seed(3)
    numpy.random(5), torch.randn(5, generator=of_torch)
    thing = copied(Thing([numpy, of_torch], extra=[numpy]))
    np.testing.assert_array_equal(thing.parts[0].random(4), numpy.random(4))
    assert torch.equal(torch.randn(4, generator=thing.parts[1]), torch.randn(4, generator=of_torch))
    assert thing.parts[0] is thing.extra[0]


def test_adam_goes_on_with_the_same_steps() -> None:
    table = torch.ones(5, requires_grad=True)
    thing = Thing({"table": table, "adam": torch.optim.Adam([table], lr=0.1, eps=1e-15, fused=True)})

    def step(parts: dict[str, Any]) -> None:
        (parts["table"] ** 3).sum().backward()
        parts["adam"].step()
        parts["adam"].zero_grad(set_to_none=True)

    step(thing.parts)
    thing.parts["adam"].param_groups[0]["lr"] = 0.02
    again = copied(thing)
    for _ in range(3):
        step(thing.parts)
        step(again.parts)
    assert torch.equal(again.parts["table"], thing.parts["table"])


def test_what_is_outside_comes_from_the_object_built_anew() -> None:
    thing, fresh = Thing([1], Config(), extra=[print]), Thing(None, Config(), extra=[print])
    graph = to_graph(Thing([2], thing.settings), outside_of(thing, is_outside))
    assert "office0" not in to_json(graph)
    assert from_graph(graph, outside_of(fresh, is_outside)).settings is fresh.settings


def test_what_can_be_computed_is_not_written() -> None:
    thing = Thing()
    thing.computed[0] = 5
    assert len(to_graph(thing, {}).arrays) == 0
    assert copied(thing).computed[0] == 0


class NotListed:
    __module__ = "edslam_ti.config"


@pytest.mark.parametrize(
    "value",
    [
        *(NotListed(), lambda: None, np.array([None]), Config(), np.random.Generator(np.random.MT19937())),
        *(b"bytes", 1j, (torch.ones(2, requires_grad=True) * 2), type("List", (list,), {})()),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_no_state_is_refused_with_the_way_to_it(value: Any) -> None:
    with pytest.raises(StateError, match=r"state that can be kept"):
        to_graph({"a": [value]}, {})


def test_what_can_be_written_through_another_array_is_refused() -> None:
    base = np.arange(6)
    for pair in ([base, base[2:]], [base[3:], base], [base, torch.from_numpy(base)]):
        with pytest.raises(StateError, match="is in the memory of"):
            to_graph(pair, {})


def test_parts_of_one_array_come_back_as_arrays_of_their_own() -> None:
    base = np.arange(6)
    np.testing.assert_array_equal(copied([base[:2], base[2:]])[1], base[2:])
    base.flags.writeable = False
    np.testing.assert_array_equal(copied([base, base[2:]])[1], base[2:])


@pytest.mark.parametrize(
    "node",
    [
        *(["object", "os:system", {}], ["object", "edslam_ti.config:Config", {}]),
        *(["object", "edslam_ti.tracking.tracker:Callable", {}], ["named", "builtins:tuple", []]),
        *(["object", "edslam_ti.tracking.tracker:np.ndarray", {}], ["unknown", 1], ["outside", ".x"]),
        ["list", [[5]]],
        *(["array", 7, []], ["generator", {"bit_generator": "PCG64"}], []),
    ],
    ids=str,
)
def test_what_was_not_written_is_not_made(node: list[Any]) -> None:
    with pytest.raises(StateError):
        from_graph(Graph([0], [node]), {})
