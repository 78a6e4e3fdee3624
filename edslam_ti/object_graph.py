"""Objects of this package and all that they hold, as JSON and raw arrays, and back; no pickle.

What an object is made of is written: plain values, containers, arrays, tensors, random generators, Adam, and
instances of our own classes, each once however often it is held. What belongs to the outside (settings, the
recording, functions) is named by the way that leads to it in the freshly built object, and taken from there
again. Nothing else is written, and reading makes nothing else: the modules whose classes may come back are
listed, and no code of a class is run.
"""

import functools
import importlib
import inspect
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edslam_ti.errors import DataError

# Modules, or packages with a dot behind them, whose classes are state of a run.
STATE_MODULES = (
    *("edslam_ti.slam", "edslam_ti.trajectory", "edslam_ti.frame", "edslam_ti.events", "edslam_ti.camera"),
    *("edslam_ti.tracking.", "edslam_ti.mapping.", "edslam_ti.event_images."),
    "edslam_ti.kernels.patch_warp",
    *("edslam_ti.baselines.gicp", "edslam_ti.baselines.splatam."),
    *("edslam_ti.baselines.depth_event_vo", "edslam_ti.baselines.semi_dense"),
    "edslam_ti.baselines.inc_event_gs",
)
PLAIN = (type(None), bool, int, float, str)  # JSON holds them exactly


class StateError(DataError):
    """State that cannot be written, or that is not what was written."""


@dataclass
class Graph:
    """Objects as JSON: a value is plain, or `[k]`, the k-th node; a node is `[kind, ...]`."""

    root: Any
    nodes: list[list[Any]]
    arrays: list[np.ndarray] = field(default_factory=list)  # contiguous


Outside = dict[str, Any]  # objects that are not state, by the way that leads to them


def outside_of(root: Any, is_outside: Callable[[Any], bool]) -> Outside:
    """Return the objects reachable from a freshly built one that are not state of it.

    Functions and methods never are.
    """
    found: Outside = {}
    visited: dict[int, Any] = {}
    waiting = [("", root)]
    while waiting:
        way, value = waiting.pop()
        if isinstance(value, PLAIN) or id(value) in visited:
            continue
        visited[id(value)] = value
        if is_outside(value) or inspect.isroutine(value):
            found[way] = value
        else:
            waiting += [(f"{way}.{name}", part) for name, part in _parts(value)]
    return found


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        yield from ((str(key), part) for key, part in value.items())
    elif isinstance(value, list | tuple | deque):
        yield from ((str(k), part) for k, part in enumerate(value))
    elif _is_state(type(value)):
        yield from _attributes(value)


