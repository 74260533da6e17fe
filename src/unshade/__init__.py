"""One picture of a shaded sphere in, an editable shade tree out.

>>> import unshade
>>> tree = unshade.parse("multiply(albedo(#cc2030), diffuse(left up, ambient=0.2))")
>>> unshade.render(tree, unshade.sphere_normals(64)).shape
torch.Size([3, 64, 64])

Importing the package loads nothing heavy: each public name is looked up in its module when it is first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unshade import errors
    from unshade.decompose import decompose, fit
    from unshade.nodes import Leaf, Operator, Tree, leaf, mix, multiply, screen
    from unshade.pictures import read_sphere
    from unshade.render import render
    from unshade.serde import dump as save
    from unshade.serde import load, parse
    from unshade.sphere import sphere_normals

__version__ = "0.1.0"

__all__ = [
    "Leaf",
    "Operator",
    "Tree",
    "__version__",
    "decompose",
    "errors",
    "fit",
    "leaf",
    "load",
    "mix",
    "multiply",
    "parse",
    "read_sphere",
    "render",
    "save",
    "screen",
    "sphere_normals",
]

_HOMES = {
    "Leaf": ("nodes", "Leaf"),
    "Operator": ("nodes", "Operator"),
    "Tree": ("nodes", "Tree"),
    "decompose": ("decompose", "decompose"),
    "fit": ("decompose", "fit"),
    "leaf": ("nodes", "leaf"),
    "load": ("serde", "load"),
    "mix": ("nodes", "mix"),
    "multiply": ("nodes", "multiply"),
    "parse": ("serde", "parse"),
    "read_sphere": ("pictures", "read_sphere"),
    "render": ("render", "render"),
    "save": ("serde", "dump"),
    "screen": ("nodes", "screen"),
    "sphere_normals": ("sphere", "sphere_normals"),
}
"""Public name -> (module, name there)."""


class _Package(ModuleType):
    """The package's own module, which keeps `unshade.render` the function that it is.

    The import system sets a package's attribute to every submodule it loads; for `decompose`, `fit` and `render` that
    would put a module where the public function belongs, depending on what was imported first.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name == "errors":
            return importlib.import_module("unshade.errors")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, attribute = _HOMES[name]
        value = getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
        setattr(self, name, value)
        return value

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *__all__})


sys.modules[__name__].__class__ = _Package
