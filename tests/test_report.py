"""The report page: what is in it, and what a real browser does with it."""

from __future__ import annotations

import base64
import contextlib
import html
import io
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image as PillowImage

from unshade import drawing
from unshade.nodes import Family, Leaf, Member, Operator, Raster, Tree, leaf, mix, multiply, screen
from unshade.pictures import Disc, SphereImage
from unshade.render import render
from unshade.report import BUDGET, report_html
from unshade.serde import dumps, loads_family, to_text
from unshade.sphere import disc_mask, sphere_normals

SIZE = 128
FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--disable-default-apps",
    "--mute-audio",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
]


@dataclass(frozen=True)
class Outcome:
    """What the report needs of a `decompose.Result`."""

    tree: Tree
    family: Family
    psnr: float
    seed: int
    preset: str


def light(index: int, name: str | None = None) -> Operator:
    turn = torch.tensor(2.4 * index)
    towards = (float(turn.cos()), float(turn.sin()), 0.8)
    return multiply(
        leaf("albedo", color=(0.9, 0.7 - 0.015 * index, 0.4)), leaf("highlight", direction=towards, sharpness=12.0 + 8.0 * index), name=name
    )


def grown(lights: int, name: str | None = None) -> Tree:
    base = multiply(leaf("albedo", color=(0.75, 0.25, 0.15)), leaf("diffuse", direction=(-0.5, 0.7, 0.6), ambient=0.15))
    return Tree(screen(base, *[light(index, name if index == 0 else None) for index in range(lights)]) if lights else base)


def everything() -> Tree:
    """A tree with every role and every type of parameter."""
    paint = mix(
        leaf("albedo", color=(0.7, 0.3, 0.2)),
        leaf("image", pixels=Raster.from_array(torch.full((3, 4, 4), 0.4))),
        leaf("stripe", width=0.5, softness=0.1),
    )
    sky = leaf("environment_map", pixels=Raster.from_array(torch.rand(3, 4, 8, generator=torch.Generator().manual_seed(1)) * 0.3))
    lamps = leaf("environment", direction=(0, 1, 1, 1, 0, -0.2), sharpness=(5, 20), color=(0.2, 0.3, 0.5, 0.4, 0.1, 0.1))
    return Tree(screen(multiply(paint, leaf("toon_diffuse")), light(1), leaf("toon_highlight", name="sun"), leaf("rim"), lamps, sky))


def outcome(members: list[Tree], chosen: int, alternatives: tuple[Tree, ...] = ()) -> tuple[Outcome, SphereImage]:
    """A family that grows towards a picture which its last member draws perfectly but for a little noise."""
    noise = torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) * 0.02
    picture = (render(members[-1], sphere_normals(SIZE)) + noise).clamp(0.0, 1.0)
    inside = disc_mask(SIZE)

    def member(tree: Tree) -> Member:
        error = (render(tree, sphere_normals(SIZE)) - picture)[:, inside[0]].square().mean()
        return Member(tree, float(-10.0 * error.log10()))

    family = Family(tuple(map(member, members)), chosen, tuple(map(member, alternatives)))
    best = family.members[chosen]
    return Outcome(best.tree, family, best.psnr, 7, "balanced"), SphereImage(picture, inside, Disc(SIZE / 2, SIZE / 2, SIZE / 2, 1.0))


@lru_cache(maxsize=1)
def balanced() -> tuple[Outcome, SphereImage]:
    return outcome([grown(lights) for lights in range(10)], 8, (everything(), grown(8, "other")))


def page(found: tuple[Outcome, SphereImage], name: str = "sphere.png", **figures: Any) -> str:
    return report_html(found[0], found[1], name, {"psnr": found[0].psnr, "ssim": 0.9713, "seconds": 1.234, **figures})  # type: ignore[arg-type]


@lru_cache(maxsize=1)
def balanced_page() -> str:
    return page(balanced())


