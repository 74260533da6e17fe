"""Draws the pictures of docs/photographs.md and docs/photo-gallery.md.

The cup is a photo by Rachel Michetti, courtesy of Pikolo Espresso Bar, CC0, from the sample pictures of scikit-image 0.26 (cut to
440 x 400); `docs/photographs/cup.png` is where this script starts. All else is made here.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from unshade.apply import apply_to_photo, shade_shape
from unshade.assignment import read_color
from unshade.decompose import decompose
from unshade.edit import move_light
from unshade.extract import Extraction, from_drawing, from_mask, from_normal_map
from unshade.mesh import Mesh, View, compute_normals, render_mesh
from unshade.nodes import Tree
from unshade.picture_output import write_picture
from unshade.pictures import Disc, SphereImage
from unshade.recolor import recolor
from unshade.render import render
from unshade.serde import parse
from unshade.sphere import disc_mask, sphere_normals
from unshade.vector_art import Drawing

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "photographs"
sys.path.insert(0, str(ROOT / "tests"))
import photo_scenes as scenes  # noqa: E402

SIZE, GAP, WORDS = 220, 10, 24
DARK, LIGHT = (31, 31, 31), (225, 225, 225)

SVG = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 240 220">
<defs><radialGradient id="skin" cx="0.36" cy="0.3" r="0.78"><stop offset="0" stop-color="#ffd59a"/>
<stop offset="0.45" stop-color="#e0702c"/><stop offset="0.85" stop-color="#8c2f10"/>
<stop offset="1" stop-color="#b0481c"/></radialGradient></defs>
<rect width="240" height="220" fill="#dfe7ea"/><ellipse cx="126" cy="196" rx="78" ry="12" fill="#b9c6cb"/>
<path id="fruit" fill="url(#skin)" d="M118 44 C150 20 214 44 208 108 C204 164 164 200 122 196 C76 200 34 160 34 108 C32 52 84 22 118 44Z"/>
<path id="leaf" fill="#4d8a3a" d="M118 44 C122 20 146 10 172 16 C160 36 142 44 118 44Z"/></svg>
"""


def pixels(image: torch.Tensor, alpha: torch.Tensor | None = None) -> Image.Image:
    shown = image.detach().double().clamp(0, 1).expand(3, -1, -1)
    if alpha is not None:
        shown = shown * alpha + torch.tensor(DARK).view(3, 1, 1) / 255.0 * (1 - alpha)
    return Image.fromarray((shown * 255.0).round().byte().permute(1, 2, 0).numpy())


def ball(tree: Tree) -> Image.Image:
    return pixels(render(tree, sphere_normals(256)), disc_mask(256).double())


