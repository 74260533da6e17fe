"""The verb `relight`: turn the light, one picture or a whole turn, or put the tree under a new environment."""

from __future__ import annotations

from pathlib import Path

import click

from unshade.arguments import read_tree, tree_file
from unshade.cli_edit import PICTURE_SIZE, Degrees, write_tree
from unshade.files import check_kept


@click.command()
@click.argument("tree")
@click.option("--turn", type=Degrees(), metavar="RIGHT,UP[,ROLL]", help="Move all of the light by degrees.")
@click.option(
    "--from", "direction", metavar="DIRECTION", help='Turn the light until the main one comes from here, such as "left up front".'
)
@click.option("--environment", type=click.Path(path_type=Path), metavar="FILE", help="Light it with a lat-long HDR, EXR or other picture.")
@click.option(
    "--exposure",
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    metavar="F",
    help="Of the environment: times as bright as the tree was.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="The new tree.")
@click.option(
    "--render", "picture", type=click.Path(path_type=Path), metavar="IMG", help="A picture of it, the lighting shown in a corner."
)
@click.option(
    "--turntable", type=click.Path(path_type=Path), metavar="FILE", help="The light goes round once: .gif, .mp4, or a folder of PNG."
)
@click.option(
    "--axis",
    type=click.Choice(["vertical", "horizontal", "view"]),
    default="vertical",
    show_default=True,
    help="What the light goes round.",
)
@click.option("--frames", type=click.IntRange(2, 2000), default=48, show_default=True, metavar="N", help="Frames of the turntable.")
@click.option("--fps", type=click.FloatRange(1.0, 60.0), default=24.0, show_default=True, metavar="N", help="Frames a second.")
@click.option(
    "--size", type=click.IntRange(16, 2048), default=PICTURE_SIZE, show_default=True, metavar="N", help="Width and height of the pictures."
)
@click.option("--inset/--no-inset", default=True, help="Show the lighting as a small lat-long picture in the corner (the default).")
def relight(
    tree: str,
    turn: tuple[str | None, tuple[float, ...]] | None,
    direction: str | None,
    environment: Path | None,
    exposure: float,
    output: Path | None,
    picture: Path | None,
    turntable: Path | None,
    axis: str,
    frames: int,
    fps: float,
    size: int,
    inset: bool,
) -> None:
    """Turn the light of a tree, or put it under a new environment.

    Highlights, diffuse and toon shading, rims and environments turn together; paint stays. With --environment the form
    becomes what the environment sheds, highlights become its reflection, and a turn then turns the environment.

    \b
    Examples:
      unshade relight out/ball --turn 30,10 -o new.json --render new.png
      unshade relight out/ball --turntable ball.gif
      unshade relight out/ball --environment studio.hdr -o studio.json --turntable studio.mp4
    """
    from unshade import relight as lights
    from unshade.assignment import read_direction
    from unshade.nodes import Tree, leaf
    from unshade.picture_output import check_picture, write_picture
    from unshade.surroundings import Surroundings, under
    from unshade.turntable import check_turntable, frame, write_turntable
    from unshade.turntable import turntable as turned

    if output is None and picture is None and turntable is None:
        raise click.UsageError("nothing to write: give -o, --render or --turntable")
    if turn is not None and turn[0] is not None:
        raise click.UsageError("--turn turns all of the light; `unshade edit --move-light ADDRESS=RIGHT,UP` moves one")
    for path in (picture, turntable):
        if path is not None:
            check_kept(path, environment, tree_file(tree))
    if picture is not None:
        check_picture(picture)
    if turntable is not None:
        check_turntable(turntable)
    lit = sky = read_tree(tree)
    if environment is not None:
        surroundings = Surroundings.read(environment)
        lit, sky = under(lit, surroundings, exposure), Tree(leaf("environment_map", pixels=surroundings.raster))
    rotations = [lights.turn_to(lit.root, read_direction(direction))] if direction is not None else []
    rotations += [lights.turn_of(*turn[1])] if turn is not None else []
    for rotation in rotations:
        lit, sky = lights.turn(lit, rotation), lights.turn(sky, rotation)
    shown = sky if inset else None
    pictures = turned(lit, frames, size, axis, shown) if turntable is not None else None
    if output is not None:
        write_tree(lit, output, [tree])
    if picture is not None:
        write_picture(picture, frame(lit, size, shown))
    if turntable is not None and pictures is not None:
        write_turntable(turntable, pictures, fps)


VERBS = (relight,)
