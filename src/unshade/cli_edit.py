"""Verbs that edit trees: edit, recolor, soften, harden, vary. Heavy modules load inside the verb."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from unshade.arguments import SEED, read_tree, tree_file
from unshade.errors import OutputError, TreeError, UnshadeError
from unshade.files import check_kept
from unshade.staging import TREE_FILE, check_folder

if TYPE_CHECKING:
    from unshade.nodes import Tree

SOME_FAILED = 7
"""Exit code where some of several trees failed; the others are written."""

PICTURE_SIZE = 256


class Degrees(click.ParamType):
    """``RIGHT,UP`` or ``RIGHT,UP,ROLL`` in degrees, with ``ADDRESS=`` before it where only one light is meant."""

    name = "[ADDRESS=]RIGHT,UP[,ROLL]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str | None, tuple[float, ...]]:
        """(address or None, two or three numbers)."""
        if isinstance(value, tuple):
            return value
        where, _, angles = value.rpartition("=")
        with contextlib.suppress(ValueError):
            numbers = tuple(float(part) for part in angles.split(","))
            if len(numbers) in (2, 3) and all(abs(number) < 1e6 for number in numbers):
                return where or None, numbers
        raise click.BadParameter(f"expected degrees to the right and up such as 30,10, got {value!r}", ctx, param)


def output_option(function: Any) -> Any:
    """``-o`` and ``--render`` of the verbs that make a tree of a tree."""
    for option in (
        click.option(
            "--render",
            "picture",
            type=click.Path(path_type=Path),
            metavar="IMG",
            help="Draw the result as well; with several trees, a suffix such as .png.",
        ),
        click.option(
            "-o",
            "--output",
            required=True,
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="The new tree; with several trees, a folder.",
        ),
    ):
        function = option(function)
    return function


def apply_to(
    sources: Sequence[str], change: Callable[[Tree], Tree], output: Path, picture: Path | None, also_read: Sequence[str] = ()
) -> None:
    """Edit each tree and write the results; the first fault of one tree ends a call for one, and is told in a call for several.

    Raises TreeError, OutputError.
    """
    if len(sources) == 1 and output.suffix:
        write_tree(change(read_tree(sources[0])), output, [*sources, *also_read], picture)
        return
    from unshade.terminal import Messages

    if output.suffix.lower() == ".json":
        raise OutputError(f"{output}: expected a folder for several trees, got a name that ends in .json")
    check_folder(output)
    names = tree_names(sources)
    failed = 0
    suffix = None if picture is None else picture.suffix or picture.name
    for source, name in zip(sources, names, strict=True):
        try:
            target = output / f"{name}.json"
            tree = change(read_tree(source))
            output.mkdir(parents=True, exist_ok=True)
            write_tree(tree, target, [*sources, *also_read], target.with_suffix(suffix) if suffix else None)
        except UnshadeError as error:
            if len(sources) == 1 or isinstance(error, OutputError):
                raise
            failed += 1
            Messages().fail(str(error) if source in str(error) else f"{source}: {error}")
    if failed:
        raise click.exceptions.Exit(SOME_FAILED if failed < len(sources) else TreeError.exit_code)


def write_tree(tree: Tree, path: Path, sources: Sequence[str], picture: Path | None = None) -> None:
    """Write a tree that was made of others, which are left as they are. Raises OutputError."""
    from unshade import artifacts
    from unshade.picture_output import check_picture
    from unshade.serde import dump

    check_kept(path, *map(tree_file, sources))
    if path.suffix.lower() != ".json":
        raise OutputError(f"{path}: expected a name that ends in .json for a tree, got {path.suffix or 'no suffix'!r}")
    if picture is not None:
        check_picture(picture)
    dump(tree, path)
    if picture is not None:
        artifacts.write_render(tree, picture, PICTURE_SIZE)


def tree_names(sources: Sequence[str]) -> list[str]:
    """A file's name for each tree: that of its file or folder, numbered where two would be the same."""
    names: list[str] = []
    for number, source in enumerate(sources):
        path = Path(os.path.abspath(source))
        stem = (
            f"{number:03d}"
            if "(" in source or source == "-"
            else (path.parent.name if path.name == TREE_FILE else path.stem if path.is_file() else path.name)
        )
        name, copy = stem, 2
        while name in names:
            name, copy = f"{stem}-{copy}", copy + 1
        names.append(name)
    return names


