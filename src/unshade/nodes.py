"""Trees as data: frozen leaves and operators, and the table of leaf kinds with their parameters.

A node has an address that says how to reach it from the root, built from the kinds on the way:
``screen.0.multiply.1`` is the second child of the multiply that is the first child of the root screen; the root alone
is ``screen``; the mask of a mix is ``mix.mask``. A child is numbered only under an operator.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from typing import Any, Literal, TypeAlias

import numpy as np
import torch

from unshade import shading
from unshade.blend import BLENDS
from unshade.errors import AddressError, TreeError, did_you_mean


class Role(enum.Enum):
    """What a leaf stands for; decides which part of a tree it belongs to and how tools treat it."""

    PAINT = "paint"
    DIFFUSE = "diffuse"
    HIGHLIGHT = "highlight"
    RIM = "rim"
    ENVIRONMENT = "environment"
    MASK = "mask"


BROAD_SHARPNESS = 4.0
"""The one border between broad and sharp: a highlight with a smaller sharpness (half-width over about 24 degrees) is form, hence
part of the diffuse; a sharper one is a light's reflection."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a leaf kind.

    ``direction`` is 3 stored numbers and 2 values, ``color`` and ``rotation`` 3 and 3, ``scalar`` 1 and 1; ``raster``
    is a picture that counts every number it stores.
    """

    name: str
    type: Literal["direction", "color", "scalar", "rotation", "raster"]
    meaning: str
    low: float = 0.0
    high: float = 1.0
    default: tuple[float, ...] | None = None
    unit: str = ""
    logarithmic: bool = False
    """Edited and searched on a logarithmic scale."""
    channels: int = 3
    """Of a raster."""

    @property
    def size(self) -> int:
        """Stored numbers."""
        return {"scalar": 1, "raster": 0}.get(self.type, 3)

    @property
    def values(self) -> int:
        """Counted values."""
        return {"direction": 2, "scalar": 1, "raster": 0}.get(self.type, 3)


@dataclass(frozen=True)
class Kind:
    """A kind of leaf: its formula, parameters with range and meaning, and the words for it."""

    name: str
    role: Role
    formula: Callable[..., torch.Tensor]
    """``formula(normals, *parameters)`` in the order of ``parameters``; see `unshade.shading`."""
    parameters: tuple[Parameter, ...]
    summary: str
    channels: int = 1
    repeats: bool = False
    """True where a leaf holds a list of lobes: each parameter is then stored once a lobe, (K, n)."""
    amplitude: str | None = None
    """The scalar that only scales the picture, which a tint (`multiply` with an albedo) can carry instead."""

    def parameter(self, name: str) -> Parameter:
        """The parameter of this name. Raises AddressError."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise AddressError(f"{self.name} has no parameter {name!r}{did_you_mean(name, [p.name for p in self.parameters])}")


def _direction(meaning: str) -> Parameter:
    return Parameter("direction", "direction", meaning, -1.0, 1.0, (0.0, 0.0, 1.0))


def _color(meaning: str) -> Parameter:
    return Parameter("color", "color", meaning, 0.0, 1.0, (0.5, 0.5, 0.5))


def _scalar(name: str, low: float, high: float, default: float, meaning: str, unit: str = "", logarithmic: bool = False) -> Parameter:
    return Parameter(name, "scalar", meaning, low, high, (default,), unit, logarithmic)


def _softness(default: float) -> Parameter:
    return _scalar("softness", 0.0, 2.5, default, "width of the edge in n.l; 0 is a hard edge")


KINDS: dict[str, Kind] = {}


def register(kind: Kind) -> Kind:
    """Add a kind of leaf, also from outside the package. Raises TreeError where the name is taken."""
    if kind.name in KINDS or kind.name in BLENDS:
        raise TreeError(f"the kind {kind.name!r} exists already")
    if not kind.name.isidentifier():
        raise TreeError(f"a kind's name must be an identifier, got {kind.name!r}")
    KINDS[kind.name] = kind
    return kind


