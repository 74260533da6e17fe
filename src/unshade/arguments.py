"""What the verbs of the command line take: options that several share, a disc, and a TREE in any of its forms."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from unshade.errors import TreeError
from unshade.staging import TREE_FILE

if TYPE_CHECKING:
    from unshade.nodes import Family, Tree

SEED = click.IntRange(0, 2**63 - 1)


class Disc(click.ParamType):
    """``cx,cy,r`` in pixels."""

    name = "cx,cy,r"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Three numbers, the last over 0."""
        if isinstance(value, tuple):
            return value
        with contextlib.suppress(ValueError):
            numbers = tuple(float(part) for part in value.split(","))
            if len(numbers) == 3 and numbers[2] > 0 and all(abs(number) < 1e6 for number in numbers):
                return numbers
        raise click.BadParameter(f"expected three numbers cx,cy,r in pixels such as 128,128,100, got {value!r}", ctx, param)


def network_options(function: Any) -> Any:
    """What `decompose` asks networks for; see `check_networks`."""
    for option in (
        click.option(
            "--device",
            default="cpu",
            show_default=True,
            metavar="NAME",
            help="Where the networks of --method learned or hybrid draw, such as cuda; other trees come out there. Fits stay on the CPU.",
        ),
        click.option("--weights", type=click.Path(path_type=str), metavar="DIR", help="Networks of `unshade train`, not those that ship."),
        click.option(
            "--reflections",
            type=click.Choice(["lights", "picture"]),
            default="lights",
            show_default=True,
            help="Hold a reflected environment as lights, a few values each, or as a picture of 24,576 values, where an image shows one.",
        ),
        click.option(
            "--second-stage",
            type=click.Choice(["size", "depth", "none"]),
            default="size",
            show_default=True,
            help="Of --method learned, for nodes that the networks leave over: our search, the paper's (minutes), or none.",
        ),
        click.option(
            "--method",
            type=click.Choice(["search", "learned", "hybrid"]),
            default="search",
            show_default=True,
            help="Who proposes structures: the search, networks with a second stage as in the paper, or networks before a search.",
        ),
    ):
        function = option(function)
    return function


def check_networks(options: Mapping[str, Any]) -> None:
    """Refuse what would have no effect, among the options of the command that runs. Raises UsageError."""

    def given(name: str) -> bool:
        return click.get_current_context().get_parameter_source(name) is ParameterSource.COMMANDLINE

    method = options.get("method", "search")
    if method != "learned" and given("second_stage"):
        raise click.UsageError(f"--second-stage is of --method learned; --method {method} has none")
    if method == "search" and given("device"):
        raise click.UsageError("--device is of --method learned or hybrid; the search is on the CPU")
    if method == "search" and given("weights") and options["reflections"] != "picture":
        raise click.UsageError("--weights are of --method learned or hybrid, or of --reflections picture; this asks no network")


def output_options(function: Any) -> Any:
    """What `decompose` and `fit` share."""
    for option in (
        click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors."),
        click.option("--json", "as_json", is_flag=True, help="Print one JSON object a picture, one a line, on standard output."),
        click.option("--perceptual", is_flag=True, help="Measure st_lpips too (a second or two a picture); else it is null."),
        click.option(
            "--artifacts",
            type=click.Choice(["none", "tree", "all"]),
            default="all",
            show_default=True,
            help="What to write: nothing, tree.json only, or also the pictures, the drawn tree and the report.",
        ),
        click.option("--mask", type=click.Path(), metavar="FILE", help="A picture of the pixels to ignore: white is ignored."),
        click.option(
            "--disc", type=Disc(), help="Centre and radius of the sphere in pixels of the picture; found by itself when not given."
        ),
        click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="The same seed gives the same tree, bit for bit."),
    ):
        function = option(function)
    return function


def read_tree(source: str, text_only: bool = False) -> Tree:
    """The tree of a TREE argument. Raises TreeError."""
    return read_document(source, text_only)[0]


def read_document(source: str, text_only: bool = False) -> tuple[Tree, Family | None]:
    """The tree of a TREE argument, and its family where the file has one. Raises TreeError."""
    from unshade import serde

    path = None if text_only or source == "-" else tree_file(source)
    try:
        if path is not None and path.suffix.lower() == ".psd":
            from unshade.export.psd import read_psd

            return read_psd(path), None
        if path is not None:
            tree, text = serde.load(path), path.read_text(encoding="utf-8")
        elif source == "-" or text_only or "(" in source:
            text = sys.stdin.read() if source == "-" else source
            tree = serde.loads(text)
        else:
            raise TreeError(f"expected a tree file, a folder with a {TREE_FILE}, or a tree's text such as albedo(#cc2030)")
        return tree, serde.loads_family(text) if re.search(r'"family"\s*:', text) else None
    except TreeError as error:
        if source == "-" or path is not None or "(" not in source:
            raise _named(error, "standard input" if source == "-" else str(path or source)) from error
        raise


def _named(error: TreeError, source: str) -> TreeError:
    """The error in one line that says what was read; the place in a line of text is shown only for text that was typed."""
    message = str(error).partition("\n")[0]
    source = source if len(source) <= 200 else f"{source[:200]}..."
    renamed = TreeError(message if source in message else f"{source}: {message}")
    renamed.address = error.address
    return renamed


def tree_file(source: str) -> Path | None:
    """The file that a TREE argument names, if it does."""
    # A tree's text may be longer than a file name can be.
    with contextlib.suppress(OSError, ValueError):
        path = Path(source)
        path = path / TREE_FILE if path.is_dir() else path
        return path if path.exists() else None
    return None
