"""three.js: a module with the parameters and a material, and a page that opens offline with a control for each.

The page carries three.js inside (``three.module.min.js`` beside this file, with its licence), so it needs no network.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from unshade.export.glsl import GLSL, too_many
from unshade.export.program import Program, Uniform, program
from unshade.export.shader_text import printed
from unshade.nodes import Tree
from unshade.rasters import raster_to_png

MODULE = """\
// Made by unshade. `createMaterial()` gives a THREE.ShaderMaterial; set `material.uniforms[name].value` to change the tree.
// Colours are THREE.Color as everywhere in three.js. Directions: +x right, +y up, +z to the viewer.
import * as THREE from "three";

export const parameters = %(parameters)s;

const pictures = %(pictures)s;

const vertexShader = /* glsl */ `
varying vec3 viewNormal;
varying vec3 toEye;
void main() {
    vec4 place = modelViewMatrix * vec4(position, 1.0);
    viewNormal = normalMatrix * normal;
    toEye = isOrthographic ? vec3(0.0, 0.0, 1.0) : -place.xyz;
    gl_Position = projectionMatrix * place;
}`;

const fragmentShader = /* glsl */ `
varying vec3 viewNormal;
varying vec3 toEye;
%(uniforms)s

%(functions)s
void main() {
    vec3 linear = unshade(seen(normalize(viewNormal), normalize(toEye)));
    gl_FragColor = vec4(linear, 1.0);
    #include <colorspace_fragment>
}`;

const textures = {};

function load(texture, url) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => { texture.image = image; texture.needsUpdate = true; resolve(); };
    image.onerror = reject;
    image.src = url;
  });
}

/** Resolves when the pictures of the tree have been read. */
export const ready = Promise.all(Object.entries(pictures).map(([name, url]) => {
  const texture = textures[name] = new THREE.Texture();
  Object.assign(texture, {
    flipY: false, generateMipmaps: false, colorSpace: THREE.NoColorSpace,
    minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter, wrapS: THREE.RepeatWrapping, wrapT: THREE.RepeatWrapping,
  });
  return load(texture, url);
}));

export function createMaterial() {
  const uniforms = {};
  for (const [name, { type, value }] of Object.entries(parameters)) {
    uniforms[name] = {
      value: type === "color" ? new THREE.Color().setRGB(...value, THREE.SRGBColorSpace)
        : type === "float" ? value : new THREE.Vector3(...value),
    };
  }
  for (const [name, texture] of Object.entries(textures)) uniforms[name] = { value: texture };
  return new THREE.ShaderMaterial({ uniforms, vertexShader, fragmentShader, toneMapped: false });
}
"""


def _described(uniform: Uniform, made: Program) -> dict[str, object]:
    value = made.picked(uniform, "srgb") if uniform.is_color else uniform.value
    return {
        "type": uniform.parameter.type if uniform.is_color else uniform.type,
        "value": value[0] if uniform.type == "float" else list(value),
        "low": uniform.parameter.low,
        "high": uniform.parameter.high,
        "logarithmic": uniform.parameter.logarithmic,
        "leaf": uniform.leaf,
        "label": uniform.label,
        "address": uniform.address,
        "meaning": uniform.summary,
    }


def module(made: Program) -> str:
    """The text of a JavaScript module that exports ``parameters``, ``createMaterial`` and ``ready``."""
    language = replace(GLSL, color="encode_color({name})" if made.space == "srgb" else "")
    rows = [f"  {item.name}: {json.dumps(_described(item, made))}," for item in made.uniforms]
    images = [
        f'  {item.name}: "data:image/png;base64,{base64.b64encode(raster_to_png(item.raster)).decode("ascii")}",' for item in made.pictures
    ]
    declared = [f"uniform {item.type} {item.name};" for item in made.uniforms]
    declared += [f"uniform sampler2D {item.name};" for item in made.pictures]
    return MODULE % {
        "parameters": "\n".join(["{", *rows, "}"]),
        "pictures": "\n".join(["{", *images, "}"]) if images else "{}",
        "uniforms": "\n".join(declared),
        "functions": printed(made, language, "linear", "seen", *(["encode_color"] if language.color else [])),
    }


def page(made: Program, title: str = "Shade tree") -> str:
    """The text of a page that runs without a network."""
    here = files("unshade.export")
    library = base64.b64encode(here.joinpath("three.module.min.js").read_bytes()).decode("ascii")
    text = here.joinpath("three_page.html").read_text(encoding="utf-8")
    code = module(made).replace("</", "<\\/")
    return text.replace("{{title}}", html.escape(title)).replace("{{three}}", library).replace("{{module}}", code)


def write(tree: Tree, path: Path) -> Iterator[str]:
    """Write a page (.html) or a module (.js); yields warnings."""
    made = program(tree)
    path.write_text(page(made) if path.suffix.lower() == ".html" else module(made), encoding="utf-8")
    yield from too_many(made)