for _kind in (
    Kind("albedo", Role.PAINT, shading.albedo, (_color("the colour"),), "one colour everywhere", channels=3),
    Kind(
        "diffuse",
        Role.DIFFUSE,
        shading.diffuse,
        (_direction("towards the light"), _scalar("ambient", 0.0, 1.0, 0.2, "brightness away from the light")),
        "Lambert shading",
    ),
    Kind(
        "highlight",
        Role.HIGHLIGHT,
        shading.highlight,
        (
            _direction("the normal that the spot is centred on"),
            _scalar("sharpness", 0.05, 5000.0, 30.0, "how small the spot is", logarithmic=True),
            _scalar("amplitude", 0.0, 2.0, 1.0, "brightness at the centre; over 1 gives a plateau"),
        ),
        "a spot of light",
        amplitude="amplitude",
    ),
    Kind(
        "rim",
        Role.RIM,
        shading.rim,
        (
            Parameter("direction", "direction", "towards the light", -1.0, 1.0, (0.0, 1.0, 0.0)),
            _scalar("exponent", 0.2, 30.0, 1.0, "how close to the silhouette it stays", logarithmic=True),
        ),
        "light grazing the silhouette",
    ),
    Kind(
        "toon_diffuse",
        Role.DIFFUSE,
        shading.toon_diffuse,
        (
            _direction("towards the light"),
            _scalar("ambient", 0.0, 1.0, 0.4, "brightness of the dark side"),
            _scalar("threshold", -3.5, 1.0, 0.0, "n.l at which the edge begins"),
            Parameter("softness", "scalar", "width of the edge in n.l; 0 is a hard edge", 0.0, 4.0, (0.1,)),
        ),
        "two-tone shading",
    ),
    Kind(
        "toon_highlight",
        Role.HIGHLIGHT,
        shading.toon_highlight,
        (
            _direction("the normal that the spot is centred on"),
            _scalar("radius", 0.0, math.pi, 0.3, "angle from the centre to the edge", "radians"),
            _scalar("brightness", 0.0, 1.0, 1.0, "brightness inside"),
            _scalar("softness", 0.0, 2.5, 0.0, "width of the edge; 0 is a hard edge", "radians"),
        ),
        "a spot with an edge",
        amplitude="brightness",
    ),
    Kind(
        "environment",
        Role.ENVIRONMENT,
        shading.environment,
        (
            _direction("of the light in the mirrored world"),
            _scalar("sharpness", 0.05, 5000.0, 10.0, "how small the light is", logarithmic=True),
            _color("colour of the light"),
        ),
        "a reflected environment of spherical-Gaussian lights",
        channels=3,
        repeats=True,
    ),
    Kind(
        "environment_map",
        Role.ENVIRONMENT,
        shading.environment_map,
        (
            Parameter("pixels", "raster", "lat-long picture, +y up, +z at the centre"),
            Parameter("rotation", "rotation", "axis-angle that turns the environment", -math.pi, math.pi, (0.0, 0.0, 0.0), "radians"),
        ),
        "a reflected environment as a picture",
        channels=3,
    ),
    Kind(
        "image",
        Role.PAINT,
        shading.image,
        (Parameter("pixels", "raster", "picture of the sphere"),),
        "a picture indexed by n.xy",
        channels=3,
    ),
    Kind(
        "threshold",
        Role.MASK,
        shading.threshold,
        (
            _direction("towards the side where the mask is 1"),
            _scalar("threshold", -2.5, 2.5, 0.0, "n.l at the middle of the edge"),
            _softness(0.0),
        ),
        "mask: one side of a circle",
    ),
    Kind(
        "stripe",
        Role.MASK,
        shading.stripe,
        (
            _direction("across the stripe"),
            _scalar("center", -1.0, 1.0, 0.0, "n.l at the middle of the stripe"),
            _scalar("width", 0.0, 2.0, 0.4, "width of the stripe in n.l"),
            _softness(0.0),
        ),
        "mask: a band",
    ),
    Kind(
        "image_mask", Role.MASK, shading.image_mask, (Parameter("pixels", "raster", "picture of the mask", channels=1),), "mask: a picture"
    ),
):
    register(_kind)


