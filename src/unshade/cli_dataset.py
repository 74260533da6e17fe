"""The verbs `dataset make`, `dataset info` and `dataset check`: synthetic training data as files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from unshade.arguments import SEED

FOLDER = click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")


@click.group()
def dataset() -> None:
    """Make synthetic training data, or look at it.

    Training needs none of this: it draws its examples as it goes. See docs/dataset.md.

    \b
    Examples:
      unshade dataset make both -o data --trees 20000
      unshade dataset check data
    """


@dataset.command()
@click.argument("style", type=click.Choice(["realistic", "toon", "both"]))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="DIR", help="Where the shards go.")
@click.option("--trees", type=click.IntRange(1, 10_000_000), default=1000, show_default=True, metavar="N", help="How many trees.")
@click.option(
    "--split", type=click.Choice(["train", "test"]), default="train", show_default=True, help="Which half of the base nodes to draw from."
)
@click.option("--size", type=click.IntRange(8, 1024), default=64, show_default=True, metavar="N", help="Width and height of the pictures.")
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="The same seed gives the same data.")
@click.option("--shard-trees", type=click.IntRange(1, 10_000), default=256, show_default=True, metavar="N", help="Trees in a shard.")
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes; all cores when not given.")
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
@click.option("--json", "as_json", is_flag=True, help="Print the manifest without its shards.")
def make(output: Path, workers: int | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Draw trees and write every operator of theirs as an example.

    STYLE is realistic, toon or both. DIR gets shards, safetensors files with the pictures and numbers of all nodes, and
    manifest.json with counts and checksums. A call that was cut short goes on where it stopped, and a larger N adds to what
    is there. What is there is compared with its checksums, and a shard that was changed is written anew.

    `unshade train --shards DIR` learns from DIR where its --style is STYLE, and both is its default.

    \b
    Examples:
      unshade dataset make both -o data --trees 20000
      unshade dataset make toon -o data/toon-test --split test --trees 500 --size 128
    """
    from unshade import crew, synthesis_shards
    from unshade.terminal import Messages

    plan = synthesis_shards.Plan(**options)
    messages = Messages(quiet)
    with messages.pictures(len(plan.shards()), "shards") as advance:
        shown = 0

        def done(made: int, total: int) -> None:
            nonlocal shown
            for _ in range(made - shown):
                advance()
            shown = made

        manifest = synthesis_shards.make(plan, output, workers or crew.cores(), done)
    messages.say(f"{output}: {_line(manifest)}")
    if as_json:
        click.echo(json.dumps(_brief(manifest)))


@dataset.command()
@FOLDER
@click.option("--json", "as_json", is_flag=True, help="Print the manifest without its shards.")
def info(folder: Path, as_json: bool) -> None:
    """Say what a folder of synthetic data holds.

    \b
    Examples:
      unshade dataset info data/realistic
    """
    from unshade.synthesis_shards import read_manifest

    manifest = read_manifest(folder)
    if as_json:
        click.echo(json.dumps(_brief(manifest)))
        return
    click.echo(_line(manifest))
    click.echo(f"{manifest['style']}, {manifest['split']}, seed {manifest['seed']}, {manifest['size']} x {manifest['size']}")
    for name in ("operators", "children"):
        total = max(1, sum(manifest[name].values()))
        click.echo(f"{name}: " + ", ".join(f"{kind} {count / total:.1%}" for kind, count in manifest[name].items() if count))


@dataset.command()
@FOLDER
def check(folder: Path) -> None:
    """Compare every shard with its checksum and count.

    The exit code is 1 where any is missing or changed.

    \b
    Examples:
      unshade dataset check data/realistic
    """
    from unshade.synthesis_shards import check as what_is_wrong
    from unshade.synthesis_shards import read_manifest
    from unshade.terminal import Messages

    wrong = what_is_wrong(folder)
    for line in wrong:
        Messages().fail(line)
    if wrong:
        raise click.exceptions.Exit(1)
    click.echo(f"{folder}: good, {_line(read_manifest(folder))}")


def _brief(manifest: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in manifest.items() if name not in ("shards", "environments", "kinds")}


def _line(manifest: dict[str, Any]) -> str:
    made = sum(entry["trees"] for entry in manifest["shards"])
    rest = "" if manifest["complete"] else f" (of {manifest['trees']}: not complete)"
    return f"{made} trees{rest}, {manifest['examples']} examples, {len(manifest['shards'])} shards, {manifest['bytes'] / 1e6:.1f} MB"


VERBS = (dataset,)
