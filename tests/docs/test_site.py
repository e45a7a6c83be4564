# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The documentation as it is read: built once, its links followed, each page seen by a browser."""

from __future__ import annotations

import functools
import html.parser
import http.server
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import urllib.parse
from pathlib import Path

import programs
import pytest

ROOT = Path(__file__).resolve().parents[2]
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
NEEDED = (
    "griffe_inherited_docstrings",
    "mkdocs",
    "mkdocstrings",
    "jupytext",
    "latex2mathml",
    "material",
    "pymdownx",
)

pytestmark = [pytest.mark.skip_in_parallel, pytest.mark.slow]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the documentation, and fail where that warns of anything."""
    for name in NEEDED:
        pytest.importorskip(name, reason="the documentation needs pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    build = ("-m", "mkdocs", "build", "--strict", "--quiet", "-d", folder)
    done = programs.run(*build, cwd=ROOT, NO_MKDOCS_2_WARNING="1")
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


class Reader(html.parser.HTMLParser):
    """What a page refers to, and what can be referred to on it."""

    def __init__(self) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.pictures: list[tuple[str, str | None]] = []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.anchors.update(filter(None, (given.get("id"), given.get("name"))))
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if tag in ("link", "script") and (given.get("href") or given.get("src")):
            self.links.append(given.get("href") or given["src"])
        if tag == "img":
            self.pictures.append((given.get("src", ""), given.get("alt")))


@pytest.fixture(scope="module")
def pages(site):
    """Read all pages, by their path."""
    found = {}
    for path in sorted(site.rglob("*.html")):
        found[path] = Reader()
        found[path].feed(path.read_text("utf-8"))
    return found


def outward(address):
    """Return whether an address is not one of the site."""
    return bool(urllib.parse.urlsplit(address).scheme) or address.startswith("//")


def target(page, address, site):
    """Return the file and the anchor that a link of a page leads to."""
    parts = urllib.parse.urlsplit(address)
    name = urllib.parse.unquote(parts.path)
    if not name:
        path = page
    else:
        path = site / name.lstrip("/") if name.startswith("/") else page.parent / name
        path = Path(os.path.normpath(path))
    return path / "index.html" if path.is_dir() else path, urllib.parse.unquote(parts.fragment)


def test_links_anchors_and_pictures_lead_somewhere(site, pages):
    broken = []
    for page, read in pages.items():
        if page.name == "404.html":  # its links are those of a server's root
            continue
        for address in [*read.links, *(source for source, _ in read.pictures)]:
            if outward(address):
                continue
            path, anchor = target(page, address, site)
            lost = (
                anchor
                and anchor != "__skip"
                and path in pages
                and (anchor not in pages[path].anchors)
            )
            if not path.exists() or lost:
                broken.append(f"{page.relative_to(site)}: {address}")
    assert not broken


def test_nothing_is_loaded_from_the_net(site):
    loading = re.compile(r"<(?:script|img|link)[^>]*(?:src|href)=\"(https?:)?//[^\"]*\"[^>]*>")
    for path in sorted(site.rglob("*.html")):
        found = [m[0] for m in loading.finditer(path.read_text("utf-8"))]
        assert not [tag for tag in found if "canonical" not in tag], path


def test_home_names_every_page_of_the_guide_and_the_background(site, pages):
    home = pages[site / "index.html"]
    named = {target(site / "index.html", link, site)[0] for link in home.links}
    written = {site / path.with_suffix(".html").name for path in (ROOT / "docs").glob("*.md")}
    assert written <= named
    body = (site / "index.html").read_text("utf-8")
    article = body[body.index("<article") : body.index("</article>")]
    missing = [p.name for p in sorted(written) if p.name not in article and p.name != "index.html"]
    assert not missing


def test_each_demo_has_its_picture_and_its_output(site):
    for script in sorted((ROOT / "demos").glob("demo_*.py")):
        name = script.stem.removeprefix("demo_")
        text = (site / "demos" / f"{script.stem}.html").read_text("utf-8")
        assert f"images/demos/{name}.png" in text
        assert 'id="what-it-draws-and-prints"' in text and 'id="exercises"' in text
        notebook = json.loads((site / "demos" / f"{script.stem}.ipynb").read_text("utf-8"))
        assert notebook["nbformat"] == 4 and len(notebook["cells"]) > 3


def test_a_notebook_runs(site, tmp_path):
    """The tutorial's, cell by cell, as Jupyter runs them."""
    nbformat = pytest.importorskip("nbformat", reason="notebooks are run by nbformat and nbclient")
    nbclient = pytest.importorskip("nbclient", reason="notebooks are run by nbformat and nbclient")
    pytest.importorskip("ipykernel", reason="notebooks are run by ipykernel")
    book = nbformat.read(site / "demos" / "demo_tutorial.ipynb", as_version=4)
    paths = os.pathsep.join(p for p in sys.path if p)
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = paths
    try:
        client = nbclient.NotebookClient(
            book, timeout=int(programs.PATIENCE), resources={"metadata": {"path": tmp_path}}
        )
        client.execute()
    finally:
        os.environ.pop("PYTHONPATH") if before is None else os.environ.update(PYTHONPATH=before)
    assert (tmp_path / "tutorial.png").exists()


#: Put before all else into each page: it notes what goes wrong.
NOTING = """<script>
window.wrong = [];
addEventListener("error", e => wrong.push("error: " + (e.message || e.target.src || e.target.href)),
                 true);
addEventListener("unhandledrejection", e => wrong.push("rejected: " + e.reason));
for (const kind of ["error", "warn"]) {
  const tell = console[kind];
  console[kind] = (...words) => { wrong.push(kind + ": " + words.join(" ")); tell(...words); };
}
</script>"""