@dataclass(frozen=True, slots=True)
class Raster:
    """A picture inside a tree, 16 bits a number: ``data`` is (channels, height, width) big-endian, row by row."""

    channels: int
    height: int
    width: int
    data: bytes

    def __post_init__(self) -> None:
        if min(self.channels, self.height, self.width) < 1 or len(self.data) != 2 * self.channels * self.height * self.width:
            raise TreeError(f"raster: {len(self.data)} bytes do not make {self.channels} x {self.height} x {self.width} 16-bit numbers")

    @classmethod
    def from_array(cls, array: Any) -> Raster:
        """Quantise (C, H, W) numbers in [0, 1] to 16 bits. Raises TreeError for NaN or another range."""
        array = np.asarray(array.detach().cpu() if isinstance(array, torch.Tensor) else array, dtype=np.float64)
        if array.ndim != 3 or not np.isfinite(array).all() or array.min() < 0.0 or array.max() > 1.0:
            raise TreeError("raster: needs (channels, height, width) finite numbers in [0, 1]")
        channels, height, width = array.shape
        return cls(channels, height, width, np.round(array * 65535.0).astype(">u2").tobytes())

    def array(self) -> np.ndarray:
        """(C, H, W) float64 in [0, 1]."""
        return np.frombuffer(self.data, dtype=">u2").reshape(self.channels, self.height, self.width) / 65535.0

    def tensor(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """(C, H, W) in [0, 1]."""
        return torch.from_numpy(self.array()).to(device, dtype)


Value: TypeAlias = "tuple[float, ...] | Raster"


def _clean(kind: Kind, parameter: Parameter, value: object) -> Value:
    """Check one parameter's value and bring it to its stored form."""
    where = f"{kind.name}.{parameter.name}"
    if parameter.type == "raster":
        if not isinstance(value, Raster):
            raise TreeError(f"{where}: expected a Raster, got {type(value).__name__}")
        if value.channels != parameter.channels:
            raise TreeError(f"{where}: expected {parameter.channels} channels, got {value.channels}")
        return value
    try:
        numbers = _numbers(value)
    except (TypeError, ValueError):
        raise TreeError(f"{where}: expected {parameter.size} numbers, got {value!r}") from None
    if not numbers or len(numbers) % parameter.size or (len(numbers) != parameter.size and not kind.repeats):
        raise TreeError(f"{where}: expected {parameter.size} number{'s' * (parameter.size > 1)}, got {len(numbers)}")
    if not all(math.isfinite(number) for number in numbers):
        raise TreeError(f"{where}: numbers must be finite, got {numbers}")
    if parameter.type == "direction":
        return tuple(part for k in range(0, len(numbers), 3) for part in _unit(where, numbers[k : k + 3]))
    if min(numbers) < parameter.low or max(numbers) > parameter.high:
        raise TreeError(f"{where}: must be in [{parameter.low:g}, {parameter.high:g}], got {', '.join(f'{n:g}' for n in numbers)}")
    return numbers


def _numbers(value: object) -> tuple[float, ...]:
    """Plain numbers, at once where they are floats already, as those of a fit are."""
    if isinstance(value, tuple | list) and all(type(number) is float for number in value):
        return tuple(value)
    return tuple(float(number) for number in np.ravel(np.asarray(value, dtype=np.float64)))


def _unit(where: str, vector: tuple[float, ...]) -> tuple[float, ...]:
    """Normalise, leaving a vector alone that is one already, so that writing and reading change no bit."""
    length = math.sqrt(sum(part * part for part in vector))
    if length < 1e-12:
        raise TreeError(f"{where}: a direction cannot be zero")
    return vector if abs(length - 1.0) < 1e-12 else tuple(part / length for part in vector)


@dataclass(frozen=True, slots=True)
class Leaf:
    """Basic shading or a mask. ``values`` are aligned with the kind's parameters; use `leaf` to make one by name."""

    kind: str
    values: tuple[Value, ...]
    name: str | None = None

    def __post_init__(self) -> None:
        kind = kind_of(self.kind)
        if len(self.values) != len(kind.parameters):
            raise TreeError(f"{kind.name}: expected {len(kind.parameters)} parameters, got {len(self.values)}")
        cleaned = tuple(_clean(kind, parameter, value) for parameter, value in zip(kind.parameters, self.values, strict=True))
        if kind.repeats:
            lobes = {
                len(value) // parameter.size
                for parameter, value in zip(kind.parameters, cleaned, strict=True)
                if not isinstance(value, Raster)
            }
            if len(lobes) != 1:
                raise TreeError(f"{kind.name}: every parameter needs as many entries as there are lobes, got {sorted(lobes)}")
        object.__setattr__(self, "values", cleaned)

    def __getitem__(self, parameter: str) -> Any:
        """The value of a parameter: a tuple of numbers, or a Raster. Raises AddressError."""
        kind = KINDS[self.kind]
        return self.values[kind.parameters.index(kind.parameter(parameter))]

    def set(self, **values: object) -> Leaf:
        """A copy with some parameters changed."""
        kind = KINDS[self.kind]
        index: dict[int, Any] = {kind.parameters.index(kind.parameter(name)): value for name, value in values.items()}
        return dataclasses.replace(self, values=tuple(index.get(k, value) for k, value in enumerate(self.values)))

    @property
    def lobes(self) -> int:
        """How many times the parameters repeat; 1 for most kinds."""
        kind = KINDS[self.kind]
        return len(self.values[0]) // kind.parameters[0].size if kind.repeats and not isinstance(self.values[0], Raster) else 1

    @property
    def role(self) -> Role:
        """The kind's role, but a highlight broader than `BROAD_SHARPNESS` is diffuse."""
        role = KINDS[self.kind].role
        if self.kind == "highlight" and self["sharpness"][0] < BROAD_SHARPNESS:
            return Role.DIFFUSE
        return role


@dataclass(frozen=True, slots=True)
class Operator:
    """``multiply`` or ``screen`` of two or more children, or ``mix`` of two with a mask (a leaf of a mask kind)."""

    kind: str
    children: tuple[Node, ...]
    mask: Leaf | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "children", tuple(self.children))
        if self.kind not in BLENDS:
            raise TreeError(f"unknown operator {self.kind!r}{did_you_mean(self.kind, BLENDS)}")
        for child in self.children:
            if not isinstance(child, Leaf | Operator):
                raise TreeError(f"{self.kind}: children must be nodes, got {type(child).__name__}")
            if isinstance(child, Leaf) and KINDS[child.kind].role is Role.MASK:
                raise TreeError(f"{self.kind}: a mask ({child.kind}) cannot be a child; give it as the mask of a mix")
        if self.kind == "mix":
            if len(self.children) != 2:
                raise TreeError(f"mix: needs 2 children and a mask, got {len(self.children)}")
            if not isinstance(self.mask, Leaf) or KINDS[self.mask.kind].role is not Role.MASK:
                raise TreeError("mix: needs a mask (threshold, stripe or image_mask)")
        elif len(self.children) < 2 or self.mask is not None:
            raise TreeError(f"{self.kind}: needs two or more children and no mask, got {len(self.children)}")


