"""The report page in a real browser."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from unshade import drawing
from unshade.serde import loads_family

PATIENCE = 60.0
"""Seconds to wait for an answer."""

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
            assert select.select([self.read], [], [], PATIENCE)[0], "the browser does not answer"
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
def report(made: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(made.balanced_page(), encoding="utf-8")
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
def test_the_standalone_drawing_opens(made: SimpleNamespace, chromium: Browser, tmp_path: Path) -> None:
    path = tmp_path / "tree.svg"
    path.write_text(drawing.tree_svg(made.everything(), title="A <tree>"), encoding="utf-8")
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


@pytest.mark.browser
def test_a_tree_of_the_usual_size_is_seen_whole(chromium: Browser, made: SimpleNamespace, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(made.page(made.outcome([made.grown(11)], 0)), encoding="utf-8")
    chromium.call("Emulation.setDeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=1, mobile=False)
    try:
        chromium.visit(tmp_path / "report.html")
        frame, drawn = chromium.ask(
            "['.drawn', '.drawn .shade-tree'].map(s => document.querySelector(s).getBoundingClientRect()).map(b => [b.left, b.right])"
        )
        assert 0 <= frame[0] <= drawn[0] < drawn[1] <= frame[1] <= 1280
        assert drawn[1] - drawn[0] > 1100
        assert chromium.ask("document.documentElement.scrollWidth") <= 1280
    finally:
        chromium.call("Emulation.clearDeviceMetricsOverride")