class Reader(HTMLParser):
    """The elements of a page, and whether they nest."""

    VOID = frozenset({"meta", "link", "img", "input", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> does not close what is open"

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


def test_the_page_nests_and_asks_for_nothing_outside() -> None:
    text = balanced_page()
    read = Reader(text)
    assert read.open == []
    addresses = [value for _, attributes in read.found for key, value in attributes.items() if key in ("src", "href")]
    assert len(addresses) > 100
    assert all(address and address.startswith(("data:", "#")) for address in addresses)
    assert "@import" not in text and "url(http" not in text
    assert "default-src 'none'" in text
    assert not re.search(r"\{\{\w+\}\}", text)


def test_a_balanced_page_is_small_and_made_at_once() -> None:
    found = balanced()
    page(found)
    start = time.process_time()
    text = page(found)
    assert time.process_time() - start < 3.0, "a second on a free machine; three on a busy one"
    assert len(text.encode()) < 1_500_000


def test_a_large_family_stays_within_the_budget() -> None:
    members = [grown(lights) for lights in range(1, 40)]
    text = page(outcome(members, 20))
    shown = set(re.findall(r'<template data-sheet="([\w-]+)"', text))
    assert len(text) < BUDGET + 700_000
    assert {"tree-19", "tree-21"} <= shown, "the neighbours of the chosen tree come first"
    assert text.count('class="shut"') == len(members) - 1 - len(shown)


def test_ids_are_unique_and_links_lead_somewhere() -> None:
    read = Reader(balanced_page())
    ids = [attributes["id"] for _, attributes in read.found if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {attributes["href"] for attributes in read.all("use")} <= {f"#{place}" for place in ids}
    labelled = {attributes["aria-labelledby"] for _, attributes in read.found if "aria-labelledby" in attributes}
    assert labelled <= set(ids)


def test_every_leaf_has_a_card_with_its_values() -> None:
    text = page(outcome([everything()], 0))
    body = text.split('<ul class="leaves"')[1].split("</ul>")[0]
    assert body.count('<li class="card"') == 9, "a tinted light is one card, a mask is one"
    for words in ("role-paint", "role-diffuse", "role-highlight", "role-rim", "role-environment", "role-mask", "sun", "tinted highlight"):
        assert words in body
    assert "screen.0.multiply.0.mix.mask" in body
    assert "8 × 4, 96 values" in body
    assert body.count('class="swatch"') == 4, "an albedo, a tint and two lights of the environment"
    assert ">light 2<" in body
    assert 'aria-label="45 degrees up; 101 degrees right"' in body


def test_figures_keep_their_order_and_leave_out_what_is_none() -> None:
    text = page(balanced(), st_lpips=None, values=54, warmth=0.5)
    stats = re.findall(r"<dt>([^<]+)</dt><dd>([^<]+)", text.split('data-slot="figures">')[1].split("</dl>")[0])
    assert [name for name, _ in stats] == ["PSNR", "SSIM", "values", "leaves", "seconds", "preset", "seed", "warmth"]
    assert dict(stats)["seconds"] == "1.23"
    assert dict(stats)["seed"] == "7"


def test_a_perfect_copy_and_a_missing_figure_are_not_numbers() -> None:
    tree = grown(0)
    picture = render(tree, sphere_normals(SIZE))
    perfect = Outcome(tree, Family((Member(tree, float("inf")),), 0), float("inf"), 0, "draft")
    text = report_html(perfect, SphereImage(picture, disc_mask(SIZE), Disc(1, 1, 1, 1.0)), "x", {"psnr": None})  # type: ignore[arg-type]
    assert "∞" in text
    assert "nan" not in re.sub(r"base64,[\w+/=]+", "", text).lower()


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "</template><img src=x onerror=alert(1)>", "a\"b'c&d", "{{input}}", "\x00"])
def test_names_are_text(name: str) -> None:
    found = outcome([grown(0), grown(2, name)], 1)
    text = page(found, name)
    plain = page(outcome([grown(0), grown(2, "plain")], 1), "plain")
    assert [tag for tag, _ in Reader(text).found] == [tag for tag, _ in Reader(plain).found]


def test_the_text_and_the_file_are_the_tree() -> None:
    found = balanced()
    text = page(found, "my sphere.png")
    read = Reader(text)
    link = next(attributes for attributes in read.all("a") if "download" in attributes)
    assert link["download"] == "my_sphere.tree.json"
    stored = base64.b64decode((link["href"] or "").split(",")[1]).decode()
    assert stored == dumps(found[0].family)
    assert loads_family(stored) == found[0].family
    assert to_text(found[0].tree) in html.unescape(text)


def test_ignored_pixels_are_blank_in_the_difference() -> None:
    found, sphere = outcome([grown(1)], 0)
    hole = sphere.valid.clone()
    hole[:, 40:80, 40:80] = False
    holed = SphereImage(sphere.image, hole, sphere.disc)
    opened = []
    for which in (sphere, holed):
        uri = re.search(r'data-picture="difference"><img class="disc" src="data:image/webp;base64,([^"]+)"', page((found, which)))
        assert uri
        alpha = stored_alpha(base64.b64decode(uri[1]))
        opened.append(alpha[60, 60])
    assert opened == [255, 0]


def stored_alpha(data: bytes) -> torch.Tensor:
    picture = PillowImage.open(io.BytesIO(data)).convert("RGBA")
    return torch.tensor(list(picture.tobytes())).reshape(picture.height, picture.width, 4)[..., 3]


# A browser, driven through the pipe of its own debugging protocol: no driver, no port and no package needed.

LAUNCH = """
import fcntl, os, sys
reads, writes = (fcntl.fcntl(int(number), fcntl.F_DUPFD, 10) for number in sys.argv[1:3])
os.dup2(reads, 3)
os.dup2(writes, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


@dataclass
class Browser:
    """One headless Chromium with one page."""

    process: subprocess.Popen[bytes]
    write: int
    read: int
    session: str = ""
    events: list[dict[str, Any]] = field(default_factory=list)
    waiting: bytes = b""
    number: int = 0

    def message(self) -> dict[str, Any]:
        while b"\0" not in self.waiting:
            more = os.read(self.read, 1 << 16)
            assert more, "the browser closed its pipe"
            self.waiting += more
        text, self.waiting = self.waiting.split(b"\0", 1)
        found: dict[str, Any] = json.loads(text)
        return found

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.number += 1
        asked = {"id": self.number, "method": method, "params": parameters} | ({"sessionId": self.session} if self.session else {})
        data = json.dumps(asked).encode() + b"\0"
        while data:
            data = data[os.write(self.write, data) :]
        while True:
            answer = self.message()
            if answer.get("id") == self.number:
                assert "error" not in answer, f"{method}: {answer.get('error')}"
                result: dict[str, Any] = answer["result"]
                return result
            self.events.append(answer)

    def wait_for(self, method: str) -> None:
        while not any(event.get("method") == method for event in self.events):
            self.events.append(self.message())

    def visit(self, path: Path) -> None:
        self.events.clear()
        self.call("Page.navigate", url=path.as_uri())
        self.wait_for("Page.loadEventFired")

    def ask(self, script: str) -> Any:
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def click(self, selector: str) -> None:
        x, y = self.ask(
            f"(() => {{ const e = document.querySelector({selector!r}); e.scrollIntoView({{block: 'center', inline: 'center'}});"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def complaints(self) -> list[str]:
        """Errors and warnings of the console, uncaught exceptions, and every request that is not the page itself."""
        self.ask("new Promise(done => setTimeout(done, 50))")
        found = []
        for event in self.events:
            method, content = event.get("method"), event.get("params", {})
            if method == "Network.requestWillBeSent" and not content["request"]["url"].startswith(("file:", "data:")):
                found.append(f"request: {content['request']['url']}")
            if method == "Runtime.exceptionThrown":
                found.append(f"exception: {content['exceptionDetails']}")
            if method == "Runtime.consoleAPICalled" and content["type"] in ("error", "warning", "assert"):
                found.append(f"console: {content['args']}")
            if method == "Log.entryAdded":
                found.append(f"log: {content['entry']['text']}")
        return found


@pytest.fixture(scope="module")
def chromium(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if sys.platform == "win32":
        pytest.skip("the browser's debugging pipe needs POSIX file descriptors")
    to_browser, ours = os.pipe()
    theirs, from_browser = os.pipe()
    profile = tmp_path_factory.mktemp("profile")
    command = [
        sys.executable,
        "-c",
        LAUNCH,
        str(to_browser),
        str(from_browser),
        browser,
        *FLAGS,
        f"--user-data-dir={profile}",
        "about:blank",
    ]
    with open(profile.parent / "chromium.log", "wb") as log:
        process = subprocess.Popen(command, pass_fds=(to_browser, from_browser), stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    os.close(to_browser)
    os.close(from_browser)
    opened = Browser(process, ours, theirs)
    try:
        target = opened.call("Target.createTarget", url="about:blank")["targetId"]
        opened.session = opened.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            opened.call(f"{domain}.enable")
        yield opened
        opened.session = ""
        with contextlib.suppress(AssertionError, OSError):
            opened.call("Browser.close")
    finally:
        os.close(ours)
        os.close(theirs)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=5)
        if process.poll() is None:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(balanced_page(), encoding="utf-8")
    return path


SHOWN = "document.querySelector('[data-picture=render] img').src"
ABOUT = "document.querySelector('.showing p').textContent"


@pytest.mark.browser
def test_it_opens_without_a_complaint_or_a_request(chromium: Browser, report: Path) -> None:
    chromium.visit(report)
    assert chromium.complaints() == []
    assert chromium.ask("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert chromium.ask("[...document.images].filter(image => !image.hasAttribute('alt')).length") == 0
    assert chromium.ask("performance.getEntriesByType('resource').filter(entry => !entry.name.startsWith('data:')).length") == 0


@pytest.mark.browser
def test_a_request_or_an_error_would_be_noticed(chromium: Browser, tmp_path: Path) -> None:
    path = tmp_path / "bad.html"
    path.write_text("<img src='http://127.0.0.1:9/x.png'><script>console.error('no'); missing()</script>")
    chromium.visit(path)
    kinds = {complaint.split(":")[0] for complaint in chromium.complaints()}
    assert {"request", "console", "exception"} <= kinds


@pytest.mark.browser
@pytest.mark.parametrize("selector", ['.point[data-show="tree-2"]', '.choice[data-show="tree-2"]', '.point[data-show="other-0"]'])
def test_choosing_a_tree_changes_the_page_and_back(chromium: Browser, report: Path, selector: str) -> None:
    chromium.visit(report)
    state = (
        "["
        + SHOWN
        + ", "
        + ABOUT
        + ", ...['.shade-tree', '.leaves', '#line', '.figures', '.parts'].map(s => document.querySelector(s).outerHTML)]"
    )
    before = chromium.ask(state)
    chromium.click(selector)
    after = chromium.ask(state)
    assert all(old != new for old, new in zip(before, after, strict=True))
    assert chromium.ask("document.querySelectorAll('.point[aria-checked=true]').length") == 1
    assert chromium.ask(f"document.querySelector('.wipe img').src === {SHOWN}")
    assert chromium.ask(
        "[...document.querySelectorAll('.leaves use')].every(use => document.getElementById(use.getAttribute('href').slice(1)))"
    )
    chromium.click("#back")
    assert chromium.ask(state) == before
    assert chromium.complaints() == []


@pytest.mark.browser
def test_the_curve_answers_to_the_keyboard(chromium: Browser, report: Path) -> None:
    chromium.visit(report)
    chromium.ask("document.querySelector('.point[tabindex=\"0\"]').focus()")
    first = chromium.ask(ABOUT)
    chromium.press("ArrowLeft")
    second = chromium.ask(ABOUT)
    chromium.press("Home")
    assert chromium.ask(ABOUT).startswith("6 values")
    assert chromium.ask("document.activeElement.dataset.show") == "tree-0"
    assert len({first, second, chromium.ask(ABOUT)}) == 3


@pytest.mark.browser
def test_the_divider_follows_the_pointer_and_the_keyboard(chromium: Browser, report: Path) -> None:
    chromium.visit(report)
    at = "document.querySelector('.wipe').style.getPropertyValue('--at')"
    x, y, width = chromium.ask(
        "(() => { const e = document.querySelector('.wipe input'); e.scrollIntoView({block: 'center'});"
        " const r = e.getBoundingClientRect(); return [r.x, r.y + r.height / 2, r.width]; })()"
    )
    chromium.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + 0.25 * width, y=y)
    assert chromium.ask(at) == "25%"
    chromium.ask("document.querySelector('.wipe input').focus()")
    chromium.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39)
    assert chromium.ask(at) == "26%"


CONTRAST = """
(() => {
  const linear = v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
  const light = text => { const p = text.match(/[\\d.]+/g).slice(0, 3).map(v => linear(v / 255));
    return .2126 * p[0] + .7152 * p[1] + .0722 * p[2]; };
  const behind = e => { const c = getComputedStyle(e).backgroundColor; return /, 0\\)$/.test(c) ? behind(e.parentElement) : c; };
  const worst = [21, ''];
  for (const e of document.querySelectorAll('h1, h2, h3, p, dt, dd, code, figcaption span, .role, button, .button, text, pre')) {
    const style = getComputedStyle(e), ink = light(e.tagName === 'text' ? style.fill : style.color), ground = light(behind(e));
    const ratio = (Math.max(ink, ground) + .05) / (Math.min(ink, ground) + .05);
    if (ratio < worst[0]) { worst[0] = ratio; worst[1] = e.outerHTML.slice(0, 80); }
  }
  return worst;
})()
"""


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_legible_on_a_light_and_a_dark_screen(chromium: Browser, report: Path, scheme: str) -> None:
    chromium.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    try:
        chromium.visit(report)
        ratio, where = chromium.ask(CONTRAST)
        assert ratio >= 4.5, where
        ground = chromium.ask("getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0]")
        assert (int(ground) < 60) == (scheme == "dark")
    finally:
        chromium.call("Emulation.setEmulatedMedia", features=[])


@pytest.mark.browser
@pytest.mark.parametrize("width", [320, 390, 768, 1024, 1920])
def test_nothing_sticks_out_at_any_width(chromium: Browser, report: Path, width: int) -> None:
    chromium.call("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=False)
    try:
        chromium.visit(report)
        assert chromium.ask("document.documentElement.scrollWidth") <= width
        columns = chromium.ask(
            "new Set([...document.querySelectorAll('.pictures figure')].map(f => Math.round(f.getBoundingClientRect().left))).size"
        )
        assert columns == (4 if width > 820 else 2)
    finally:
        chromium.call("Emulation.clearDeviceMetricsOverride")


@pytest.mark.browser
def test_without_scripts_the_chosen_tree_is_there(chromium: Browser, report: Path) -> None:
    chromium.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        chromium.visit(report)
        seen = "(s => { const r = document.querySelector(s).getBoundingClientRect(); return r.width > 0 && r.height > 0; })"
        for selector in ("[data-picture=render] img", "[data-picture=difference] img", ".shade-tree", ".card", "a[download]", "noscript"):
            assert chromium.ask(f"{seen}({selector!r})"), selector
        assert not chromium.ask(f"{seen}('#copy')")
        assert not chromium.ask(f"{seen}('.compare')")
    finally:
        chromium.call("Emulation.setScriptExecutionDisabled", value=False)


@pytest.mark.browser
def test_the_standalone_drawing_opens(chromium: Browser, tmp_path: Path) -> None:
    path = tmp_path / "tree.svg"
    path.write_text(drawing.tree_svg(everything(), title="A <tree>"), encoding="utf-8")
    chromium.visit(path)
    assert chromium.complaints() == []
    assert chromium.ask("document.querySelectorAll('image').length") > 5
    assert chromium.ask("getComputedStyle(document.querySelector('.name')).fontWeight") == "600"


@pytest.mark.browser
def test_the_file_can_be_saved(chromium: Browser, report: Path, tmp_path: Path) -> None:
    chromium.visit(report)
    chromium.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    chromium.click("a[download]")
    saved = tmp_path / "sphere.tree.json"
    for _ in range(100):
        if saved.exists():
            break
        time.sleep(0.05)
    assert len(loads_family(saved.read_text()).members) == 10
    assert chromium.complaints() == []


def test_leaves_in_the_stand_in_are_what_they_should_be() -> None:
    kinds = {node.kind for _, node in everything().walk() if isinstance(node, Leaf)}
    assert {"environment", "environment_map", "image", "stripe", "toon_diffuse", "rim", "albedo"} <= kinds