def _attributes(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield an instance's attributes; what is computed when asked for is computed again."""
    for name, part in vars(value).items():
        if not isinstance(getattr(type(value), name, None), functools.cached_property):
            yield name, part


def _is_state(kind: type) -> bool:
    return any(
        kind.__module__.startswith(module) if module.endswith(".") else kind.__module__ == module
        for module in STATE_MODULES
    )


# --- to JSON ---


def to_graph(root: Any, outside: Outside) -> Graph:
    """Return an object and all that it holds; raises StateError for what is neither state nor outside."""
    return _Writer(outside).written(root)


class _Writer:
    def __init__(self, outside: Outside) -> None:
        self._ways = {id(value): way for way, value in outside.items()}
        self._nodes: list[list[Any]] = []
        self._arrays: list[np.ndarray] = []
        self._known: dict[int, tuple[int, Any]] = {}  # node by id, and the object, so that ids stay unique
        self._memory: list[tuple[int, int, bool, str]] = []  # start, end, can be written, way of each array

    def written(self, root: Any) -> Graph:
        graph = Graph(self._value(root, "root"), self._nodes, self._arrays)
        self._check_memory()
        return graph

    def _check_memory(self) -> None:
        """Views of one memory would be written as arrays of their own, and part when one is changed."""
        last, can_be_written, whose = 0, False, ""
        for start, end, writeable, way in sorted(self._memory):
            if start < last and (writeable or can_be_written):
                raise StateError(f"{way} is in the memory of {whose}: only one may be held")
            if end > last:
                last, can_be_written, whose = end, writeable, way

    def _value(self, value: Any, way: str) -> Any:
        """Return a value as JSON; `way` names it in messages."""
        if type(value) in PLAIN:
            return value
        if id(value) in self._known:
            return [self._known[id(value)][0]]
        k = len(self._nodes)
        self._nodes.append([])
        self._known[id(value)] = (k, value)
        self._nodes[k] = self._node(value, way)
        return [k]

    def _values(self, values: Sequence[Any] | deque, way: str) -> list[Any]:
        return [self._value(value, f"{way}[{k}]") for k, value in enumerate(values)]

    def _node(self, value: Any, way: str) -> list[Any]:
        kind = type(value)
        if id(value) in self._ways:
            return ["outside", self._ways[id(value)]]
        if kind is list or kind is tuple:
            return [kind.__name__, self._values(value, way)]
        if kind is dict:
            pairs = [[self._value(k, way), self._value(v, f"{way}[{k!r}]")] for k, v in value.items()]
            return ["dict", pairs]
        if kind is deque:
            return ["deque", value.maxlen, self._values(value, way)]
        if kind is set:
            return ["set", self._values(list(value), way)]
        if kind is np.ndarray:
            if value.size:
                self._memory.append((*_bounds(value), value.flags.writeable, way))
            return ["array", *self._array(value)]
        if isinstance(value, np.generic):
            return ["scalar", *self._array(np.asarray(value))]
        if kind is Tensor:
            return self._tensor(value, way)
        if kind is np.random.Generator and type(value.bit_generator) is np.random.PCG64:
            return ["generator", value.bit_generator.state]
        if kind is torch.Generator:
            return ["torch_generator", *self._array(value.get_state().numpy())]
        if kind is torch.optim.Adam:
            return self._adam(value, way)
        if _is_state(kind):
            name = f"{kind.__module__}:{kind.__qualname__}"
            if isinstance(value, tuple) and hasattr(kind, "_fields"):
                return ["named", name, self._values(value, way)]
            if kind.__new__ is object.__new__ and hasattr(value, "__dict__"):
                parts = {n: self._value(part, f"{way}.{n}") for n, part in _attributes(value)}
                return ["object", name, parts]
        raise StateError(f"{way}: {kind.__module__}.{kind.__qualname__} is no state that can be kept")

    def _array(self, value: np.ndarray) -> list[Any]:
        """Keep an array; return its number and the order of its axes in memory, outermost first."""
        order = sorted(range(value.ndim), key=lambda axis: -abs(value.strides[axis]))
        if value.flags.c_contiguous:
            order = list(range(value.ndim))
        if value.dtype.hasobject:
            raise StateError("an array of objects is no state that can be kept")
        value = value.transpose(order)  # ascontiguousarray would make a scalar an array of one
        self._arrays.append(value if value.flags.c_contiguous else np.ascontiguousarray(value))
        return [len(self._arrays) - 1, order]

    def _tensor(self, value: Tensor, way: str) -> list[Any]:
        if value.grad_fn is not None or value.grad is not None or value.device.type != "cpu":
            raise StateError(f"{way}: a tensor in mid step, or of a GPU, is no state that can be kept")
        array = value.detach().numpy()
        if array.size:
            self._memory.append((*_bounds(array), True, way))
        return ["tensor", value.requires_grad, *self._array(array)]

    def _adam(self, value: torch.optim.Adam, way: str) -> list[Any]:
        state = [[self._value(p, way), self._value(s, f"{way}.state")] for p, s in value.state.items()]
        groups = [self._value(group, f"{way}.group") for group in value.param_groups]
        return ["adam", self._value(value.defaults, way), groups, state]


def _bounds(array: np.ndarray) -> tuple[int, int]:
    """Return the addresses of an array's first byte and behind its last one."""
    start = end = array.__array_interface__["data"][0]
    for count, stride in zip(array.shape, array.strides):
        start, end = start + min(0, (count - 1) * stride), end + max(0, (count - 1) * stride)
    return start, end + array.itemsize


# --- and back ---


def from_graph(graph: Graph, outside: Outside) -> Any:
    """Return the object that was written; `outside`: of an object built in the same way.

    Raises StateError where the graph is none of `to_graph`'s.
    """
    try:
        return _Reader(graph, outside).value(graph.root)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ImportError) as error:
        raise StateError(
            f"not the state of a run of this version ({type(error).__name__}: {error})"
        ) from error


