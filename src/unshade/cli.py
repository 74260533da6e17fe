"""The command line: thin verbs over the package. Heavy modules load inside the verbs that need them, so ``--help`` is quick."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import signal
import sys
import traceback
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from unshade import __version__, batch, cli_extract, cli_verbs, crew
from unshade.arguments import SEED, check_networks, network_options, output_options, read_document, read_tree
from unshade.errors import TreeError, UnshadeError
from unshade.staging import check_folder

if TYPE_CHECKING:
    from unshade.terminal import Messages

EXIT_CODES = """\b
Exit codes:
  0    done
  1    an error that has no code of its own
  2    the command line was not understood
  3    a picture cannot be used
  4    a tree cannot be used
  5    an output cannot be written
  6    an optional library or weight file is missing
  7    some of several pictures failed; the others are done
  130  interrupted; what was done is kept
  141  the program that read the output went away"""

SOME_FAILED, INTERRUPTED, PIPE_CLOSED = 7, 130, 141


class PipeClosed(Exception):  # noqa: N818 - nobody's mistake
    """The program that read standard output went away; click would take a BrokenPipeError for a general failure."""


class Verbs(click.Group):
    """Loads the benchmark's command only where it is run, since it comes with PyTorch."""

    def invoke(self, ctx: click.Context) -> Any:
        """As click has it, but a closed pipe can be told apart."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise PipeClosed from error

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """As click has it."""
        name, command, rest = super().resolve_command(ctx, args)
        if command is bench:
            from unshade.bench.command import command
        return name, command, rest


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=EXIT_CODES,
    invoke_without_command=True,
    subcommand_metavar="COMMAND [ARGS]...",
)
@click.version_option(__version__, prog_name="unshade")
@click.pass_context
def cli(context: click.Context) -> None:
    """One picture of a shaded sphere in, an editable shade tree out.

    A TREE is a file (tree.json, or one line of text), a folder that holds a tree.json, a tree's text such as
    "multiply(albedo(#cc2030), diffuse(left up))", or - for standard input.

    \b
    Examples:
      unshade decompose ball.png -o out
      unshade show out/ball
      unshade render out/ball -o big.png --size 1024
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@cli.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="IMAGE...")
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Where the results go, a folder a picture.")
@click.option(
    "--preset",
    type=click.Choice(["draft", "balanced", "best"]),
    default="balanced",
    show_default=True,
    help="Up to 30, 64 or 160 values; about 0.3, 2 or 10 seconds of one core a picture.",
)
@click.option("--max-values", type=click.IntRange(3), metavar="N", help="Largest tree, in stored values, instead of the preset's.")
@click.option(
    "--alternatives",
    type=click.IntRange(1, 20),
    default=1,
    show_default=True,
    metavar="K",
    help="Structurally different trees of one size.",
)
@click.option(
    "--search",
    type=click.Choice(["size", "depth"]),
    default="size",
    show_default=True,
    help="Grow by size, or level by level as the paper.",
)
@click.option(
    "--objective",
    type=click.Choice(["l2", "paper"]),
    default="l2",
    show_default=True,
    help="Of the search by depth: pixels alone, or the paper's L2 plus VGG features, a hundred times slower; needs the perceptual extra.",
)
@network_options
@click.option(
    "--workers",
    type=click.IntRange(1),
    metavar="N",
    help="Processes for several pictures; for one, threads of its networks and processes for its fits; all cores when not given.",
)
@click.option("--resume/--force", default=True, help="Skip pictures that are done with the same settings (the default), or do them again.")
@output_options
def decompose(
    images: tuple[Path, ...],
    output: Path | None,
    workers: int | None,
    resume: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Turn pictures of shaded spheres into shade trees.

    IMAGE is a picture (PNG, JPEG, WebP, TIFF, EXR, HDR and others) or a folder of pictures. Each gets a folder
    DIR/NAME with tree.json (the tree, smaller and larger ones, and alternatives), render.png, difference.png (four
    times brighter than it is), layers/ (one picture a node), family/, alternatives/, tree.svg and report.html, a page
    that opens offline. DIR/results.jsonl notes what is done, so that a later call goes on where this one stopped.

    With --json every picture is one line with the keys input, tree (path), psnr, ssim, st_lpips (null without
    --perceptual), values, leaves, seconds and seed; a picture that failed has input, error and exit_code. With --method
    learned or hybrid it also has stages: the nodes that the networks decomposed, the share that reached the second
    stage and why, and what each stage took; a line for a person and the page say it in words.

    \b
    Examples:
      unshade decompose ball.png -o out
      unshade decompose matcaps/ -o out --preset draft --artifacts tree --json > figures.jsonl
      unshade decompose photo.jpg -o out --disc 412,300,220 --mask hand.png
      unshade decompose ball.png -o out --method learned --json
      unshade decompose chrome.png -o out --reflections picture
    """
    from unshade.terminal import Messages

    settings, folder = _settings(output, options)
    if settings.method == "search":
        batch.forgo_torchscript()
    messages = Messages(quiet, bars=not (as_json and sys.stdout.isatty()))
    pictures = batch.find_pictures(images)
    log = batch.Log(folder)
    names = batch.assign_folders(pictures, log)
    jobs = [batch.Job(picture, folder / name if folder else None, settings) for picture, name in zip(pictures, names, strict=True)]
    printed = batch.InOrder(jobs, lambda record: click.echo(json.dumps(record)) if as_json else None)
    done = {job: record for job in jobs if resume and (record := log.finished(job))}
    for job, record in done.items():
        _tell(record, messages, "done before  ")
        printed.add(job, record)
    workers = workers or crew.cores()
    todo = [job for job in jobs if job not in done]
    todo = [dataclasses.replace(job, threads=max(workers // len(todo), 1)) for job in todo]
    failures = []
    try:
        with contextlib.closing(_decomposed(todo, workers, messages)) as records:
            for job, record in records:
                log.add(job, record)
                _tell(record, messages)
                printed.add(job, record)
                failures += [record] if "error" in record else []
    finally:
        printed.flush()
    if len(jobs) > 1:
        messages.say(f"{len(jobs)} pictures: {len(todo) - len(failures)} done, {len(done)} done before, {len(failures)} failed")
    if failures:
        raise click.exceptions.Exit(SOME_FAILED if len(jobs) > 1 else failures[0]["exit_code"])


def _settings(output: Path | None, options: dict[str, Any]) -> tuple[batch.Settings, Path | None]:
    """The settings, and the folder to write into unless nothing is to be written. Raises UsageError, OutputError."""
    check_networks(options)
    settings = batch.Settings(**options)
    if settings.artifacts == "none":
        return settings, None
    if output is None:
        raise click.UsageError("-o DIR is missing (or --artifacts none to write nothing)")
    check_folder(output)
    return settings, output


def _tell(record: batch.Record, messages: Messages, before: str = "") -> None:
    """One line about a picture."""
    from unshade.terminal import figures_line

    if "error" in record:
        messages.fail(record["error"])
    else:
        folder = Path(record["tree"]).parent if record["tree"] else None
        page = folder / "report.html" if folder else None
        where = f"  {page if page and page.exists() else folder}" if folder else ""
        if said := batch.stages_words(record.get("stages")):
            messages.say(f"{record['input']}: {said}", "dim" if before else "")
        messages.say(f"{record['input']}: {before}{figures_line(record)}{where}", "dim" if before else "")


def _decomposed(jobs: Sequence[batch.Job], workers: int, messages: Messages) -> Generator[tuple[batch.Job, batch.Record]]:
    """The jobs with their records as they are done; a single one in this process, with a bar over its steps."""
    if len(jobs) == 1:
        with messages.steps(jobs[0].picture.name) as on_step:
            record = batch.decompose_picture(jobs[0], on_step)
        yield jobs[0], record
    elif jobs:
        with messages.pictures(len(jobs)) as advance, contextlib.closing(batch.run(jobs, workers)) as records:
            for job, record in records:
                advance()
                yield job, record


@cli.command()
@click.argument("image", type=click.Path(path_type=Path), metavar="IMAGE")
@click.option("--structure", metavar="TEXT", help="The tree's text; its values are one of several starts of the fit.")
@click.option("--from", "source", metavar="TREE", help="A tree to start from.")
@click.option("--lock", multiple=True, metavar="ADDRESS", help="A node that keeps its values; may be repeated.")
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Where the result goes.")
@output_options
def fit(
    image: Path,
    structure: str | None,
    source: str | None,
    lock: tuple[str, ...],
    output: Path | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Fit only the parameters of a given tree to a picture; its structure stays.

    Writes DIR/NAME and prints as `decompose` does.

    \b
    Examples:
      unshade fit ball.png --structure "screen(multiply(albedo(), diffuse()), highlight())" -o out
      unshade fit ball2.png --from out/ball --lock screen.1.highlight -o out
    """
    from unshade.terminal import Messages

    if (structure is None) == (source is None):
        raise click.UsageError("give either --structure TEXT or --from TREE")
    batch.forgo_torchscript()
    tree = read_tree(structure, text_only=True) if structure is not None else read_tree(str(source))
    settings, folder = _settings(output, options)
    log = batch.Log(folder)
    job = batch.Job(image, folder / batch.assign_folders([image], log)[0] if folder else None, settings)
    record = batch.fit_picture(job, tree, lock, anew=structure is not None)
    log.add(job, record, fingerprint={"fit": structure or source})
    _tell(record, Messages(quiet))
    if as_json:
        click.echo(json.dumps(record))


@cli.command()
@click.argument("tree")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), metavar="IMG", help="PNG, JPEG, WebP, TIFF or EXR by its suffix."
)
@click.option(
    "--size", type=click.IntRange(1, 8192), default=256, show_default=True, metavar="N", help="Width and height of the sphere in pixels."
)
@click.option("--normals", type=click.Path(path_type=Path), metavar="FILE", help="A normal map to shade instead of a sphere.")
@cli_extract.GREEN
@click.option("--part", type=click.Choice(["diffuse", "specular"]), help="Only form and paint, or only highlights, rims and reflections.")
def render(tree: str, output: Path, size: int, normals: Path | None, green: str, part: str | None) -> None:
    """Draw a tree as a sphere of any size, or over a normal map.

    \b
    Examples:
      unshade render out/ball -o big.png --size 1024
      unshade render out/ball -o diffuse.png --part diffuse
      unshade render "multiply(albedo(#cc2030), diffuse(left up))" -o shaded.png --normals vase_normals.png
    """
    from unshade.render import part as part_of

    found = read_tree(tree)
    if part:
        found = dataclasses.replace(found, root=part_of(found.root, part))
    cli_extract.draw(found, output, size, normals, green)


