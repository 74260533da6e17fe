"""Pictures that headless Chromium makes: fragment shaders of WebGL 2, and pages as they stand."""

from __future__ import annotations

import base64
import contextlib
import functools
import http.server
import io
import json
import os
import queue
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unshade.nodes import Raster
from unshade.rasters import raster_to_png

HARNESS = """<!doctype html><meta charset="utf-8"><script type="module">
const jobs = JOBS, size = SIZE, found = {};
const canvas = Object.assign(document.createElement("canvas"), { width: size, height: size });
const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
const vertex = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;
function compiled(type, source) {
  const shader = gl.createShader(type);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}
for (const [name, job] of Object.entries(jobs)) {
  try {
    const program = gl.createProgram();
    gl.attachShader(program, compiled(gl.VERTEX_SHADER, vertex));
    gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, job.source));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    for (const [uniform, value] of Object.entries(job.uniforms)) {
      const place = gl.getUniformLocation(program, uniform);
      if (Array.isArray(value)) gl[`uniform${value.length}fv`](place, value); else gl.uniform1f(place, value);
    }
    let unit = 0;
    for (const [uniform, picture] of Object.entries(job.pictures)) {
      const image = new Image();
      image.src = picture;
      await image.decode();
      const bitmap = await createImageBitmap(image, { colorSpaceConversion: "none", imageOrientation: job.flipped ? "flipY" : "none" });
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
      for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.LINEAR);
      gl.uniform1i(gl.getUniformLocation(program, uniform), unit++);
    }
    gl.viewport(0, 0, size, size);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    found[name] = canvas.toDataURL("image/png");
  } catch (error) { found[name] = String(error); }
}
await fetch("found", { method: "POST", body: JSON.stringify(found) });
</script>"""

NORMAL = """
vec3 unit_normal() {
    vec2 xy = gl_FragCoord.xy / (0.5 * float(SIZE)) - 1.0;
    xy /= max(length(xy), 1.0);
    return vec3(xy, sqrt(max(1.0 - dot(xy, xy), 0.0)));
}
"""
"""GLSL for the normal at a pixel of a square picture of the sphere."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")

OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@dataclass(frozen=True)
class Job:
    """A whole fragment shader of GLSL ES 3.00, and what it is given."""

    source: str
    uniforms: Mapping[str, float | list[float]]
    pictures: Mapping[str, Raster]
    flipped: bool = False
    """Rows of pictures run upwards."""


def browser_or_skip() -> str:
    """Path of a Chromium; skipped where there is none."""
    for name in BROWSERS:
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("needs Chromium (apt-get install chromium)")


@contextlib.contextmanager
def served(folder: Path) -> Iterator[tuple[str, queue.Queue[str]]]:
    """A server of a folder on this machine: its address, and what pages POST to ``found``."""
    posted: queue.Queue[str] = queue.Queue()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_POST(self) -> None:
            posted.put(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(204)
            self.end_headers()

        def end_headers(self) -> None:
            self.send_header("Cross-Origin-Opener-Policy", "same-origin")
            self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
            super().end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder)) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", posted
        finally:
            server.shutdown()
            thread.join()


def posted_by(browser: str, folder: Path, page: str, timeout: float = 120.0) -> str:
    """What a page of a folder POSTs to ``found`` once it is done."""
    with served(folder) as (address, posted), tempfile.TemporaryDirectory() as profile:
        arguments = [browser, *OPTIONS, f"--user-data-dir={profile}", f"{address}/{page}"]
        with subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True) as process:
            try:
                return posted.get(timeout=timeout)
            finally:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def shaders(browser: str, folder: Path, jobs: Mapping[str, Job], size: int = 256) -> dict[str, np.ndarray]:
    """(3, size, size) in [0, 1] of each shader. Raises AssertionError with the compiler's words."""
    described = {
        name: {
            "source": job.source.replace("SIZE", str(size)),
            "uniforms": dict(job.uniforms),
            "pictures": {key: f"data:image/png;base64,{base64.b64encode(raster_to_png(r)).decode()}" for key, r in job.pictures.items()},
            "flipped": job.flipped,
        }
        for name, job in jobs.items()
    }
    page = folder / "shaders.html"
    page.write_text(HARNESS.replace("JOBS", json.dumps(described).replace("</", "<\\/")).replace("SIZE", str(size)), encoding="utf-8")
    found = json.loads(posted_by(browser, folder, page.name))
    broken = {name: text for name, text in found.items() if not text.startswith("data:")}
    assert not broken, broken
    return {name: decoded(base64.b64decode(text.partition(",")[2])) for name, text in found.items()}


def decoded(png: bytes) -> np.ndarray:
    """(3, H, W) in [0, 1]."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).transpose(2, 0, 1) / 255.0
