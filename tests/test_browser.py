"""Every chapter in a real JupyterLab, in a real browser, moved by the keyboard.

Skipped, with a reason, where Chromium or Playwright is missing. The screenshots, each
in the light and in the dark theme, go to build/screenshots: look at them after a change
of a panel.
"""

import json
import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
playwright = pytest.importorskip("playwright.sync_api",
                                 reason="needs Playwright (requirements.txt)")
pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
              pytest.mark.slow]

ROOT = Path(__file__).parents[1]
CHAPTERS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SCREENSHOTS = ROOT / "build" / "screenshots"
FLAGS = """--headless=new --no-sandbox --disable-gpu --no-first-run
--no-default-browser-check --disable-background-networking --disable-component-update
--disable-sync --disable-extensions --disable-dev-shm-usage""".split()
FAULTS = ("[data-mime-type='application/vnd.jupyter.error'], "
          "[data-mime-type='application/vnd.jupyter.stderr']")
# A fault as a kernel sends it ("No such comm": Lab asks for an earlier kernel's panel)
SENT = re.compile(r'"ename": |"name": "stderr", "text": "(?!No such comm)')
LONGEST = 240  # seconds for a chapter


class Lab:
    """A running JupyterLab."""

    def __init__(self, url, token):
        self.url, self.headers = url, {"Authorization": f"token {token}"}
        self.token = token

    def address(self, name):
        return f"{self.url}/lab/tree/notebooks/{name}?token={self.token}&reset"

    def ask(self, path, method="GET"):
        request = urllib.request.Request(self.url + path, headers=self.headers,
                                         method=method)
        with urllib.request.urlopen(request) as answer:
            return answer.read()

    def stop_kernels(self):
        for kernel in json.loads(self.ask("/api/kernels")):
            self.ask(f"/api/kernels/{kernel['id']}", "DELETE")


@pytest.fixture(scope="session")
def lab(tmp_path_factory):
    """A JupyterLab on loopback, with a copy of the book. Yields where it is.

    A copy, since JupyterLab saves what it runs. The theme lies in its settings folder.
    """
    home = tmp_path_factory.mktemp("lab")
    book = home / "book"
    shutil.copytree(ROOT / "notebooks", book / "notebooks")
    films = Path("dnddpg_minimal", "recordings", "films")  # shown by some chapters
    if (ROOT / films).is_dir():
        shutil.copytree(ROOT / films, book / films)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = secrets.token_hex(16)
    folders = ("CONFIG_DIR", "DATA_DIR", "RUNTIME_DIR")
    env = os.environ | {f"JUPYTER_{name}": str(home / name) for name in folders} | {
        "JUPYTERLAB_SETTINGS_DIR": str(home / "settings"),
        "JUPYTERLAB_WORKSPACES_DIR": str(home / "workspaces")}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root",
               "--ip=127.0.0.1", f"--port={port}", "--ServerApp.port_retries=0",
               f"--IdentityProvider.token={token}", f"--ServerApp.root_dir={book}",
               "--LabApp.extension_manager=readonly", "--LabApp.news_url=None"]
    with open(home / "lab.log", "wb") as log:
        server = subprocess.Popen(command, env=env, stdout=log, stderr=log)
    try:
        url = f"http://127.0.0.1:{port}"
        for _ in range(300):
            try:
                urllib.request.urlopen(f"{url}/api?token={token}").close()
                break
            except (urllib.error.URLError, ConnectionError):
                assert server.poll() is None, (home / "lab.log").read_text()
                time.sleep(0.2)
        yield Lab(url, token)
    finally:
        server.terminate()  # it ends its kernels too
        server.wait(30)


@pytest.fixture(scope="session")
def browser():
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def page(browser, lab):
    opened = browser.new_page(viewport={"width": 1300, "height": 1000})
    yield opened
    opened.close()
    lab.stop_kernels()  # closing a page does not


def wait_until(holds, seconds, what):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"after {seconds} s: {what}"
        time.sleep(0.2)


def open_and_run(page, url):
    """Open a chapter, run all its cells, and wait until the kernel rests."""
    page.goto(url)
    page.wait_for_selector("text=| Idle", timeout=120_000)
    page.click(".lm-MenuBar-itemLabel:text-is('Run')")
    page.click(".lm-Menu-itemLabel:text-is('Run All Cells')")
    idle = page.locator("text=| Idle")
    calm, end = 0, time.monotonic() + LONGEST
    while calm < 6:  # between two cells it rests for a moment too
        time.sleep(0.5)
        calm = calm + 1 if idle.count() else 0
        assert time.monotonic() < end, f"still running after {LONGEST} s"


def choose_theme(page, theme):
    """Change to the theme, "Light" or "Dark", by the menu."""
    chosen = f"body[data-jp-theme-light='{str(theme == 'Light').lower()}']"
    if page.locator(chosen).count() == 0:
        page.click(".lm-MenuBar-itemLabel:text-is('Settings')")
        page.hover(".lm-Menu-itemLabel:text-is('Theme')")
        page.click(f".lm-Menu-itemLabel:text-is('JupyterLab {theme}')")
        page.wait_for_selector(chosen, state="attached")
        page.wait_for_selector("#jupyterlab-splash", state="detached")