class _Reader:
    def __init__(self, graph: Graph, outside: Outside) -> None:
        self._graph = graph
        self._outside = outside
        self._made: dict[int, Any] = {}  # by node

    def value(self, value: Any) -> Any:
        if type(value) in PLAIN:
            return value
        (k,) = value
        if k not in self._made:
            node = self._graph.nodes[k]
            made = getattr(self, f"_make_{node[0]}")(k, *node[1:])
            self._made[k] = made
        return self._made[k]

    def _values(self, values: list[Any]) -> list[Any]:
        return [self.value(value) for value in values]

    def _make_outside(self, k: int, way: str) -> Any:
        return self._outside[way]

    # What may hold itself is known before it is filled.

    def _make_list(self, k: int, values: list[Any]) -> list[Any]:
        made: list[Any] = []
        self._made[k] = made
        made += self._values(values)
        return made

    def _make_dict(self, k: int, pairs: list[list[Any]]) -> dict[Any, Any]:
        made: dict[Any, Any] = {}
        self._made[k] = made
        made |= {self.value(key): self.value(part) for key, part in pairs}
        return made

    def _make_object(self, k: int, name: str, parts: dict[str, Any]) -> Any:
        made: Any = object.__new__(_class(name))
        self._made[k] = made
        vars(made).update({part: self.value(value) for part, value in parts.items()})  # frozen ones, too
        return made

    def _make_tuple(self, k: int, values: list[Any]) -> tuple[Any, ...]:
        return tuple(self._values(values))

    def _make_named(self, k: int, name: str, values: list[Any]) -> Any:
        return tuple.__new__(_class(name), self._values(values))

    def _make_set(self, k: int, values: list[Any]) -> set[Any]:
        return set(self._values(values))

    def _make_deque(self, k: int, most: int | None, values: list[Any]) -> deque[Any]:
        return deque(self._values(values), maxlen=most)

    def _make_array(self, k: int, array: int, order: list[int]) -> np.ndarray:
        return self._graph.arrays[array].transpose(np.argsort(order)) if order else self._graph.arrays[array]

    def _make_scalar(self, k: int, array: int, order: list[int]) -> np.generic:
        scalar: Any = self._graph.arrays[array][()]
        return scalar

    def _make_tensor(self, k: int, requires_grad: bool, array: int, order: list[int]) -> Tensor:
        tensor = torch.from_numpy(self._make_array(k, array, order)).clone()  # in memory as torch aligns it
        return tensor.requires_grad_(requires_grad)

    def _make_generator(self, k: int, state: dict[str, Any]) -> np.random.Generator:
        made = np.random.Generator(np.random.PCG64())
        made.bit_generator.state = state
        return made

    def _make_torch_generator(self, k: int, array: int, order: list[int]) -> torch.Generator:
        made = torch.Generator()
        made.set_state(torch.from_numpy(self._graph.arrays[array]))
        return made

    def _make_adam(self, k: int, defaults: Any, groups: list[Any], state: list[list[Any]]) -> Any:
        known = inspect.signature(torch.optim.Adam).parameters
        options = {name: value for name, value in self.value(defaults).items() if name in known}
        parameter_groups = self._values(groups)
        made = torch.optim.Adam([p for group in parameter_groups for p in group["params"]], **options)
        made.param_groups = parameter_groups
        for parameter, values in state:
            made.state[self.value(parameter)] = self.value(values)
        return made


def _class(name: str) -> type:
    """Return a class of STATE_MODULES; raises StateError for any other name."""
    module, _, qualname = name.partition(":")
    probe = type("probe", (), {"__module__": module})
    if not _is_state(probe):
        raise StateError(f"{name}: no class that is state of a run")
    found: Any = importlib.import_module(module)
    for part in qualname.split("."):
        found = vars(found)[part]
    if not isinstance(found, type) or found.__module__ != module:
        raise StateError(f"{name}: no class that is state of a run")
    return found