@cli.command()
@click.argument("tree")
def show(tree: str) -> None:
    """Print a tree in colour: the address, name and values of each node.

    \b
    Examples:
      unshade show out/ball
      unshade show "screen(albedo(#202020), highlight(right up))"
    """
    from unshade.terminal import show_lines, tree_in_colour

    show_lines(tree_in_colour(read_tree(tree)))


@cli.command()
@click.argument("tree")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def info(tree: str, as_json: bool) -> None:
    """Size, kinds, text and family of a tree.

    \b
    Examples:
      unshade info out/ball
      unshade info out/ball --json
    """
    from unshade.summary import summary, summary_lines

    found = summary(*read_document(tree))
    click.echo(json.dumps(found) if as_json else "\n".join(summary_lines(found)))


@cli.command()
@click.argument("first", metavar="A")
@click.argument("second", metavar="B")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def diff(first: str, second: str, as_json: bool) -> None:
    """Compare two trees: nodes, values, distance, and the PSNR between their pictures.

    Children of multiply and screen are compared in any order. The exit code is 0 also where the trees differ.

    \b
    Examples:
      unshade diff out/ball out/ball-edited.json
      unshade diff a.json b.json --json
    """
    from unshade.summary import comparison, comparison_lines

    found = comparison(read_tree(first), read_tree(second))
    click.echo(json.dumps(found) if as_json else "\n".join(comparison_lines(found)))