Node: TypeAlias = Leaf | Operator


@dataclass(frozen=True, slots=True)
class Tree:
    """A shade tree and what is needed to read its numbers.

    ``blend_space`` says what the operators work on: ``srgb`` display-encoded values (the paper), or ``linear`` light,
    which `render` encodes at the end. ``exposure`` is the factor that scene-linear input was multiplied by.
    """

    root: Node
    blend_space: Literal["srgb", "linear"] = "srgb"
    exposure: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.root, Leaf | Operator):
            raise TreeError(f"a tree's root must be a node, got {type(self.root).__name__}")
        if isinstance(self.root, Leaf) and KINDS[self.root.kind].role is Role.MASK:
            raise TreeError(f"a tree cannot be only a mask ({self.root.kind})")
        if self.blend_space not in ("srgb", "linear"):
            raise TreeError(f"blend_space must be srgb or linear, got {self.blend_space!r}")
        if not (math.isfinite(self.exposure) and self.exposure > 0):
            raise TreeError(f"exposure must be a positive number, got {self.exposure}")

    def walk(self) -> Iterator[tuple[str, Node]]:
        """See `walk`."""
        return walk(self.root)

    def find(self, where: str) -> Node:
        """See `find`."""
        return find(self.root, where)

    def replace(self, where: str, node: Node | None) -> Tree:
        """See `replace`."""
        return dataclasses.replace(self, root=replace(self.root, where, node))

    @property
    def values(self) -> int:
        """Stored values; see `count_values`."""
        return count_values(self.root)

    @property
    def leaves(self) -> int:
        """Leaves, masks not among them."""
        return sum(isinstance(node, Leaf) and KINDS[node.kind].role is not Role.MASK for _, node in self.walk())

    def __str__(self) -> str:
        from unshade.serde import to_text

        return to_text(self)