@click.command()
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
@click.option(
    "--script", "scripts", multiple=True, type=click.Path(path_type=Path), metavar="FILE", help="An edit script (docs/editing.md)."
)
@click.option("--set", "assignments", multiple=True, metavar="ADDRESS.PARAMETER=VALUE", help="Also *=, /=, += and -=.")
@click.option("--move-light", "moves", multiple=True, type=Degrees(), help="Move a light by degrees; without an address all of the light.")
@click.option("--recolor", "colors", multiple=True, metavar="[ADDRESS=]COLOR", help="Give the paint another colour.")
@click.option("--name", "names", multiple=True, metavar="ADDRESS=NAME", help="Name a node; an empty name takes it away.")
@click.option("--remove", "removed", multiple=True, metavar="ADDRESS", help="Take nodes away; a light takes its colour with it.")
@click.option("--like", nargs=2, metavar="BEFORE AFTER", help="Do what was done between two trees, to the leaves that match.")
@click.option("--optional", is_flag=True, help="Leave a tree alone that an edit finds nothing in.")
@output_option
def edit(trees: tuple[str, ...], output: Path, picture: Path | None, optional: bool, like: tuple[str, str] | None, **given: Any) -> None:
    """Change a tree, or many in the same way.

    Addresses and names are those that `unshade show` prints. A short address (highlight, multiply.0) stands for every
    node it fits; :0, :1 ... after it for one of them. The options are done in the order in which they are listed here,
    --remove last, so that every address is that of the tree as it is given. The tree that was read is never
    overwritten, so an edit can be undone.

    \b
    Examples:
      unshade edit out/ball --set "multiply.0.color=#3366ff" --set "highlight.sharpness*=2" -o new.json
      unshade edit out/ball --move-light 30,10 --remove rim --name screen.1=lamp -o new.json --render new.png
      unshade edit out/*/ --script colder.toml -o edited
    """
    from unshade.edit_script import Edit, EditScript
    from unshade.replay import replay

    scripts = [EditScript.load(path) for path in given["scripts"]]
    edits = [Edit("set", text, optional=optional) for text in given["assignments"]]
    edits += [Edit("move_light", list(angles), where, optional) for where, angles in given["moves"]]
    edits += [Edit("recolor", color, where or None, optional) for where, _, color in (text.rpartition("=") for text in given["colors"])]
    for text in given["names"]:
        where, equals, name = text.partition("=")
        if not equals:
            raise click.UsageError(f"--name: expected ADDRESS=NAME, got {text!r}")
        edits.append(Edit("name", name, where, optional))
    if not (scripts or edits or like or given["removed"]):
        raise click.UsageError("nothing to do: give --set, --move-light, --recolor, --name, --remove, --like or --script")
    pair = tuple(map(read_tree, like)) if like else None

    def change(tree: Tree) -> Tree:
        from unshade.edit import remove
        from unshade.errors import AddressError

        for script in scripts:
            tree = script.apply(tree)
        if pair:
            tree = replay(pair[0], pair[1], tree)
        for one in edits:
            tree = one.apply(tree)
        if given["removed"]:
            wanted = list(given["removed"])
            if optional:
                from unshade.selection import select

                kept = []
                for where in wanted:
                    with contextlib.suppress(AddressError):
                        kept += [where] if select(tree.root, where) else []
                wanted = kept
            tree = remove(tree, *wanted) if wanted else tree
        return tree

    apply_to(trees, change, output, picture, like or ())


