"""What holds for the project as a whole: a light import, complete docs, a set-up that pins everything, files of one idea."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest

import unshade

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*.md"), *ROOT.glob("benchmarks/*.md")])
LONGEST = {"src": 400, "scripts": 400, "tests": 650}
"""Lines; the tests of one module stay together."""
LONGER_FILES = {
    "src/unshade/cli.py": ("every verb with its help", 480),
    "src/unshade/sphere_finder.py": ("one search for one circle", 470),
    "src/unshade/nodes.py": ("the table of leaf kinds is part of it", 650),
}


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_is_light() -> None:
    """Counted in modules, not seconds, so that a busy machine does not matter."""
    loaded = run_python("import sys; before = set(sys.modules); import unshade; print('\\n'.join(set(sys.modules) - before))").split()
    heavy = {"torch", "numpy", "PIL", "click", "rich", "cmaes", "matplotlib", "OpenEXR"}
    assert not heavy & {name.partition(".")[0] for name in loaded}
    assert len(loaded) < 60


def test_the_command_answers_without_torch() -> None:
    """`unshade --help` and a typing mistake are answered at once."""
    loaded = run_python("import sys, unshade.cli; print('\\n'.join(sys.modules))").split()
    assert "torch" not in loaded


@pytest.mark.parametrize("name", unshade.__all__)
def test_public_name_exists(name: str) -> None:
    assert getattr(unshade, name) is not None


def test_public_functions_are_not_hidden_by_their_modules() -> None:
    """`unshade.render` is the function whatever was imported before, and the module can still be imported from."""
    for name in ("decompose", "fit", "render"):
        importlib.import_module(f"unshade.{name}")
        assert callable(getattr(unshade, name)), name


def test_unknown_public_name() -> None:
    with pytest.raises(AttributeError, match="nosuch"):
        _ = unshade.nosuch


@pytest.mark.parametrize("name", unshade.__all__)
def test_public_name_is_documented(name: str) -> None:
    assert re.search(rf"`(unshade.)?{re.escape(name)}\b", text_of("docs/api.md")), f"docs/api.md does not explain {name}"


def test_every_leaf_kind_and_parameter_is_in_the_format() -> None:
    from unshade.blend import BLENDS
    from unshade.nodes import KINDS

    page = text_of("docs/tree-format.md")
    built_in = {name: kind for name, kind in KINDS.items() if kind.formula.__module__ == "unshade.shading"}
    assert len(built_in) >= 12
    rows = {cells[1].strip(" `"): cells for line in page.splitlines() if len(cells := line.split("|")) > 4}
    for name, kind in built_in.items():
        assert name in rows, f"docs/tree-format.md has no row for {name}"
        for parameter in kind.parameters:
            entry = re.search(rf"`{parameter.name}` ([^,;|]*)", rows[name][2])
            assert entry, f"{name}.{parameter.name} is not in docs/tree-format.md"
            if parameter.type == "scalar" and parameter.high != 3.141592653589793:
                assert f"{parameter.low:g} to {parameter.high:g}" in entry[1], f"{name}.{parameter.name}: the range has changed"
    for name in BLENDS:
        assert f"`{name}" in page


def test_the_trees_in_the_format_can_be_read() -> None:
    from unshade.serde import dumps, loads

    page = text_of("docs/tree-format.md")
    document = re.findall(r"^```json\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    line = re.findall(r"^screen\(.*\)$", page, re.MULTILINE)[0]
    for text in (document, line):
        tree = loads(text)
        assert loads(dumps(tree)) == tree
        assert unshade.parse(str(tree)) == tree


def test_every_preset_is_in_the_guide() -> None:
    from unshade.presets import PRESETS

    page = text_of("docs/how-to-choose.md")
    for name, preset in PRESETS.items():
        row = re.search(rf"^\| `{name}`.*$", page, re.MULTILINE)
        assert row, f"docs/how-to-choose.md has no row for {name}"
        assert f" {preset.max_values} |" in row[0]


def test_exit_codes_are_in_the_readme() -> None:
    from unshade import errors

    for kind in vars(errors).values():
        if isinstance(kind, type) and issubclass(kind, errors.UnshadeError):
            assert f"\n| {kind.exit_code} |" in text_of("README.md"), kind.__name__


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", document.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_documented_commands_exist(document: Path) -> None:
    from unshade.cli import cli

    assert isinstance(cli, click.Group)
    for block in re.findall(r"^```sh\n(.*?)^```", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        for verb, rest in re.findall(r"^\s*unshade ([a-z]+)(.*)$", block, re.MULTILINE):
            assert verb in cli.commands, f"{document.name}: there is no `unshade {verb}`"
            command = cli.commands[verb]
            if isinstance(command, click.Group) and rest.split()[:1]:
                assert rest.split()[0] in command.commands, f"{document.name}: there is no `unshade {verb} {rest.split()[0]}`"
                command = command.commands[rest.split()[0]]
            known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
            for option in re.findall(r"(?<=\s)--?[a-z][a-z-]*", rest.partition("#")[0]):
                assert option in known, f"{document.name}: `unshade {verb}` has no {option}"


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_the_readme_runs(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.findall(r"^```python\n(.*?)^```", text_of("README.md"), re.MULTILINE | re.DOTALL)[number]
    (tmp_path / "examples").mkdir()
    for picture in (ROOT / "examples").glob("*.png"):
        (tmp_path / "examples" / picture.name).write_bytes(picture.read_bytes())
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    tree = names["tree"] if "tree" in names else unshade.load("red_lacquer.json")
    assert isinstance(tree, unshade.Tree)
    assert tree.values > 3


def test_every_source_file_has_one_idea() -> None:
    for path in sorted([*ROOT.glob("src/**/*.py"), *ROOT.glob("tests/**/*.py"), *ROOT.glob("scripts/*.py")]):
        name = path.relative_to(ROOT).as_posix()
        _, limit = LONGER_FILES.get(name, ("", LONGEST[name.partition("/")[0]]))
        lines = len(path.read_text(encoding="utf-8").splitlines())
        assert lines <= limit, f"{name} has {lines} lines, more than {limit}; split it, or say in LONGER_FILES why not"


def test_longer_files_are_still_long() -> None:
    for name in LONGER_FILES:
        assert len(text_of(name).splitlines()) > LONGEST["src"], f"{name} is short enough now; take it off the list"


def test_version_is_one() -> None:
    assert PROJECT["project"]["version"] == unshade.__version__
    assert f"## {unshade.__version__}" in text_of("CHANGELOG.md")


def test_every_dependency_is_pinned() -> None:
    pinned = dict(re.findall(r"^([a-z0-9-]+)==(\S+)$", text_of("constraints.txt"), re.MULTILINE))
    groups = [PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"].values()]
    for requirement in [entry for group in groups for entry in group]:
        name = re.split(r"[<>=!~\[; ]", requirement)[0].lower().replace("_", "-")
        assert name in pinned, f"constraints.txt does not pin {name}"
    assert pinned["torch"] == "2.13.0"
    assert "torchvision" not in pinned


def test_make_explains_every_target() -> None:
    makefile = text_of("Makefile")
    phony = re.search(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)
    assert phony
    for target in set(phony[1].split()) - {"help", "pytest"}:
        assert f'@echo "make {target} ' in makefile, target
    example = re.search(r"^EXAMPLE \?= (\S+)$", makefile, re.MULTILINE)
    assert example
    assert (ROOT / example[1]).exists()


def test_every_example_says_where_it_comes_from() -> None:
    page = text_of("examples/README.md")
    pictures = sorted(path.name for path in (ROOT / "examples").iterdir() if path.suffix != ".md")
    assert 2 <= len(pictures) <= 3
    for name in pictures:
        row = re.search(rf"^\| `{re.escape(name)}`.*$", page, re.MULTILINE)
        assert row, name
        assert "CC0" in row[0]
