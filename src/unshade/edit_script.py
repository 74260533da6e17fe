"""Edit scripts: edits in a small TOML file, applied to any number of trees.

One ``[[edit]]`` an edit, done in their order; each names what to do and what to do it with::

    [[edit]]
    set = "highlight.sharpness *= 2"

    [[edit]]
    move_light = [30, 10]        # degrees to the right and up
    where = "highlight:0"        # without it: all of the light

    [[edit]]
    remove = "rim"
    optional = true              # a tree without a rim is left as it is

The words are those of the command line: ``set``, ``move_light``, ``light_from``, ``recolor``, ``soften``, ``harden``,
``remove``, ``name`` (with ``where``).
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unshade.assignment import read_color, read_direction
from unshade.edit import harden, move_light, remove, rename, set_value, soften
from unshade.errors import AddressError, TreeError, did_you_mean
from unshade.nodes import Tree
from unshade.recolor import recolor
from unshade.relight import relight_to


@dataclass(frozen=True)
class Verb:
    """One word of a script: what it takes, and the edit that it makes."""

    takes: str
    check: Callable[[Any], bool]
    where: str
    """May it, must it or can it not have a ``where``: may, must or no."""
    apply: Callable[[Tree, Any, str | None], Tree]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_turn(value: Any) -> bool:
    return isinstance(value, list) and 2 <= len(value) <= 3 and all(map(_is_number, value))


VERBS = {
    "set": Verb("ADDRESS.PARAMETER=VALUE", _is_text, "no", lambda tree, value, _: set_value(tree, value)),
    "move_light": Verb(
        "[right, up] or [right, up, roll] in degrees", _is_turn, "may", lambda tree, turn, where: move_light(tree, *_turn(turn), where)
    ),
    "light_from": Verb("a direction", _is_text, "no", lambda tree, value, _: relight_to(tree, read_direction(value))),
    "recolor": Verb("a colour", _is_text, "may", lambda tree, value, where: recolor(tree, read_color(value), where)),
    "soften": Verb("a factor", _is_number, "may", soften),
    "harden": Verb("a factor", _is_number, "may", harden),
    "remove": Verb("an address", _is_text, "no", lambda tree, value, _: remove(tree, value)),
    "name": Verb("a name", _is_text, "must", lambda tree, value, where: rename(tree, str(where), value)),
}
"""What a script can do."""


def _turn(angles: list[float]) -> tuple[float, float, float]:
    right, up, roll = [*angles, 0.0, 0.0][:3]
    return float(right), float(up), float(roll)


@dataclass(frozen=True)
class Edit:
    """One edit. An ``optional`` one leaves a tree alone that has nothing it could change."""

    verb: str
    value: Any
    where: str | None = None
    optional: bool = False

    def __post_init__(self) -> None:
        if self.verb not in VERBS:
            raise TreeError(f"unknown edit {self.verb!r}{did_you_mean(self.verb, VERBS)}")
        verb = VERBS[self.verb]
        if not verb.check(self.value):
            raise TreeError(f"{self.verb} takes {verb.takes}, got {self.value!r}")
        if (self.where is None and verb.where == "must") or (self.where is not None and verb.where == "no"):
            raise TreeError(f"{self.verb} {'needs' if verb.where == 'must' else 'takes no'} where")

    def apply(self, tree: Tree) -> Tree:
        """The edited tree. Raises TreeError."""
        try:
            return VERBS[self.verb].apply(tree, self.value, self.where)
        except TreeError as error:
            if self.optional and (isinstance(error, AddressError) or self.verb in ("recolor", "light_from", "remove", "move_light")):
                return tree
            raise


@dataclass(frozen=True)
class EditScript:
    """Edits in their order."""

    edits: tuple[Edit, ...]

    def apply(self, tree: Tree) -> Tree:
        """The tree with all edits done. Raises TreeError, which says at which edit."""
        for number, edit in enumerate(self.edits, start=1):
            try:
                tree = edit.apply(tree)
            except TreeError as error:
                raise type(error)(f"edit {number} ({edit.verb}): {error}") from None
        return tree

    @staticmethod
    def parse(text: str) -> EditScript:
        """Read the TOML text. Raises TreeError, which says at which edit."""
        try:
            document = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise TreeError(f"expected an edit script as TOML: {error}") from None
        entries = document.get("edit")
        unknown = [key for key in document if key != "edit"]
        if unknown or not isinstance(entries, list) or not entries:
            raise TreeError(f"expected [[edit]] tables in an edit script, got {', '.join(unknown or document) or 'nothing'}")
        edits = []
        for number, entry in enumerate(entries, start=1):
            try:
                edits.append(_edit(entry))
            except TreeError as error:
                raise TreeError(f"edit {number}: {error}") from None
        return EditScript(tuple(edits))

    @staticmethod
    def load(path: str | Path) -> EditScript:
        """Read a file. Raises TreeError, which names it."""
        try:
            return EditScript.parse(Path(path).read_bytes().decode("utf-8"))
        except OSError as error:
            raise TreeError(f"cannot read {path}: {error.strerror or error}") from None
        except UnicodeDecodeError:
            raise TreeError(f"{path}: expected an edit script, got a file that is not UTF-8 text") from None
        except TreeError as error:
            raise TreeError(f"{path}: {error}") from None


def _edit(entry: Any) -> Edit:
    if not isinstance(entry, dict):
        raise TreeError(f"expected a table such as {{remove = 'rim'}}, got {entry!r}")
    known = [*VERBS, "where", "optional"]
    for key in entry:
        if key not in known:
            raise TreeError(f"unknown word {key!r}{did_you_mean(key, known)}")
    verbs = [key for key in entry if key in VERBS]
    if len(verbs) != 1:
        raise TreeError(f"expected one of {', '.join(VERBS)}, got {' and '.join(verbs) or 'none'}")
    where, optional = entry.get("where"), entry.get("optional", False)
    if where is not None and not isinstance(where, str):
        raise TreeError(f"where must be an address, got {where!r}")
    if not isinstance(optional, bool):
        raise TreeError(f"optional must be true or false, got {optional!r}")
    return Edit(verbs[0], entry[verbs[0]], where, optional)
