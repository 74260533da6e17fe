"""Verbs that combine trees: transfer, mix, analogy, library. Heavy modules load inside the verb."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from unshade.arguments import SEED, read_tree, tree_file
from unshade.cli_edit import apply_to, output_option, tree_names
from unshade.errors import OutputError
from unshade.files import check_kept, write_whole
from unshade.staging import check_own

if TYPE_CHECKING:
    from unshade.nodes import Tree

COMPONENTS = click.Choice(["albedo", "diffuse", "highlights", "rim", "environment"])


@click.command()
@click.argument("component", type=COMPONENTS)
@click.argument("source", metavar="FROM")
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
@output_option
def transfer(component: str, source: str, trees: tuple[str, ...], output: Path, picture: Path | None) -> None:
    """Put one component of the tree FROM into other trees, in the place of theirs.

    COMPONENT is albedo (the paint), diffuse (the form, with broad lights), highlights, rim or environment. Where FROM
    has none of it, the trees lose theirs.

    \b
    Examples:
      unshade transfer albedo out/gold out/ball -o gold_ball.json --render gold_ball.png
      unshade transfer highlights out/lacquer out/*/ -o lacquered
    """
    from unshade.edit import transfer as moved

    given = read_tree(source)
    apply_to(trees, lambda tree: moved(given, tree, component), output, picture, [source])


@click.command()
@click.argument("first", metavar="A")
@click.argument("second", metavar="B")
@click.option("--take", multiple=True, required=True, type=COMPONENTS, help="A component that comes from B; may be given several times.")
@output_option
def mix(first: str, second: str, take: tuple[str, ...], output: Path, picture: Path | None) -> None:
    """Make a tree of two: A with some components of B.

    \b
    Examples:
      unshade mix out/ball out/gold --take albedo --take highlights -o mixed.json --render mixed.png
    """
    from unshade.edit import mix as mixed

    other = read_tree(second)
    apply_to([first], lambda tree: mixed(tree, other, take), output, picture, [second])


@click.command()
@click.argument("a", metavar="A")
@click.argument("b", metavar="B")
@click.argument("ab", metavar="AB")
@click.argument("p", metavar="P")
@click.argument("q", metavar="Q")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), metavar="DIR", help="Where render.png, tree.json and analogy.json go."
)
@click.option(
    "--preset", type=click.Choice(["draft", "balanced", "best"]), default="balanced", show_default=True, help="How pictures are decomposed."
)
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="The same seed gives the same answer.")
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
@click.option("--json", "as_json", is_flag=True, help="Print analogy.json.")
def analogy(a: str, b: str, ab: str, p: str, q: str, output: Path, preset: str, seed: int, quiet: bool, as_json: bool) -> None:
    """Do to P what was done to A: AB is A with one component of B; find which, and give P that component of Q.

    Each of the five is a picture of a sphere or a TREE. Pictures are decomposed first; AB is only looked at. Where AB is
    A, the exit code is 4. analogy.json says what was understood, whether that is sure, and whether reflections were held
    as a picture or, without the network for it, as lights.

    \b
    Examples:
      unshade analogy a.png b.png ab.png p.png q.png -o answer
      unshade analogy out/a out/b edited.json out/p out/q -o answer --json
    """
    from unshade import artifacts
    from unshade.analogy import analogy as understand
    from unshade.picture_output import write_picture
    from unshade.render import render
    from unshade.serde import dump
    from unshade.sphere import sphere_normals
    from unshade.staging import TREE_FILE, staged
    from unshade.terminal import Messages

    check_own(output, "analogy.json", ())
    messages = Messages(quiet)
    given = [_tree_or_picture(source) for source in (a, b, ab, p, q)]
    found = understand(*given, preset=preset, seed=seed, told=lambda name: messages.say(f"decomposing {name}"))
    report = {
        "inputs": dict(zip(("A", "B", "AB", "P", "Q"), (a, b, ab, p, q), strict=True)),
        **found.report(),
        "preset": preset,
        "seed": seed,
    }
    text = json.dumps(report, indent=1)
    with staged(output) as folder:
        size = 256
        write_picture(folder / "render.png", render(found.tree, sphere_normals(size)), artifacts.disc_alpha(size))
        (folder / "analogy.json").write_text(text + "\n", encoding="utf-8")
        dump(found.tree, folder / TREE_FILE)
    if as_json:
        click.echo(json.dumps(report))
    if found.reflections == "lights":
        messages.say("reflections were held as lights, since the network for pictures of them is missing (unshade train reflection)")
    best = "" if found.explanation.seen is not None else f"{min(next(iter(found.scores.values())), 200.0):.1f} dB"
    doubt = f"not surely: {found.doubt}" if found.doubt else ""
    messages.say(f"{report['understood']} ({', '.join(filter(None, (best, doubt)))})")


def _tree_or_picture(source: str) -> Tree | Path:
    """A tree where the argument is one: its text, a folder with a tree.json, or a file of JSON or text; else a picture."""
    path = tree_file(source)
    if path is None and "(" not in source and source != "-":
        return Path(source)
    if path is not None and path.suffix.lower() not in (".json", ".txt", ".tree"):
        return path
    return read_tree(source)


@click.command()
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), metavar="FILE", help="The page, .html, or the parts as .json."
)
@click.option("--title", default="Parts", show_default=True, metavar="TEXT", help="Heading of the page.")
def library(trees: tuple[str, ...], output: Path, title: str) -> None:
    """Collect the parts of many trees into one page to look through and to combine.

    The page opens offline. Choosing a paint, a form and lights shows what they make together and writes it as a tree's
    text for the other commands.

    \b
    Examples:
      unshade library out/*/ -o parts.html
    """
    from unshade.library import as_json, library_html, parts

    suffix = output.suffix.lower()
    if suffix not in (".html", ".json"):
        raise OutputError(f"{output}: expected a name that ends in .html or .json, got {output.suffix or 'no suffix'!r}")
    check_kept(output, *map(tree_file, trees))
    named = [(name, read_tree(source)) for name, source in zip(tree_names(trees), trees, strict=True)]
    text = library_html(named, title) if suffix == ".html" else as_json(parts(named)) + "\n"
    write_whole(output, text.encode("utf-8"))


VERBS = (transfer, mix, analogy, library)
