"""The verb `export`: a tree for another program."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from unshade.arguments import read_tree, tree_file
from unshade.errors import UnshadeError
from unshade.export.targets import OPTIONS, TARGETS, Option, target_of
from unshade.files import check_kept


def _click_option(option: Option) -> Callable[[Any], Any]:
    takers = ", ".join(target.name for target in TARGETS.values() if option.name in target.options)
    kind: click.ParamType = {
        "integer": click.IntRange(option.low, option.high),
        "file": click.Path(path_type=Path),
        "word": click.Choice(option.words),
        "text": click.STRING,
    }[option.type]
    metavar = {"integer": "N", "file": "FILE", "word": None, "text": "TEXT"}[option.type]
    return click.option(f"--{option.name}", type=kind, metavar=metavar, help=f"{option.meaning} Of {takers}.")


def _options(function: Any) -> Any:
    for option in reversed(OPTIONS.values()):
        function = _click_option(option)(function)
    return function


def _list_targets(context: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    if not wanted or context.resilient_parsing:
        return
    for target in TARGETS.values():
        state = "experimental" if target.experimental else f"checked in {target.checked_by}"
        click.echo(f"{target.name:14} {'/'.join(target.suffixes):14} {target.summary}; {state}")
        for loss in target.losses:
            click.echo(f"{'':29} cannot hold {loss.cannot}: {loss.instead}")
    context.exit()


@click.command()
@click.argument("tree")
@click.option("--to", "name", metavar="TARGET", help="What to write; by the suffix of FILE where that says it.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="FILE", help="The file to write.")
@click.option(
    "--list", is_flag=True, is_eager=True, expose_value=False, callback=_list_targets, help="Print the targets and what each cannot hold."
)
@click.option("-q", "--quiet", is_flag=True, help="Do not say what the target cannot hold.")
@_options
def export(tree: str, name: str | None, output: Path, quiet: bool, **options: Any) -> None:
    """Write a tree for another program.

    What the target cannot hold is said on standard error, with what becomes of it; the file is written all the same.

    \b
    Examples:
      unshade export --list
      unshade export out/ball -o matcap.png --size 1024
      unshade export out/ball --to png -o matcap.png --bits 16
      unshade export out/ball -o heart.svg --shape drawing.svg --region heart
    """
    from unshade.export import ExportWarning, check_options
    from unshade.export import export as write
    from unshade.terminal import Messages

    target = name if name is not None else _target_by_suffix(output)
    given = {option: value for option, value in options.items() if value is not None}
    try:
        check_options(target_of(target), given)
    except UnshadeError as error:
        raise click.UsageError(str(error)) from None
    if "region" in given and "shape" not in given:
        raise click.UsageError("--region is for --shape: the id of a path in that drawing")
    check_kept(output, tree_file(tree), given.get("shape"))
    found = read_tree(tree)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        write(found, output, target, **given)
    for warning in caught:
        if not issubclass(warning.category, ExportWarning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        elif not quiet:
            Messages().say(f"{output}: {warning.message}")


def _target_by_suffix(output: Path) -> str:
    fitting = [target.name for target in TARGETS.values() if output.suffix.lower() in target.suffixes]
    if len(fitting) != 1:
        raise click.UsageError(
            f"--to is missing: {output.suffix or 'a name without a suffix'} may be {' or '.join(fitting)}"
            if fitting
            else f"--to is missing, and no target writes {output.suffix or 'a name without a suffix'!r}; unshade export --list names them"
        )
    return fitting[0]


VERBS = (export,)
