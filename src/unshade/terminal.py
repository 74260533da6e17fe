"""What the command line shows a person: trees in colour, tables, progress. Messages go to standard error."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

if TYPE_CHECKING:
    from rich.tree import Tree as Drawn

    from unshade.decompose import Step
    from unshade.nodes import Leaf, Tree


class Messages:
    """Lines for a person on standard error, above a progress bar where there is a terminal."""

    def __init__(self, quiet: bool = False, bars: bool = True) -> None:
        self.quiet, self.bars = quiet, bars
        self.console = Console(stderr=True, highlight=False)

    def say(self, text: str, style: str = "") -> None:
        """One line, never wrapped."""
        if not self.quiet:
            self.console.print(Text(text, style), soft_wrap=True)

    def fail(self, text: str) -> None:
        """One line that is shown even when quiet."""
        self.console.print(Text.assemble(("unshade: error:", "bold red"), " ", text), soft_wrap=True)

    @contextlib.contextmanager
    def pictures(self, total: int, what: str = "pictures") -> Iterator[Callable[[], None]]:
        """A bar over many pictures, or whatever they are, with the time left; call what it gives after each."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        with self._progress(*columns) as progress:
            task = progress.add_task(what, total=total)
            yield lambda: progress.advance(task)

    @contextlib.contextmanager
    def steps(self, name: str) -> Iterator[Callable[[Step], None]]:
        """A bar over the steps of one decomposition, with how good it is by now."""
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        with self._progress(*columns) as progress:
            task = progress.add_task(name, total=None)

            def show(step: Step) -> None:
                description = f"{name}  {step.stage}  {step.psnr:.1f} dB  {step.values} values"
                progress.update(task, completed=step.done, total=step.total or None, description=description)

            yield show

    def _progress(self, *columns: Any) -> Progress:
        shown = self.bars and not self.quiet and self.console.is_terminal
        # Standard output is left alone: it may be a file or a program, and must not be drawn above the bar.
        return Progress(*columns, console=self.console, transient=True, redirect_stdout=False, redirect_stderr=False, disable=not shown)


def figures_line(record: dict[str, Any]) -> str:
    """``38.21 dB  ssim 0.981  56 values  7 leaves  1.4 s``."""
    parts = [f"{record['psnr']:.2f} dB"]
    parts += [f"ssim {record['ssim']:.4f}"] if record.get("ssim") is not None else []
    parts += [f"st-lpips {record['st_lpips']:.4f}"] if record.get("st_lpips") is not None else []
    return "  ".join([*parts, f"{record['values']} values", f"{record['leaves']} leaves", f"{record['seconds']:.1f} s"])


def tree_in_colour(tree: Tree) -> Drawn:
    """Every node on a line: its address, name and values, and a patch of each colour."""
    from rich.tree import Tree as Drawn

    from unshade.nodes import Leaf, walk

    drawn: dict[str, Drawn] = {}
    for address, node in walk(tree.root):
        head = f"{address} " if address.endswith(".mask") else address.removesuffix(node.kind)
        line = Text.assemble((head, "dim"), (node.kind, "bold cyan" if isinstance(node, Leaf) else "bold"))
        if node.name:
            line.append(f'  "{node.name}"', "yellow")
        if isinstance(node, Leaf):
            line.append_text(_leaf_values(node, tree.blend_space))
        parent = _parent(address)
        drawn[address] = Drawn(line, guide_style="dim") if parent not in drawn else drawn[parent].add(line)
    return drawn[tree.root.kind]


def _parent(address: str) -> str:
    """The address above: ``mix.0.multiply`` is below ``mix``, and so is ``mix.mask``."""
    head, _, last = address.rpartition(".")
    return head if last == "mask" else head.rpartition(".")[0]


def _leaf_values(leaf: Leaf, space: str) -> Text:
    from unshade.labels import direction_words, entries, shown_color, stored
    from unshade.nodes import Raster

    line = Text()
    for parameter, value in stored(leaf):
        line.append(f"  {parameter.name} ", "dim")
        if isinstance(value, Raster):
            line.append(f"{value.width} x {value.height} pixels")
            continue
        found = entries(parameter, value)
        for entry in found[:4]:
            if parameter.type == "color":
                color = shown_color(entry, space)
                line.append("   ", f"on {color}").append(f" {color} ")
            elif parameter.type == "direction":
                line.append(f"{direction_words(entry)} ")
            else:
                line.append(" ".join(f"{part:.4g}" for part in entry) + " ")
        if len(found) > 4:
            line.append(f"and {len(found) - 4} more ")
        line.rstrip()
    return line


def show_lines(drawn: Drawn | Text, out: Console | None = None) -> None:
    """Print on standard output without cutting long lines where it is not a terminal."""
    out = out or Console(highlight=False)
    if not out.is_terminal:
        out.width = 10_000
    out.print(drawn, soft_wrap=isinstance(drawn, Text))
