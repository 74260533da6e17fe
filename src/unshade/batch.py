"""Many pictures in one call: which, into which folders, what is done already, and the work on one of them.

Nothing here loads PyTorch in the calling process unless it does the work itself.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from unshade import __version__, crew
from unshade.errors import OutputError, PictureError, UnshadeError
from unshade.files import add_line
from unshade.staging import TREE_FILE, discard

if TYPE_CHECKING:
    from unshade.decompose import Result, Step
    from unshade.nodes import Tree
    from unshade.pictures import SphereImage

LOG_FILE = "results.jsonl"
"""One line a finished picture; what a later call reads to skip them."""

Record: TypeAlias = "dict[str, Any]"
"""What ``--json`` prints for a picture, or its ``input``, ``error`` and ``exit_code``."""

RECORD_KEYS = ("input", "tree", "psnr", "ssim", "st_lpips", "values", "leaves", "seconds", "seed")


@dataclass(frozen=True)
class Settings:
    """All that a result depends on, the picture aside."""

    preset: str = "balanced"
    max_values: int | None = None
    seed: int = 0
    alternatives: int = 1
    search: Literal["size", "depth"] = "size"
    objective: Literal["l2", "paper"] = "l2"
    method: Literal["search", "learned", "hybrid"] = "search"
    second_stage: Literal["size", "depth", "none"] = "size"
    weights: str | None = None
    device: str = "cpu"
    reflections: Literal["lights", "picture"] = "lights"
    disc: tuple[float, float, float] | None = None
    mask: str | None = None
    artifacts: str = "all"
    perceptual: bool = False

    def fingerprint(self, picture: Path) -> Record:
        """These settings with the contents of the picture and of the mask, and the version: equal only where the result would be."""
        found: Record = json.loads(json.dumps(dataclasses.asdict(self)))
        found["mask"] = digest(Path(self.mask)) if self.mask else None
        networks = {key: found.pop(key) for key in ("method", "second_stage", "weights", "device")}
        if networks["device"] == "cpu":
            del networks["device"]
        if self.method != "search":
            found |= networks | {"weights": _digest_of_weights("learned", self.weights)}
        if found.pop("reflections") == "picture":
            found["reflections"] = _digest_of_weights("reflections", self.weights)
        return found | {"picture": digest(picture), "version": __version__}


@dataclass(frozen=True)
class Job:
    """One picture to decompose, and the folder for it (None writes nothing)."""

    picture: Path
    folder: Path | None
    settings: Settings
    threads: int = field(default=1, compare=False)
    """Of the networks, and processes for the fits of what they drew; the tree is the same on any number. A search has one."""


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes, or an empty text where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _digest_of_weights(use: Literal["learned", "reflections"], folder: str | None) -> list[str]:
    from unshade.models import weights

    names = weights.MODELS if use == "learned" else weights.SEARCH
    return [digest(weights.file_of(name, folder)) for name in names]


def find_pictures(inputs: Iterable[Path]) -> list[Path]:
    """The named files and the pictures of the named folders, in order, each once. Raises PictureError for a folder without one."""
    from unshade.picture_files import SUFFIXES

    found: dict[str, Path] = {}
    for path in inputs:
        inside = [path]
        if path.is_dir():
            entries = (entry for entry in path.iterdir() if entry.suffix.lower() in SUFFIXES and not entry.name.startswith("."))
            inside = sorted(entry for entry in entries if entry.is_file())
            if not inside:
                raise PictureError(f"{path}: expected a folder with pictures ({' '.join(sorted(SUFFIXES))}), found none")
        for picture in inside:
            found.setdefault(_identity(picture), picture)
    return list(found.values())


_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{k}" for port in ("com", "lpt") for k in range(1, 10))}


def folder_name(picture: Path) -> str:
    """A picture's name without its suffix, changed where Windows or macOS would refuse it."""
    name = "".join("_" if letter in '<>:"/\\|?*' or ord(letter) < 32 else letter for letter in picture.stem)
    name = name[:100].strip(". ") or "picture"
    return f"{name}_" if name.split(".")[0].lower() in _RESERVED or name.lower() == LOG_FILE else name


