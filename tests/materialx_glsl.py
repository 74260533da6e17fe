"""MaterialX documents: validated against the standard library, and as the GLSL that MaterialX generates from them."""

from __future__ import annotations

import re
from functools import cache

import MaterialX
from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenShader

from chromium import Job
from unshade.export.program import Program


@cache
def library() -> MaterialX.Document:
    """The standard library."""
    found = MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), found)
    return found


def document(text: str) -> MaterialX.Document:
    """A document that stands on the library. Raises AssertionError with the validator's words."""
    found = MaterialX.createDocument()
    MaterialX.readFromXmlString(found, text)
    found.setDataLibrary(library())
    valid, said = found.validate()
    assert valid, said
    return found


def job(text: str, made: Program) -> Job:
    """The pixel shader of a document's material for the sphere under an eye far away, its uniforms as constants."""
    maker = PyMaterialXGenGlsl.EsslShaderGenerator.create()
    context = PyMaterialXGenShader.GenContext(maker)
    context.registerSourceCodeSearchPath(MaterialX.getDefaultDataSearchPath())
    context.getOptions().hwSrgbEncodeOutput = True
    whole = document(text)  # must outlive its elements
    shader = maker.generate("tree", whole.getChild("unshade"), context)
    source = shader.getSourceCode(PyMaterialXGenShader.PIXEL_STAGE)
    block = shader.getStage(PyMaterialXGenShader.PIXEL_STAGE).getUniformBlock("PublicUniforms")
    samplers = []
    for k in range(len(block)):
        port = block[k]
        kind, name = port.getType().getName(), port.getVariable()
        if kind == "filename":
            samplers.append(name)
        elif port.getValue() is not None and re.search(rf"uniform (\w+) {name};", source):
            value = port.getValue().getValueString()
            source = re.sub(rf"uniform (\w+) {name};", lambda m, v=value, n=name: f"const {m[1]} {n} = {m[1]}({v});", source)
    source = re.sub(r"in vec3 (normalWorld|positionWorld);", "", source)
    source = source.replace("uniform vec3 u_viewPosition;", "const vec3 u_viewPosition = vec3(0.0, 0.0, 1e5);")
    frame = "vec2 p = gl_FragCoord.xy / (0.5 * float(SIZE)) - 1.0; p /= max(length(p), 1.0);"
    frame += " normalWorld = vec3(p, sqrt(max(1.0 - dot(p, p), 0.0))); positionWorld = normalWorld;"
    source = source.replace("void main()\n{", f"vec3 normalWorld, positionWorld;\nvoid main()\n{{\n    {frame}")
    named = {item.name: item.raster for item in made.pictures}
    files = {block[k].getVariable(): block[k].getValue().getValueString() for k in range(len(block)) if block[k].getVariable() in samplers}
    return Job(source, {}, {name: named[file.removesuffix(".png")] for name, file in files.items()}, flipped=True)