@dataclass(frozen=True, slots=True)
class Member:
    """A tree of a family with how well it fits: ``psnr`` in dB inside the scored disc."""

    tree: Tree
    psnr: float

    @property
    def values(self) -> int:
        """Size of the tree."""
        return self.tree.values


@dataclass(frozen=True, slots=True)
class Family:
    """The curve of error over size for one picture, simplest first, and other explanations of the chosen size."""

    members: tuple[Member, ...]
    chosen: int
    alternatives: tuple[Member, ...] = ()

    @property
    def tree(self) -> Tree:
        """The chosen tree."""
        return self.members[self.chosen].tree


def kind_of(name: str) -> Kind:
    """The leaf kind of this name. Raises TreeError with the nearest known word."""
    if not is_kind(name):
        raise TreeError(f"unknown kind {name!r}{did_you_mean(name, [*KINDS, *BLENDS])}")
    return KINDS[name]


def is_kind(name: str) -> bool:
    """Is this a kind of leaf, perhaps one of an installed package? Raises TreeError where such a package is broken."""
    if name not in KINDS and name not in BLENDS:
        _import_kinds()
    return name in KINDS


@lru_cache(maxsize=1)
def _import_kinds() -> None:
    """Import the modules that installed packages announce as entry points ``unshade.kinds``; they register their kinds."""
    for point in metadata.entry_points(group="unshade.kinds"):
        try:
            point.load()
        except Exception as error:  # it is their code, and the message has to say whose
            raise TreeError(f"{point.value}: the module that adds kinds of leaves cannot be imported ({error})") from error


def leaf(kind: str, name: str | None = None, **values: object) -> Leaf:
    """A leaf by parameter names; what is left out takes the kind's default.

    >>> leaf("diffuse", direction=(0, 1, 1), ambient=0.3).kind
    'diffuse'
    """
    entry = kind_of(kind)
    for key in values:
        entry.parameter(key)
    missing = [p.name for p in entry.parameters if p.name not in values and p.default is None]
    if missing:
        raise TreeError(f"{kind}: needs {', '.join(missing)}")
    return Leaf(kind, tuple(values.get(p.name, p.default) for p in entry.parameters), name)  # type: ignore[misc]


def multiply(*children: Node, name: str | None = None) -> Operator:
    """Product of the children."""
    return Operator("multiply", children, name=name)


def screen(*children: Node, name: str | None = None) -> Operator:
    """Screen of the children."""
    return Operator("screen", children, name=name)


def mix(left: Node, right: Node, mask: Leaf, name: str | None = None) -> Operator:
    """``left`` where the mask is 1, ``right`` where it is 0."""
    return Operator("mix", (left, right), mask, name)


def steps(node: Node) -> Iterator[tuple[str, Node]]:
    """The nodes right below one, each with its step: ``0``, ``1`` ... and ``mask``."""
    if isinstance(node, Operator):
        for index, child in enumerate(node.children):
            yield str(index), child
        if node.mask is not None:
            yield "mask", node.mask


def _address(parent: str, step: str, node: Node) -> str:
    return f"{parent}.mask" if step == "mask" else f"{parent}.{step}.{node.kind}"