@cli.command()
@click.argument("trees", nargs=-1, required=True, metavar="TREE...")
def validate(trees: tuple[str, ...]) -> None:
    """Check that trees can be read and obey the grammar.

    Prints one line a tree. The exit code is 4 when any is wrong.

    \b
    Examples:
      unshade validate out/*/tree.json
    """
    from unshade.terminal import Messages

    wrong = False
    for tree in trees:
        try:
            found = read_tree(tree)
            click.echo(f"{tree if len(tree) <= 80 else tree[:77] + '...'}: good, {found.values} values, {found.leaves} leaves")
        except UnshadeError as error:
            wrong = True
            Messages().fail(str(error))
    if wrong:
        raise click.exceptions.Exit(TreeError.exit_code)


@cli.command()
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Where NAME.json and NAME.png go; without it the trees are printed as text.",
)
@click.option("--count", type=click.IntRange(1, 1_000_000), default=1, show_default=True, metavar="N", help="How many trees.")
@click.option(
    "--style", type=click.Choice(["realistic", "toon"]), default="realistic", show_default=True, help="Which leaves to draw from."
)
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="The same seed gives the same trees.")
@click.option("--size", type=click.IntRange(8, 4096), default=256, show_default=True, metavar="N", help="Width and height of the pictures.")
def sample(output: Path | None, count: int, style: str, seed: int, size: int) -> None:
    """Draw random trees from the grammar, with their pictures.

    \b
    Examples:
      unshade sample
      unshade sample -o trees --count 100 --style toon --seed 7
    """
    import torch

    from unshade import artifacts, grammar
    from unshade.serde import to_text

    if output is not None:
        check_folder(output)
    generator = torch.Generator().manual_seed(seed)
    for number in range(count):
        tree = grammar.sample(generator, style)
        if output is None:
            click.echo(to_text(tree))
        else:
            artifacts.write_sample(tree, output, f"{number:0{len(str(count - 1))}d}", size)