def faults_heard(page):
    """A list that fills with the errors that the page's kernel sends from now on.

    Lab shows what a cell sends below the cell; what a slider's callback sends it hides
    in its log.
    """
    heard = []

    def listen(frame):
        text = frame if isinstance(frame, str) else frame.decode(errors="replace")
        if found := SENT.search(text):
            heard.append(text[found.start():])

    page.on("websocket", lambda socket: socket.on("framereceived", listen))
    return heard


def scroll_through(page):
    """Lab makes cells when they come into view; a panel exists only then."""
    pane = page.locator(".jp-WindowedPanel-outer").first
    for _ in range(80):
        pane.evaluate("pane => pane.scrollBy(0, 700)")
        time.sleep(0.1)
        if pane.evaluate("p => p.scrollTop + p.clientHeight >= p.scrollHeight - 5"):
            break


def panels(page):
    """The panels on the page: boxes that hold a picture."""
    return page.locator(".jp-OutputArea-output .widget-vbox:has(.widget-image)")


def seen(panel):
    """All that a panel shows: its texts, and a picture's address."""
    texts = panel.locator(".widget-label").all_inner_texts()
    pictures = panel.locator("img.widget-image")
    return texts, [pictures.nth(i).get_attribute("src")
                   for i in range(pictures.count())]


def move_every_control(page, panel):
    """Move each slider and list of a panel with the keyboard; it must answer."""
    handles = panel.locator(".noUi-handle")
    lists = panel.locator("select")
    for kind, controls in (("slider", handles), ("list", lists)):
        for i in range(controls.count()):
            control, before = controls.nth(i), seen(panel)
            control.scroll_into_view_if_needed()
            control.focus()
            if kind == "list":
                names = control.locator("option").all_inner_texts()
                control.select_option(names[1])
            else:
                top = control.get_attribute("aria-valuemax")
                at_top = control.get_attribute("aria-valuenow") == top
                for _ in range(10):  # one step may be too small for two decimals
                    page.keyboard.press("ArrowLeft" if at_top else "ArrowRight")
            wait_until(lambda old=before: seen(panel)[0] != old[0]
                       and seen(panel)[1] != old[1], 20,
                       f"{kind} {i} of {before[0]} changed no text or no picture")
    return handles.count() + lists.count()


@pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.stem)
def test_a_chapter_runs_in_a_browser_and_its_panels_answer(path, lab, page):
    heard = faults_heard(page)
    open_and_run(page, lab.address(path.name))
    scroll_through(page)
    assert page.locator(FAULTS).count() == 0, page.locator(FAULTS).first.inner_text()
    source = path.read_text(encoding="utf-8")
    expected = len(re.findall(r"widgets\.\w+(?:laboratory|explorer)\(", source))
    found = panels(page)
    explorers = [i for i in range(found.count())
                 if found.nth(i).locator(".noUi-handle, select").count()]
    assert len(explorers) >= expected
    for i in explorers:
        assert move_every_control(page, found.nth(i)) > 0
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    for theme in ("Light", "Dark"):
        choose_theme(page, theme)
        for i in explorers:
            found.nth(i).scroll_into_view_if_needed()
            page.screenshot(path=SCREENSHOTS / f"{path.stem}-panel-{i}-{theme}.png")
        page.evaluate("document.querySelectorAll('.jp-WindowedPanel-outer')"
                      ".forEach(notebook => { notebook.scrollTop = 0 })")
        page.wait_for_timeout(1_000)  # milliseconds, until the pictures are drawn
        page.screenshot(path=SCREENSHOTS / f"{path.stem}-{theme}.png")
    assert page.locator(FAULTS).count() == 0, page.locator(FAULTS).first.inner_text()
    assert heard == []


def test_the_live_training_panel_starts_pauses_goes_on_and_stops(lab, page):
    with_it = [path for path in CHAPTERS
               if "live_training(" in path.read_text(encoding="utf-8")]
    if not with_it:
        pytest.skip("no chapter shows the live training panel")
    heard = faults_heard(page)
    open_and_run(page, lab.address(with_it[0].name))
    scroll_through(page)
    panel = page.locator(".widget-vbox:has(button:has-text('start'))").last

    def press(name):
        panel.locator(f"button:has-text('{name}')").click()

    press("start")
    first = panel.locator(".widget-label").all_inner_texts()
    wait_until(lambda: panel.locator(".widget-label").all_inner_texts() != first, 60,
               "the run shows no progress")
    press("pause")
    time.sleep(2)  # the step that was under way
    paused = panel.locator(".widget-label").all_inner_texts()
    time.sleep(2)
    assert panel.locator(".widget-label").all_inner_texts() == paused
    press("go on")
    wait_until(lambda: panel.locator(".widget-label").all_inner_texts() != paused, 60,
               "the run does not go on")
    press("stop")
    wait_until(lambda: any("Over at" in text for text in
                           panel.locator(".widget-label").all_inner_texts()), 30,
               "the run does not stop")
    choose_theme(page, "Light")
    panel.scroll_into_view_if_needed()
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / "live_training.png")
    assert heard == []
