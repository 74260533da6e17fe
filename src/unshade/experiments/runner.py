"""Runs the parts, one after the other, and writes documents, figures and the page after each."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from unshade import crew
from unshade.bench.report import machine, versions
from unshade.errors import MissingExtraError, OutputError, UnshadeError, did_you_mean
from unshade.experiments import addition, methods, plots, sheets
from unshade.experiments.jobs import Work
from unshade.experiments.options import Options
from unshade.experiments.page import page
from unshade.experiments.parts import PARTS, Context, Document
from unshade.files import write_whole
from unshade.models import perceptual

FORMAT = 1
"""Of the documents; one of another is not put on the page."""


@dataclass
class Ran:
    """What a run came to."""

    documents: dict[str, Document] = field(default_factory=dict)
    """Of the parts that ran now."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Method or measure -> why it was left out."""
    failed: list[str] = field(default_factory=list)


def run(options: Options, console: Console | None = None) -> Ran:
    """Run the parts that are asked for.

    An interrupt keeps all that is measured; a later call goes on there.

    Raises:
        UnshadeError: an unknown part or method, nothing that can run, or an output that cannot be written.
        KeyboardInterrupt: it was interrupted.
    """
    console = console or Console(stderr=True)
    ran = Ran()

    def tell(text: str) -> None:
        console.print(text, markup=False, highlight=False, soft_wrap=True)

    for part in options.parts:
        if part not in PARTS:
            raise UnshadeError(f"unknown experiment {part!r}{did_you_mean(part, PARTS)}")
    able = []
    for method in dict.fromkeys(options.methods):
        why = methods.missing(method, options.weights)
        if why is None:
            able.append(method)
        else:
            ran.skipped[method] = why
    if not able:
        raise UnshadeError(f"no method can run; {'; '.join(f'{name}: {why}' for name, why in ran.skipped.items()) or 'none was asked for'}")
    measured = _perceptual(options, ran)
    for name, why in ran.skipped.items():
        tell(f"skipped {name}: {why}")
    earlier = {part: _earlier(options, part) for part in options.parts}
    work = Work(options.journal, options.workers or crew.cores(), options.resume, console)
    for part in options.parts:
        tell(f"{part}: {', '.join(able)}")
        context = Context(options, able, work.measure, measured)
        before = len(work.failed)
        document, rows = PARTS[part](context)
        failed = work.failed[before:]
        for what in [*(f"skipped {name}: {why}" for name, why in context.skipped.items()), *(f"failed: {what}" for what in failed)]:
            tell(what)
        head = _head(options, part) | {"machine": machine(), "versions": versions(), "weights": methods.cards(iter(able), options.weights)}
        head |= {"skipped": ran.skipped | context.skipped, "failed": failed}
        old = earlier[part]
        ran.documents[part], kept = addition.added(head | document, old) if old is not None else (head | document, [])
        ran.failed += failed
        _write(options.results / f"{part}.json", _lines(ran.documents[part]))
        if part in sheets.SHEETS and kept:
            tell(f"not drawn: {part}.png; trees of {', '.join(kept)} are not in the earlier document")
        elif part in sheets.SHEETS:
            sheets.SHEETS[part](options, rows)
        _draw(lambda part=part: _plot(options, part, ran.documents[part]), tell)  # type: ignore[misc]
        _learning(options, tell)
        write_page(options)
    return ran


def _head(options: Options, part: str) -> Document:
    return {"format": FORMAT, "part": part, "seed": options.seed, "limit": options.limit}


def _earlier(options: Options, part: str) -> Document | None:
    """What is there of a part. Raises UnshadeError where nothing can be added to it."""
    path = options.results / f"{part}.json"
    if not options.add or not path.is_file():
        return None
    try:
        old: Document = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UnshadeError(f"{path} is not JSON ({error}); leave out --add to measure anew") from None
    addition.check(old, _head(options, part), str(path))
    return old


def _lines(document: Document) -> str:
    """JSON with a line for each entry of a list, so that thousands of rows are not a hundred thousand lines."""
    fields = []
    for name, value in document.items():
        text = "[\n" + ",\n".join(json.dumps(entry) for entry in value) + "\n]" if isinstance(value, list) and value else json.dumps(value)
        fields.append(f"{json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(fields) + "\n}\n"


def _perceptual(options: Options, ran: Ran) -> bool:
    """Whether st_lpips is measured."""
    if not options.perceptual:
        return False
    try:
        perceptual.weight_file()
    except MissingExtraError as error:
        ran.skipped["st_lpips"] = str(error)
        return False
    return True


def _plot(options: Options, part: str, document: Document) -> None:
    if part == "anytime":
        plots.anytime(document, options.figures / "anytime.png")
    if part == "robustness":
        plots.robustness(document, options.figures / "robustness.png")
        plots.size(document, options.figures / "size.png")


def _learning(options: Options, tell: Callable[[str], None]) -> None:
    """Keep the logs of a training run, and draw those that are kept."""
    kept = options.results / "learning"
    if options.training is not None:
        kept.mkdir(parents=True, exist_ok=True)
        for log in sorted(options.training.glob("*/log.jsonl")):
            shutil.copyfile(log, kept / f"{log.parent.name}.jsonl")
    if kept.is_dir():
        _draw(lambda: plots.learning(kept, options.figures / "learning.png"), tell)


def _draw(draw: Callable[[], object], tell: Callable[[str], None]) -> None:
    try:
        draw()
    except MissingExtraError as error:
        tell(f"not drawn: {error}")


def write_page(options: Options) -> None:
    """The page of all documents that there are, whenever they were made. Raises OutputError."""
    paths = [options.results / f"{part}.json" for part in PARTS]
    documents = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths if path.is_file()}
    current = {part: document for part, document in documents.items() if document.get("format") == FORMAT}
    _write(options.page, page(options, current))


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be made: {error.strerror or error}") from None
    write_whole(path, text.encode())
