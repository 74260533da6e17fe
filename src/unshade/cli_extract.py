"""The verbs that lead from a photo or a drawing to a sphere and back: extract and apply. Heavy modules load inside the verb."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from unshade.arguments import SEED, Disc, read_tree
from unshade.cli_edit import Degrees
from unshade.errors import OutputError
from unshade.files import check_kept, write_whole
from unshade.staging import TREE_FILE, check_own

if TYPE_CHECKING:
    from unshade.extract import Extraction
    from unshade.nodes import Tree
    from unshade.normal_maps import Convention, NormalMap
    from unshade.terminal import Messages


class OptionalDisc(Disc):
    """As `Disc`, or nothing but the option itself: then the ball is found."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """An empty tuple where the ball is to be found."""
        return () if value == "" else super().convert(value, param, ctx)


FILE = click.Path(path_type=Path)

REPORT = "extract.json"
WRITTEN = (REPORT, "matcap.png", "coverage.png", "unseen.png", "normals.png", "shape.png")
"""What `extract` writes beside the tree."""

GREEN = click.option(
    "--green",
    type=click.Choice(["auto", "opengl", "directx"]),
    default="auto",
    show_default=True,
    help="Which way the normal map's green points.",
)
SPACE = click.option(
    "--space", type=click.Choice(["auto", "tangent", "camera"]), default="auto", show_default=True, help="What the normal map's axes are."
)


@click.command()
@click.argument("photo", type=FILE, metavar="PHOTO")
@click.option(
    "--disc", type=OptionalDisc(), is_flag=False, flag_value="", metavar="[cx,cy,r]", help="It is a ball; found by itself or given."
)
@click.option("--normals", type=FILE, metavar="FILE", help="A normal map of the object, of the photo's size.")
@click.option("--mask", type=FILE, metavar="FILE", help="The object's outline, white or opaque; its normals are guessed by inflating it.")
@click.option("--region", metavar="ID", help="Of an SVG: the shape or group whose shading is lifted off.")
@GREEN
@SPACE
@click.option(
    "--texture",
    type=click.Choice(["auto", "keep", "remove"]),
    default="auto",
    show_default=True,
    help="Take paint and cast shadow out; auto keeps them on balls and drawings.",
)
@click.option("--ignore", type=FILE, metavar="FILE", help="A picture of the photo's size, white where pixels do not count.")
@click.option("--size", type=click.IntRange(16, 2048), default=256, show_default=True, metavar="N", help="Width and height of the MatCap.")
@click.option("--decompose", "preset", type=click.Choice(["draft", "balanced", "best"]), help="Decompose it too: writes DIR/tree.json.")
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="Of the decomposition.")
@click.option("-o", "--output", required=True, type=FILE, metavar="DIR", help="Where the files go.")
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
@click.option("--json", "as_json", is_flag=True, help="Print extract.json.")
def extract(photo: Path, output: Path, preset: str | None, seed: int, quiet: bool, as_json: bool, **options: Any) -> None:
    """Make a MatCap of a photo or a drawing: a sphere with the object's shading.

    PHOTO shows a ball (--disc, also the default), any object with a normal map (--normals), any object with an outline
    (--mask; its normals are then a guess), or is an SVG (--region; a guess too).

    DIR gets matcap.png; coverage.png, how well each direction was seen, and unseen.png, its opposite, for
    `decompose --mask`; normals.png, the normals of the photo for `apply`; and extract.json. With --region also shape.png.

    \b
    Examples:
      unshade extract ball.jpg --disc 412,300,220 -o out
      unshade extract statue.jpg --normals statue_normals.png --decompose balanced -o out
      unshade extract apple.jpg --mask apple_mask.png -o out
      unshade extract drawing.svg --region body --decompose balanced -o out
    """
    from unshade.decompose import decompose
    from unshade.picture_output import write_picture
    from unshade.pictures import Disc as FoundDisc
    from unshade.pictures import SphereImage
    from unshade.serde import dump
    from unshade.sphere import disc_mask
    from unshade.staging import staged
    from unshade.terminal import Messages

    check_own(output, REPORT, WRITTEN)
    for name in WRITTEN:
        check_kept(output / name, photo, options["normals"], options["mask"], options["ignore"])
    messages = Messages(quiet)
    found = _extract(photo, **options)
    report = _report(found, photo)
    if found.convention is not None:
        messages.say(_read_as(options["normals"], found.convention, found.told))
    for line in _said(found):
        messages.say(line)
    size = found.image.shape[-1]
    seen = found.coverage >= 0.5
    family = None
    if preset is not None:
        sphere = SphereImage(found.image, seen & disc_mask(size), FoundDisc(size / 2, size / 2, size / 2), found.exposure)
        result = decompose(sphere, preset=preset, seed=seed).result()
        family = result.family
        report["tree"] = {"psnr": round(result.psnr, 2), "values": result.tree.values}
        messages.say(f"decomposed: {result.psnr:.1f} dB where it was seen, {result.tree.values} values")
    with staged(output) as folder:
        write_picture(folder / "matcap.png", found.image, bits=16)
        write_picture(folder / "coverage.png", found.coverage)
        write_picture(folder / "unseen.png", (~seen).float())
        write_picture(folder / "normals.png", found.normals * 0.5 + 0.5, found.mask, bits=16)
        if options["region"] is not None:
            write_picture(folder / "shape.png", found.photo, found.mask)
        (folder / REPORT).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        if family is not None:
            dump(family, folder / TREE_FILE)
    if as_json:
        click.echo(json.dumps(report))


def _extract(photo: Path, **given: Any) -> Extraction:
    """One of the four ways. Raises UsageError where the options do not say which."""
    from unshade import extract as ways

    chosen = [name for name in ("disc", "normals", "mask", "region") if given[name] is not None]
    if len(chosen) > 1:
        raise click.UsageError(f"--{chosen[0]} and --{chosen[1]} exclude each other: give the one that says what the normals are")
    svg = photo.suffix.lower() in (".svg", ".svgz")
    if svg != (given["region"] is not None):
        raise click.UsageError("an SVG needs --region ID" if svg else "--region is for an SVG; give --mask for the outline in a photo")
    if given["normals"] is None and (given["green"], given["space"]) != ("auto", "auto"):
        raise click.UsageError("--green and --space are for --normals")
    if given["region"] is not None and given["ignore"] is not None:
        raise click.UsageError("--ignore is for photos")
    shared = {"size": given["size"]} | ({} if given["texture"] == "auto" else {"even": given["texture"] == "remove"})
    if given["region"] is not None:
        return ways.from_drawing(photo, given["region"], **shared)
    shared["ignore"] = given["ignore"]
    if given["normals"] is not None:
        return ways.from_normal_map(photo, given["normals"], green=given["green"], space=given["space"], **shared)
    if given["mask"] is not None:
        return ways.from_mask(photo, given["mask"], **shared)
    return ways.from_ball(photo, disc=given["disc"] or None, **shared)


def _report(found: Extraction, photo: Path) -> dict[str, Any]:
    disc = found.disc
    return {
        "input": str(photo),
        "how": found.how,
        "normals_are_a_guess": found.guess,
        "seen": round(found.seen, 4),
        "convention": str(found.convention) if found.convention else None,
        "convention_told": found.told if found.convention else None,
        "disc": [round(number, 3) for number in (disc.cx, disc.cy, disc.r)] if disc else None,
        "paints": [
            {"ratio": [round(number, 3) for number in paint.ratio], "share": round(paint.share, 4), "shadow": paint.shadow}
            for paint in found.paints
        ],
        "unexplained": round(found.unexplained, 4),
        "exposure": found.exposure,
    }


def _read_as(normals: Path, convention: Convention, told: bool) -> str:
    other = "directx" if convention.green == "opengl" else "opengl"
    return f"{normals}: read as {convention}" + ("" if told else f"; the map does not show which, say --green {other} if it is not")


def _said(found: Extraction) -> list[str]:
    lines = ["the normals are a guess: the outline was blown up like a balloon"] if found.guess else []
    for paint in found.paints:
        color = ", ".join(f"{number:.2f}" for number in paint.ratio)
        what = "a shadow or grey paint" if paint.shadow else "a paint"
        lines.append(f"taken out: {what} of {paint.share:.0%} of the object, {color} times the common one")
    lines.append(f"seen: {found.seen:.0%} of the directions; the rest is filled")
    return lines


@click.command()
@click.argument("tree")
@click.option("--normals", type=FILE, metavar="FILE", help="Shade this normal map.")
@click.option("--photo", type=FILE, metavar="FILE", help="The photo that the normals are of; it keeps its own detail. Needs --from.")
@click.option("--from", "source", metavar="TREE", help="The tree before it was edited, which the photo was explained by.")
@click.option(
    "--detail",
    type=click.Choice(["ratio", "residual"]),
    default="ratio",
    show_default=True,
    help="How the photo's detail comes along: as a texture under the lights, or added.",
)
@GREEN
@SPACE
@click.option("--drawing", type=FILE, metavar="SVG", help="Shade a shape of a drawing instead; -o is then an SVG too.")
@click.option("--region", metavar="ID", help="The shape or group of the drawing.")
@click.option("--mesh", type=FILE, metavar="FILE", help="Shade a mesh instead: GLB, glTF, OBJ, PLY, STL or OFF.")
@click.option("--turn", type=Degrees(), metavar="RIGHT,UP[,ROLL]", help="Turn the mesh by degrees.")
@click.option(
    "--angle",
    type=click.FloatRange(0, 120),
    default=30.0,
    show_default=True,
    metavar="DEGREES",
    help="Angle of view of the mesh; 0 is orthographic.",
)
@click.option(
    "--size", type=click.IntRange(16, 4096), default=512, show_default=True, metavar="N", help="Width and height of the picture of a mesh."
)
@click.option(
    "-o", "--output", required=True, type=FILE, metavar="FILE", help="The picture; of a mesh or a masked map it is transparent around."
)
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
def apply(tree: str, output: Path, quiet: bool, **given: Any) -> None:
    """Shade an object with a tree: a normal map, a photo, a shape of a drawing, or a mesh.

    With --photo an edit of the tree becomes an edit of the photo: what the photo has and the unedited tree --from has not,
    texture, dirt, shadows, is put back.

    \b
    Examples:
      unshade apply out/ball --normals vase_normals.png -o vase.png
      unshade apply blue.json --from out --normals out/normals.png --photo statue.jpg -o blue_statue.png
      unshade apply blue.json --from out --drawing drawing.svg --region body -o blue.svg
      unshade apply out/ball --mesh bunny.glb --turn 30,-20 -o bunny.png
    """
    from unshade.terminal import Messages

    chosen = [name for name in ("normals", "drawing", "mesh") if given[name] is not None]
    if len(chosen) != 1:
        raise click.UsageError("give one of --normals, --drawing and --mesh")
    if (given["photo"] is not None and given["source"] is None) or (
        given["source"] is not None and given["photo"] is None and chosen != ["drawing"]
    ):
        raise click.UsageError("--photo and --from go together: the photo's own detail is what the tree --from leaves of it")
    if given["photo"] is not None and chosen != ["normals"]:
        raise click.UsageError("--photo needs --normals, the normals of what it shows")
    if (given["region"] is not None) != (chosen == ["drawing"]):
        raise click.UsageError("--drawing and --region go together")
    check_kept(output, given["normals"], given["photo"], given["drawing"], given["mesh"])
    edited = read_tree(tree)
    original = read_tree(given["source"]) if given["source"] is not None else None
    messages = Messages(quiet)
    {"normals": _on_normals, "drawing": _on_drawing, "mesh": _on_mesh}[chosen[0]](edited, original, output, messages, given)


def read_normals(path: Path, green: Any, space: Any, messages: Messages) -> NormalMap:
    """A normal map; says how it was read unless that is as most maps are. Raises PictureError."""
    from unshade.normal_maps import Convention, read_normal_map

    found = read_normal_map(path, green=green, space=space)
    if not found.told or found.convention != Convention():
        messages.say(_read_as(path, found.convention, found.told))
    return found


def shade_normals(tree: Tree, output: Path, path: Path, green: str = "auto", space: str = "auto", quiet: bool = False) -> None:
    """Draw a tree over a normal map, on transparency where the map holds no normals. Raises PictureError, OutputError."""
    from unshade.apply import shade
    from unshade.picture_output import write_picture
    from unshade.terminal import Messages

    check_kept(output, path)
    found = read_normals(path, green, space, Messages(quiet))
    masked = bool((found.mask < 1.0).any()) and output.suffix.lower() not in (".jpg", ".jpeg", ".bmp")
    write_picture(output, shade(tree, found.normals.float()), found.mask if masked else None, exposure=tree.exposure)


def draw(tree: Tree, output: Path, size: int, normals: Path | None, green: str) -> None:
    """What `render` does: a sphere of ``size`` pixels, or a normal map. Raises UsageError, PictureError, OutputError."""
    from unshade import artifacts

    if normals is not None:
        shade_normals(tree, output, normals, green)
    elif green != "auto":
        raise click.UsageError("--green is for --normals")
    else:
        artifacts.write_render(tree, output, size)


def _on_normals(edited: Tree, original: Tree | None, output: Path, messages: Messages, given: dict[str, Any]) -> None:
    import torch

    from unshade.apply import apply_to_photo
    from unshade.extract import read_photo
    from unshade.normal_maps import check_size
    from unshade.picture_output import write_picture

    if original is None:
        shade_normals(edited, output, given["normals"], given["green"], given["space"], messages.quiet)
        return
    found = read_normals(given["normals"], given["green"], given["space"], messages)
    photo, alpha, exposure = read_photo(given["photo"], original.exposure)
    check_size(found, given["normals"], photo.shape[-1], photo.shape[-2], given["photo"])
    result = apply_to_photo(edited, original, photo, found.normals.float(), found.mask, given["detail"])
    assert torch.isfinite(result).all()
    write_picture(output, result, alpha, exposure=exposure)


def _on_drawing(edited: Tree, original: Tree | None, output: Path, messages: Messages, given: dict[str, Any]) -> None:
    from unshade.apply import shade_shape
    from unshade.vector_art import Drawing

    if output.suffix.lower() != ".svg":
        raise OutputError(
            f"{output}: expected a name that ends in .svg, since a drawing is given back, got {output.suffix or 'no suffix'!r}"
        )
    drawing = Drawing.read(given["drawing"])
    shape = shade_shape(edited, original, drawing.lift(given["region"]), given["detail"])
    write_whole(output, drawing.give_back(given["region"], shape).encode("utf-8"))


def _on_mesh(edited: Tree, original: Tree | None, output: Path, messages: Messages, given: dict[str, Any]) -> None:
    from unshade.mesh import View, read_mesh, render_mesh
    from unshade.picture_output import write_picture

    if given["turn"] is not None and given["turn"][0] is not None:
        raise click.UsageError("--turn of a mesh takes degrees only, such as 30,-20")
    mesh = read_mesh(given["mesh"])
    if mesh.computed:
        messages.say(f"{given['mesh']}: has no normals, or not for all of it; they were computed, smooth but for sharp edges")
    angles = [*(given["turn"][1] if given["turn"] is not None else ()), 0.0, 0.0, 0.0]
    image, alpha = render_mesh(edited, mesh, given["size"], View((angles[0], angles[1], angles[2]), given["angle"]))
    write_picture(output, image, alpha, exposure=edited.exposure)


VERBS = (extract, apply)
