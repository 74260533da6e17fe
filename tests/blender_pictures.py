"""Pictures that Blender makes: of scripts and .blend files by Cycles, of MatCaps by its Workbench."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from unshade.errors import MissingExtraError
from unshade.export.blender import command
from unshade.png import read_png

HERE = Path(__file__).parent


def blender_or_skip() -> list[str]:
    """How to run a script in Blender; skipped where there is none."""
    try:
        return command()
    except MissingExtraError:
        pytest.skip("needs Blender (on the path, or UNSHADE_BLENDER: also a Python with bpy)")


def run_in_blender(script: Path, *arguments: object, within: Sequence[str] = ()) -> str:
    """What a script prints in Blender; skipped where there is none. Raises AssertionError with Blender's words."""
    start = blender_or_skip()
    separator = ["--"] if "--python" in start else []
    whole = [*within, *start, str(script), *separator, *map(str, arguments)]
    done = subprocess.run(whole, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stderr or done.stdout)[-2000:]
    return done.stdout


def blender_version() -> str:
    """``Blender 5.0.1``."""
    return run_in_blender(HERE / "blender_version.py").partition("THIS IS ")[2].splitlines()[0]


def by_cycles(folder: Path, size: int) -> dict[str, np.ndarray]:
    """What Cycles draws of the scripts and .blend files of a folder, (3, size, size) each."""
    run_in_blender(HERE / "blender_cycles.py", folder, size)
    return _read(folder)


def by_workbench(folder: Path, size: int) -> dict[str, np.ndarray]:
    """What Workbench draws with the MatCaps of a folder, (3, size, size) each; skipped where it has no display."""
    within = [] if os.environ.get("DISPLAY") else ["xvfb-run", "-a"]
    if within and not shutil.which("xvfb-run"):
        pytest.skip("Blender's Workbench needs a display (apt-get install xvfb xauth)")
    run_in_blender(HERE / "blender_matcap.py", folder, size, within=within)
    return _read(folder / "shown")


def _read(folder: Path) -> dict[str, np.ndarray]:
    return {path.stem: read_png(path.read_bytes())[:3] / 65535.0 for path in folder.glob("*.png")}