def assign_folders(pictures: Sequence[Path], log: Log) -> list[str]:
    """A folder name for each picture, none twice: not in this call, nor one that an earlier call gave to another picture.

    Letters' case does not tell two names apart, because some file systems ignore it.
    """
    known = {_identity(picture): log.folder_of(picture) for picture in pictures}
    taken = {name.lower() for name in [*log.entries, *known.values()] if name}
    names = []
    for picture in pictures:
        name = known[_identity(picture)]
        if name is None:
            plain, number = folder_name(picture), 1
            name = plain
            while name.lower() in taken:
                number += 1
                name = f"{plain}-{number}"
            taken.add(name.lower())
        names.append(name)
    return names


def _identity(picture: Path) -> str:
    return os.path.normcase(os.path.abspath(picture))


class Log:
    """What is finished in an output folder: one JSON line a picture, the last one of a folder counts."""

    def __init__(self, directory: Path | None) -> None:
        self.path = directory / LOG_FILE if directory else None
        self.entries: dict[str, Record] = {}
        for line in self._lines():
            # A line cut off by a power failure is a picture that is not finished.
            with contextlib.suppress(ValueError, KeyError, TypeError):
                entry = json.loads(line)
                self.entries[entry["folder"]] = entry

    def _lines(self) -> list[str]:
        try:
            return self.path.read_text(encoding="utf-8", errors="replace").splitlines() if self.path else []
        except FileNotFoundError:
            return []
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be read: {error.strerror}") from error

    def folder_of(self, picture: Path) -> str | None:
        """The folder that an earlier call gave to this picture."""
        source = _identity(picture)
        return next((folder for folder, entry in self.entries.items() if entry.get("source") == source), None)

    def finished(self, job: Job) -> Record | None:
        """The record of a picture that was finished with the same settings and whose tree is still there."""
        entry = self.entries.get(job.folder.name) if job.folder else None
        if entry is None or job.folder is None or not (job.folder / TREE_FILE).is_file():
            return None
        if entry.get("fingerprint") != job.settings.fingerprint(job.picture):
            return None
        record = {key: entry.get(key) for key in RECORD_KEYS} | {key: entry[key] for key in ("stages",) if key in entry}
        return record | {"input": str(job.picture), "tree": str(job.folder / TREE_FILE)}

    def add(self, job: Job, record: Record, fingerprint: Record | None = None) -> None:
        """Note a finished picture. Raises OutputError."""
        if self.path is None or job.folder is None or "error" in record:
            return
        entry = record | {"folder": job.folder.name, "source": _identity(job.picture)}
        entry["fingerprint"] = job.settings.fingerprint(job.picture) if fingerprint is None else fingerprint
        add_line(self.path, json.dumps(entry))
        self.entries[job.folder.name] = entry


def forgo_torchscript() -> None:
    """For a search or a fit, before PyTorch loads, here and in processes started from here.

    PyTorch compiles a table of derivatives that is not used here, for half a second, when forward-mode differentiation begins, unless
    TorchScript is off; and it must not be off where networks draw codes.
    """
    if "torch" not in sys.modules:
        os.environ["PYTORCH_JIT"] = "0"


def limit_threads() -> None:
    """One thread of arithmetic in this process: sums come in one order, so results do not depend on the cores or the workers."""
    import torch

    torch.set_num_threads(1)


def decompose_picture(job: Job, on_step: Callable[[Step], None] | None = None) -> Record:
    """Read, decompose and write one picture. A failure comes back as a record with ``error``, so that the rest goes on."""
    try:
        return _decompose_picture(job, on_step)
    except UnshadeError as error:
        return failure(job.picture, str(error), error.exit_code)
    except Exception as error:  # noqa: BLE001 - one picture must not end the batch, and the record names the error
        if os.environ.get("UNSHADE_DEBUG"):
            traceback.print_exc()
        return failure(job.picture, f"unexpected {type(error).__name__}: {error}", 1)


def _decompose_picture(job: Job, on_step: Callable[[Step], None] | None) -> Record:
    limit_threads()
    begin, settings, sphere = time.perf_counter(), job.settings, _read(job)
    from unshade.decompose import decompose
    from unshade.threads import threads

    with threads(job.threads):
        decomposition = decompose(
            sphere,
            preset=settings.preset,
            max_values=settings.max_values,
            seed=settings.seed,
            alternatives=settings.alternatives,
            search=settings.search,
            objective=settings.objective,
            method=settings.method,
            second_stage=settings.second_stage,
            weights=settings.weights,
            reflections=settings.reflections,
            device=settings.device,
        )
    for step in decomposition:
        if on_step:
            on_step(step)
    return _written(job, decomposition.result(), sphere, begin)