@cli.command(add_help_option=False)
def bench() -> None:
    """Measure data sets x methods and write the results."""
    raise AssertionError("`Verbs` puts the real command in the place of this one")


for _verb in cli_verbs.VERBS:
    cli.add_command(_verb)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code; every failure is one line on standard error."""
    try:
        code = cli.main(arguments, prog_name="unshade", standalone_mode=False)
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except click.UsageError as error:
        where = f"{error.ctx.command_path} --help" if error.ctx else "unshade --help"
        return _fail(f"{' '.join(error.format_message().split()).rstrip('.')} (see {where})", error.exit_code)
    except UnshadeError as error:
        return _fail(str(error), error.exit_code)
    except click.ClickException as error:
        return _fail(error.format_message(), error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted; what was done is kept", INTERRUPTED)
    except (PipeClosed, BrokenPipeError):
        # Python would complain once more when it flushes at its end, so what is left goes nowhere.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except Exception as error:  # noqa: BLE001 - the last line of defence: a person gets a sentence, UNSHADE_DEBUG=1 the traceback
        return _fail(f"unexpected {type(error).__name__}: {error} (UNSHADE_DEBUG=1 shows where)", 1)


def _fail(message: str, code: int) -> int:
    if os.environ.get("UNSHADE_DEBUG"):
        traceback.print_exc()
    click.echo(f"{click.style('unshade: error:', fg='red', bold=True)} {message}", err=True)
    return code


def main() -> None:
    """Entry point of the command ``unshade``."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal or a pipe that cannot show a letter shows a question mark.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # Before numpy and torch load: one thread, so that no result depends on the cores.
    os.environ.update(OMP_NUM_THREADS="1", MKL_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    code = run()
    # A late Ctrl-C would only put a traceback below what was said already.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(code)