def walk(root: Node) -> Iterator[tuple[str, Node]]:
    """Every node with its address, parents before children, masks after the children of their mix.

    The last part of an address, the node's own kind, may be left out where `find` and `replace` take one.
    """
    stack = [(root.kind, root)]
    while stack:
        address, node = stack.pop()
        yield address, node
        stack.extend((_address(address, step, child), child) for step, child in reversed(list(steps(node))))


def find_address(root: Node, where: str) -> str:
    """The full address for an address, an address without its last kind, a name, or the kind of a single node."""
    if _at(root, where) is not None:
        return where
    known = dict(walk(root))
    without_kind = where if where[-1:].isdigit() else None
    matches = [address for address, node in known.items() if node.name == where or address.rpartition(".")[0] == without_kind]
    matches = matches or [address for address, node in known.items() if node.kind == where]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise AddressError(f"{where!r} fits several nodes: {', '.join(matches[:6])}")
    names = [node.name for node in known.values() if node.name]
    raise AddressError(f"no node {where!r}{did_you_mean(where, [*known, *names])}")


def _at(root: Node, address: str) -> Node | None:
    """The node at a full address; None where there is none."""
    kind, *path = address.split(".")
    node: Node | None = root if root.kind == kind else None
    while path and node is not None:
        step = path.pop(0)
        node = dict(steps(node)).get(step)
        if step != "mask" and (node is None or not path or node.kind != path.pop(0)):
            return None
    return node


def find(root: Node, where: str) -> Node:
    """The node at an address or of a name. Raises AddressError."""
    found = _at(root, find_address(root, where))
    assert found is not None
    return found


def replace(root: Node, where: str, node: Node | None) -> Node:
    """A copy of the tree with another node at an address; None removes it and an operator left with one child."""
    path = find_address(root, where).split(".")
    result = _replaced(root, [part for part in path[1:] if part.isdigit() or part == "mask"], node)
    if result is None:
        raise TreeError("the root of a tree cannot be removed")
    return result


def _replaced(node: Node, path: list[str], new: Node | None) -> Node | None:
    if not path:
        return new
    assert isinstance(node, Operator)
    step, rest = path[0], path[1:]
    if step == "mask":
        if new is None:
            raise TreeError("the mask of a mix cannot be removed; remove the mix or a child")
        return dataclasses.replace(node, mask=new)  # type: ignore[arg-type]
    index = int(step)
    child = _replaced(node.children[index], rest, new)
    if child is not None:
        return dataclasses.replace(node, children=node.children[:index] + (child,) + node.children[index + 1 :])
    left = node.children[:index] + node.children[index + 1 :]
    return left[0] if len(left) == 1 else dataclasses.replace(node, children=left)


def tint(node: Node) -> tuple[Leaf, Leaf] | None:
    """(albedo, leaf) where the node is a light or a reflection with a colour, ``multiply(albedo, leaf)``."""
    if isinstance(node, Operator) and node.kind == "multiply" and len(node.children) == 2:
        first, second = node.children
        if isinstance(second, Leaf) and second.kind == "albedo":
            first, second = second, first
        if isinstance(first, Leaf) and first.kind == "albedo" and isinstance(second, Leaf) and second.kind != "albedo":
            return first, second
    return None


def carried_amplitude(node: Node) -> Leaf | None:
    """The tinted leaf whose amplitude is 1 because the albedo beside it carries it, so that it is not counted."""
    pair = tint(node)
    if pair:
        amplitude = KINDS[pair[1].kind].amplitude
        if amplitude and pair[1][amplitude] == (1.0,):
            return pair[1]
    return None


def count_values(root: Node) -> int:
    """The size of a tree in stored values: a direction 2, a colour 3, a scalar 1, a raster every number it stores."""
    total = 0
    for _, node in walk(root):
        if isinstance(node, Leaf):
            total += sum(value.channels * value.height * value.width for value in node.values if isinstance(value, Raster))
            total += node.lobes * sum(parameter.values for parameter in KINDS[node.kind].parameters)
        else:
            total -= carried_amplitude(node) is not None
    return total