@click.command()
@click.argument("color")
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
@click.option("--where", metavar="ADDRESS", help="Only this paint, or the colour of this light; else all paint of the base.")
@output_option
def recolor(color: str, trees: tuple[str, ...], where: str | None, output: Path, picture: Path | None) -> None:
    """Give trees another colour, keeping the differences inside their paint.

    COLOR is #rrggbb, #rgb, a word such as teal, or three numbers. It becomes the mean of the paint. Broad lights of the
    paint's colour follow it; highlights, rims, reflections and drawn edges keep theirs.

    \b
    Examples:
      unshade recolor "#3366ff" out/ball -o blue.json --render blue.png
      unshade recolor teal out/*/ -o teal
    """
    from unshade.assignment import read_color
    from unshade.recolor import recolor as recolored

    wanted = read_color(color)
    apply_to(trees, lambda tree: recolored(tree, wanted, where), output, picture)


FACTOR = click.FloatRange(min=0.0, min_open=True)


@click.command()
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
@click.option("--by", "factor", type=FACTOR, default=2.0, show_default=True, metavar="F", help="How many times as wide and as soft.")
@click.option("--where", metavar="ADDRESS", help="Only these leaves.")
@output_option
def soften(trees: tuple[str, ...], factor: float, where: str | None, output: Path, picture: Path | None) -> None:
    """Make lights wider and edges of shading softer; edges of paint stay.

    \b
    Examples:
      unshade soften out/ball -o soft.json --by 1.5
    """
    from unshade.edit import soften as softened

    apply_to(trees, lambda tree: softened(tree, factor, where), output, picture)


@click.command()
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
@click.option("--by", "factor", type=FACTOR, default=2.0, show_default=True, metavar="F", help="How many times as narrow and as hard.")
@click.option("--where", metavar="ADDRESS", help="Only these leaves.")
@output_option
def harden(trees: tuple[str, ...], factor: float, where: str | None, output: Path, picture: Path | None) -> None:
    """Make lights narrower and edges of shading harder, the opposite of `soften`.

    \b
    Examples:
      unshade harden out/ball -o hard.json --where highlight
    """
    from unshade.edit import harden as hardened

    apply_to(trees, lambda tree: hardened(tree, factor, where), output, picture)


@click.command()
@click.argument("tree")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), metavar="DIR", help="Where NN.json, NN.png and sheet.png go."
)
@click.option("-n", "--count", type=click.IntRange(1, 400), default=12, show_default=True, metavar="N", help="How many.")
@click.option(
    "--strength", type=click.FloatRange(0.0, 1.0), default=0.5, show_default=True, metavar="S", help="From 0, none, to 1, large changes."
)
@click.option("--only", multiple=True, type=click.Choice(["light", "color", "shape"]), help="What varies; all of it when not given.")
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="The same seed gives the same variations.")
def vary(tree: str, output: Path, count: int, strength: float, only: tuple[str, ...], seed: int) -> None:
    """Make variations of a tree to choose from, with a sheet of them all in reading order.

    \b
    Examples:
      unshade vary out/ball -o variations
      unshade vary out/ball -o colours -n 24 --only color --strength 1
    """
    from unshade import artifacts
    from unshade.picture_output import write_picture
    from unshade.render import render
    from unshade.serde import dump
    from unshade.sphere import sphere_normals
    from unshade.staging import staged
    from unshade.turntable import check_new_folder, framed
    from unshade.vary import ASPECTS, contact_sheet
    from unshade.vary import vary as varied

    check_new_folder(output)
    pictures = []
    with staged(output) as folder:
        for number, found in enumerate(varied(read_tree(tree), count, seed, strength, only or ASPECTS)):
            name = f"{number:0{len(str(count - 1))}d}"
            dump(found, folder / f"{name}.json")
            picture = render(found, sphere_normals(PICTURE_SIZE))
            write_picture(folder / f"{name}.png", picture, artifacts.disc_alpha(PICTURE_SIZE))
            pictures.append(framed(picture))
        write_picture(folder / "sheet.png", contact_sheet(pictures))


VERBS = (edit, recolor, soften, harden, vary)
