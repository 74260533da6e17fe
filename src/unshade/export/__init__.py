"""Trees for other programs: one table of targets (`targets`), one file a target. Knows trees, knows no network."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unshade.errors import OutputError, UnshadeError, did_you_mean
from unshade.export.targets import OPTIONS, TARGETS, Target, target_of

if TYPE_CHECKING:
    from unshade.nodes import Tree

__all__ = ["OPTIONS", "TARGETS", "ExportWarning", "Target", "check_options", "degradations", "export", "target_of"]


class ExportWarning(UserWarning):
    """A target cannot hold something of a tree; says what becomes of it."""


def degradations(tree: Tree, target: str | Target) -> list[str]:
    """What of this tree the target cannot hold, one sentence each with the addresses; also that a target is experimental."""
    target = target if isinstance(target, Target) else target_of(target)
    found = [f"{target.name} is experimental: {target.short_of or 'no program has checked it'}"] if target.experimental else []
    for loss in target.losses:
        places = loss.where(tree)
        if places:
            more = f" and {len(places) - 4} more" if len(places) > 4 else ""
            found.append(f"{target.name} cannot hold {loss.cannot}: {loss.instead} (at {', '.join(places[:4])}{more})")
    return found


def export(tree: Tree, path: str | os.PathLike[str], target: str, **options: Any) -> Path:
    """Write a tree for another program, whole or not at all.

    Args:
        tree: what to write.
        path: a file whose suffix is one of the target's.
        target: a name of `TARGETS`.
        options: those that the target takes; see `OPTIONS`.
    Returns:
        The path of the file.
    Raises:
        UnshadeError: an unknown target or option, or one out of range.
        OutputError: another suffix, or a place that cannot be written.
        MissingExtraError: a library that the target needs is not installed.
    Warns:
        ExportWarning: for each thing of the tree that the target cannot hold.
    """
    from unshade.picture_output import replacing

    chosen, path = target_of(target), Path(path)
    if path.suffix.lower() not in chosen.suffixes:
        raise OutputError(
            f"{path}: {target} expects a name that ends in {' or '.join(chosen.suffixes)}, got {path.suffix or 'no suffix'!r}"
        )
    check_options(chosen, options)
    for sentence in degradations(tree, chosen):
        warnings.warn(sentence, ExportWarning, stacklevel=2)
    module, function = chosen.writer.split(".")
    write = getattr(importlib.import_module(f"unshade.export.{module}"), function)
    with replacing(path) as temporary:
        for sentence in write(tree, temporary, **options) or ():
            warnings.warn(f"{target}: {sentence}", ExportWarning, stacklevel=2)
    return path


def check_options(target: Target, options: Mapping[str, Any]) -> None:
    """Raises UnshadeError for an option that the target does not take, or one out of range."""
    for name, value in options.items():
        _check_option(target, name, value)


def _check_option(target: Target, name: str, value: Any) -> None:
    if name not in target.options:
        known = f"; it takes {', '.join(target.options)}" if target.options else "; it takes none"
        raise UnshadeError(f"{target.name} has no option {name!r}{did_you_mean(name, OPTIONS) if name not in OPTIONS else known}")
    option = OPTIONS[name]
    if option.type == "integer" and not (isinstance(value, int) and option.low <= value <= option.high):
        raise UnshadeError(f"{target.name}: expected a {name} between {option.low} and {option.high}, got {value!r}")
    if option.type == "word" and str(value) not in option.words:
        raise UnshadeError(f"{target.name}: expected a {name} out of {', '.join(option.words)}, got {value!r}")