def sheet(name: str, entries: list[tuple[str, Image.Image]], columns: int) -> None:
    rows = -(-len(entries) // columns)
    whole = Image.new("RGB", (columns * (SIZE + GAP) + GAP, rows * (SIZE + WORDS + GAP) + GAP), DARK)
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(13)
    for number, (words, picture) in enumerate(entries):
        row, column = divmod(number, columns)
        x, y = GAP + column * (SIZE + GAP), GAP + row * (SIZE + WORDS + GAP)
        small = picture.copy()
        small.thumbnail((SIZE, SIZE), Image.Resampling.LANCZOS)
        whole.paste(small, (x + (SIZE - small.width) // 2, y + (SIZE - small.height) // 2))
        draw.text((x + SIZE / 2, y + SIZE + 5), words, fill=LIGHT, font=font, anchor="ma")
    whole.save(FOLDER / f"{name}.png", optimize=True)


def tree_of(found: Extraction, preset: str = "balanced") -> Tree:
    sphere = SphereImage(found.image, (found.coverage >= 0.5) & disc_mask(256), Disc(128.0, 128.0, 128.0))
    return decompose(sphere, preset=preset).result().tree


def knot(folder: Path) -> None:
    """A photo with a known answer."""
    normals, mask = scenes.knot(384)
    truth = scenes.tree_of("wax")
    photo = scenes.photo(truth, normals, mask, "stripes and shadow")
    write_picture(folder / "photo.png", photo)
    write_picture(folder / "normals.png", normals * 0.5 + 0.5, mask, bits=16)
    found = from_normal_map(folder / "photo.png", folder / "normals.png")
    plain = from_normal_map(folder / "photo.png", folder / "normals.png", even=False)
    tree = tree_of(found)
    blue = recolor(tree, read_color("#3f7fc8"))
    result = apply_to_photo(blue, tree, photo.float(), normals.float(), mask)
    disc = disc_mask(256).double()
    sheet(
        "knot",
        [
            ("photo: texture, cast shadow", pixels(photo)),
            ("its normal map", pixels(normals * 0.5 + 0.5, mask.double())),
            ("mean of each direction", pixels(plain.image, disc)),
            ("extract", pixels(found.image, disc)),
            ("truth", ball(truth)),
            ("its tree, recoloured", ball(blue)),
            ("apply --photo: detail kept", pixels(result)),
            ("apply without a photo", pixels(render(blue, normals), mask.double())),
        ],
        4,
    )


def cup_masks() -> tuple[Image.Image, Image.Image]:
    """The outline of saucer and cup, and what in it is no red glaze: the white inside of the cup, and the spoon."""
    outline, ignored = Image.new("L", (880, 800)), Image.new("L", (880, 800))
    ImageDraw.Draw(outline).ellipse((29, 92, 844, 787), fill=255)
    draw = ImageDraw.Draw(ignored)
    draw.ellipse((225, 34, 699, 413), fill=255)
    draw.ellipse((528, 476, 696, 656), fill=255)
    draw.line([(655, 490), (645, 440), (690, 300), (712, 190)], fill=255, width=34, joint="curve")
    return outline.resize((440, 400), Image.Resampling.LANCZOS), ignored.resize((440, 400), Image.Resampling.LANCZOS)


def cup(folder: Path) -> None:
    """A real photo through extract, decompose, edit and apply."""
    outline, ignored = cup_masks()
    outline.save(folder / "outline.png")
    ignored.save(folder / "ignored.png")
    found = from_mask(FOLDER / "cup.png", folder / "outline.png", ignore=folder / "ignored.png", even=False)
    tree = tree_of(found)
    entries: list[tuple[str, Image.Image]] = [
        ("a photo", pixels(found.photo)),
        ("normals guessed from its outline", pixels(found.normals * 0.5 + 0.5, found.mask.double())),
        ("extract", pixels(found.image, disc_mask(256).double())),
        (f"decompose: {tree.values} values", ball(tree)),
    ]
    edits = {
        "edit --recolor teal": recolor(tree, read_color("#0f7f86")),
        "edit --recolor navy": recolor(tree, read_color("#20306c")),
        "edit --recolor ochre": recolor(tree, read_color("#b98a1e")),
        "edit --recolor green": recolor(tree, read_color("#2e7d46")),
    }
    entries += [(words, ball(edited)) for words, edited in edits.items()]
    entries += [
        ("apply --photo", pixels(apply_to_photo(edited, tree, found.photo, found.normals, found.mask))) for edited in edits.values()
    ]
    sheet("cup_edits", entries, 4)


def drawn(svg: str) -> Image.Image:
    import resvg_py

    with Image.open(io.BytesIO(bytes(resvg_py.svg_to_bytes(svg_string=svg, width=480)))) as image:
        return image.convert("RGB")


def drawing(folder: Path) -> None:
    """Flat art: the shading lifted off, changed, and given back."""
    path = folder / "drawing.svg"
    path.write_text(SVG, encoding="utf-8")
    found = from_drawing(path, "fruit")
    tree = tree_of(found)
    entries = [
        ("a drawing", drawn(SVG)),
        ("extract --region fruit", pixels(found.image, disc_mask(256).double())),
        ("decompose", ball(tree)),
    ]
    shape = Drawing.read(path).lift("fruit")
    for words, edited in {
        "recolor, given back": recolor(tree, read_color("#7a4fc0")),
        "move-light 20,-10, given back": move_light(tree, 20.0, -10.0),
        "recolor green, given back": recolor(tree, read_color("#5a9a30")),
    }.items():
        given = Drawing.read(path).give_back("fruit", shade_shape(edited, tree, shape))
        entries.append((words, drawn(given)))
    sheet("drawing", entries, 3)


def spheres(count: int = 48) -> Mesh:
    """Three balls in a row, one behind the other."""
    up, around = np.meshgrid(np.linspace(0, np.pi, count + 1), np.linspace(0, 2 * np.pi, 2 * count + 1), indexing="ij")
    points = np.stack([np.sin(up) * np.sin(around), np.cos(up), np.sin(up) * np.cos(around)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    one = np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
    corners = np.concatenate([one + np.array([2.3 * k, 0.0, -1.5 * k]) for k in (-1, 0, 1)])
    return Mesh(corners, compute_normals(corners), True)


def meshes() -> None:
    """Meshes, and the silhouette in perspective."""
    rim = parse("screen(multiply(albedo(#803020), diffuse(up front, 0.5)), multiply(albedo(#60c0ff), rim(front, 2.5)), rim(up, 3))")
    gold = parse(
        "screen(multiply(albedo(#c08a30), diffuse(left up front, ambient=0.2)), highlight(left up front, 60, 0.9),"
        " multiply(albedo(#8a5020), highlight(right, 5)))"
    )
    normals, mask = scenes.knot(512)
    entries = [
        ("--angle 0", pixels(*render_mesh(rim, spheres(), 256, View((0.0, 0.0, 0.0), 0.0)))),
        ("--angle 30", pixels(*render_mesh(rim, spheres(), 256, View((0.0, 0.0, 0.0), 30.0)))),
        ("--angle 90", pixels(*render_mesh(rim, spheres(), 256, View((0.0, 0.0, 0.0), 90.0)))),
        ("a tree on a knot", pixels(render(gold, normals), mask.double())),
    ]
    sheet("mesh", entries, 4)


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        for make in (knot, cup, drawing):
            make(Path(name))
    meshes()


if __name__ == "__main__":
    main()