#: Loads each page into a frame of a reader's width, then of a phone's, looks at it, and reports.
LOOKING = """<!doctype html><title>check</title><body style="margin:0"><script>
async function look(name) {
  const frame = document.createElement("iframe");
  frame.style = "width:1280px;height:900px;border:0";
  frame.src = name;
  const loaded = new Promise(done => frame.onload = done);
  document.body.replaceChildren(frame);
  await loaded;
  const page = frame.contentDocument, wrong = frame.contentWindow.wrong || ["not loaded"];
  page.querySelectorAll("img[loading]").forEach(img => img.loading = "eager");
  for (const img of page.images) {
    if (!img.complete) await new Promise(done => { img.onload = img.onerror = done; });
    if (!img.naturalWidth) wrong.push("no picture: " + img.getAttribute("src"));
  }
  let formulas = 0;
  for (const box of page.querySelectorAll("div.arithmatex")) {
    formulas += 1;
    const math = box.querySelector("math");
    if (!math) { wrong.push("no MathML: " + box.textContent.slice(0, 60)); continue; }
    const inside = math.getBoundingClientRect(), outside = box.getBoundingClientRect();
    const high = box.scrollHeight > box.clientHeight + 1;
    if (high || inside.top < outside.top - 1 || inside.bottom > outside.bottom + 1)
      wrong.push("clipped: " + math.textContent.slice(0, 60));
  }
  let long = 0;
  for (const code of page.querySelectorAll("article .highlight pre code"))
    for (const line of code.textContent.split("\\n")) long = Math.max(long, line.length);
  for (const box of page.querySelectorAll(".md-typeset__scrollwrap"))
    if (box.scrollWidth > box.clientWidth + 1)
      wrong.push("wide table: " + box.textContent.trim().slice(0, 60));
  const wide = page.documentElement.scrollWidth > frame.clientWidth + 1;
  if (wide) wrong.push("wider than the window");
  const items = [...page.querySelectorAll("article p")].filter(
    p => /\\n[-*] \\S/.test(p.textContent)).length;
  if (items) wrong.push("a list that is none");
  frame.style.width = "390px";  // a phone
  await new Promise(done => frame.contentWindow.requestAnimationFrame(done));
  if (page.documentElement.scrollWidth > frame.clientWidth + 1) wrong.push("wider than a phone");
  for (const number of page.querySelectorAll(".equation-number")) {
    const math = number.parentElement.querySelector("math").getBoundingClientRect();
    if (number.getBoundingClientRect().left < math.right || math.left < 0)
      wrong.push("formula under its number, or cut off: " + number.textContent);
  }
  return {name, wrong, formulas, long};
}
(async () => {
  const names = await (await fetch("/pages.json")).json(), seen = [];
  for (const name of names) seen.push(await look(name));
  await fetch("/report", {method: "POST", body: JSON.stringify(seen)});
})();
</script>"""


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the site with the notes, the page that looks, and takes its report."""

    def do_GET(self):
        path = Path(self.translate_path(self.path))
        if self.path == "/look":
            self.answer(LOOKING)
        elif self.path == "/pages.json":
            root = Path(self.directory)
            names = sorted("/" + str(p.relative_to(root)) for p in root.rglob("*.html"))
            self.answer(json.dumps([n for n in names if n != "/404.html"]), "application/json")
        elif self.path == "/favicon.ico":
            self.answer("", "image/x-icon")
        elif path.suffix == ".html" and path.exists():
            text = path.read_text("utf-8")
            self.answer(text.replace("<head>", "<head>" + NOTING, 1))
        else:
            super().do_GET()

    def do_POST(self):
        size = int(self.headers["Content-Length"])
        self.server.report = json.loads(self.rfile.read(size))
        self.answer("")
        self.server.done.set()

    def answer(self, text, kind="text/html; charset=utf-8"):
        data = text.encode()
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def seen(site, tmp_path_factory):
    """Let a browser look at all pages."""
    if BROWSER is None:
        pytest.skip("there is no chromium to look at the pages with")
    handler = functools.partial(Handler, directory=str(site))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.done = threading.Event()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    flags = ["headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run"]
    flags += ["disable-background-networking", "disable-component-update", "disable-sync"]
    command = [BROWSER, *(f"--{flag}" for flag in flags), "--window-size=1300,1000"]
    profile = tmp_path_factory.mktemp("profile")
    address = f"http://127.0.0.1:{server.server_address[1]}/look"
    browser = subprocess.Popen(
        [*command, f"--user-data-dir={profile}", "--remote-debugging-port=0", address],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert server.done.wait(programs.PATIENCE), "the browser has not looked at all pages"
    finally:
        browser.kill()
        browser.wait()
        server.shutdown()
    return server.report


def test_no_page_has_an_error_a_clipped_formula_or_a_picture_that_is_missing(seen, pages):
    assert len(seen) == len(pages) - 1  # all but 404.html
    wrong = {page["name"]: page["wrong"] for page in seen if page["wrong"]}
    assert not wrong


def test_formulas_are_there(seen):
    assert sum(page["formulas"] for page in seen) > 50


def test_code_fits_into_80_columns(seen):
    wide = {page["name"]: page["long"] for page in seen if page["long"] > 80}
    assert not wide