def fit_picture(job: Job, tree: Tree, locked: Sequence[str], anew: bool = False) -> Record:
    """Read a picture, fit the parameters of a given tree to it (see `decompose.fit`), and write the result. Raises UnshadeError."""
    limit_threads()
    begin, sphere = time.perf_counter(), _read(job)
    from unshade.decompose import fit

    return _written(job, fit(sphere, tree, locked=locked, seed=job.settings.seed, anew=anew), sphere, begin)


def _read(job: Job) -> SphereImage:
    from unshade.models import perceptual
    from unshade.pictures import read_sphere

    if job.settings.perceptual:
        # Missing weights are told before the work, not after it.
        perceptual.weight_file()
    return read_sphere(job.picture, disc=job.settings.disc, ignore=Path(job.settings.mask) if job.settings.mask else None)


def _written(job: Job, result: Result, sphere: SphereImage, begin: float) -> Record:
    from unshade import artifacts

    shown = artifacts.figures(result, sphere, job.settings.perceptual)
    shown["seconds"] = round(time.perf_counter() - begin, 3)
    shown["stages"] = stages_words(result.stages)
    tree = artifacts.write(result, sphere, job.folder, job.settings.artifacts, job.picture.name, shown) if job.folder else None
    shown["seconds"] = round(time.perf_counter() - begin, 3)
    record = {"input": str(job.picture), "tree": str(tree) if tree else None, **shown}
    record = {key: record[key] for key in RECORD_KEYS}
    return record | {"stages": result.stages} if result.stages else record


def stages_words(stages: Record | None) -> str:
    """Who made a tree, of `learned.Stages` as a dictionary; nothing where no network was asked."""
    if not stages:
        return ""
    if stages["why"]:
        return f"decomposed by {stages['method']} alone, since {stages['why']}"
    if stages.get("uncovered"):
        return "the tree of what lies beneath a reflection, in the place of the networks'"
    nodes, left = stages["nodes"], stages["second_stage_nodes"]
    found = left < nodes
    if stages["method"] == "hybrid":
        if stages.get("tree_of") == "networks":
            return f"networks proposed the tree, {nodes - left} of {nodes} nodes; the search finished it"
        return "the search's own tree; " + ("those that networks proposed are not better" if found else "the networks found nothing")
    if stages.get("second_stage") == "none":
        return (
            f"left over: {left} of {nodes} nodes, one colour each" if found else "left over: the whole picture, the networks found nothing"
        )
    return f"second stage: {left} of {nodes} nodes" if found else "second stage: the whole picture, the networks found nothing"


def failure(picture: Path, message: str, exit_code: int) -> Record:
    """The record of a picture that failed, in one line that names it."""
    message = " ".join(message.split())
    if str(picture) not in message:
        message = f"{picture}: {message}"
    return {"input": str(picture), "error": message, "exit_code": exit_code}


def run(jobs: Sequence[Job], workers: int, work: Callable[[Job], Record] = decompose_picture) -> Generator[tuple[Job, Record]]:
    """Do the jobs on ``workers`` processes and yield each with its record as it is done, in any order."""

    def lost(job: Job, code: int | None) -> Record:
        return failure(job.picture, f"the process working on it ended with code {code} (out of memory?)", 1)

    def abandoned(job: Job) -> None:
        if job.folder is not None:
            discard(job.folder)

    yield from crew.run(jobs, workers, work, lost, abandoned)


class InOrder:
    """Hands records on in the order of their pictures, each as soon as those before it are there."""

    def __init__(self, jobs: Sequence[Job], hand_on: Callable[[Record], None]) -> None:
        self.jobs, self.hand_on, self.next = jobs, hand_on, 0
        self.waiting: dict[Job, Record] = {}

    def add(self, job: Job, record: Record) -> None:
        """Take the record of a picture, at any time."""
        self.waiting[job] = record
        while self.next < len(self.jobs) and self.jobs[self.next] in self.waiting:
            self.hand_on(self.waiting.pop(self.jobs[self.next]))
            self.next += 1

    def flush(self) -> None:
        """Hand on what is left when the run was cut short."""
        for job in [job for job in self.jobs if job in self.waiting]:
            self.hand_on(self.waiting.pop(job))
