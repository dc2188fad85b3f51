"""A report of pairs that were never registered: every method's errors are known; and pages as elements and in a browser."""

import dataclasses
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig
from cmig_jax.evaluation.errors import Errors, Estimates
from cmig_jax.evaluation.matches import Matches
from cmig_jax.evaluation.metrics import isotropic_errors
from cmig_jax.report.gallery import Example, choose
from cmig_jax.report.page import Report
from cmig_jax.transform import RigidTransform
from configs import PRESETS

CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync", "--enable-logging=stderr", "--virtual-time-budget=3000", "--dump-dom"]
FLAGS += ["--force-prefers-reduced-motion"]
WATCH = """<script>
const faults = [];
addEventListener("error", (event) => faults.push(event.message));
addEventListener("unhandledrejection", (event) => faults.push(String(event.reason)));
addEventListener("securitypolicyviolation", (event) => faults.push(event.blockedURI));
</script>"""
RUN = """<script>
addEventListener("load", () => setTimeout(async () => {
  %s
  const requests = performance.getEntriesByType("resource").map((entry) => entry.name).filter((name) => !name.startsWith("data:"));
  const overflow = document.documentElement.scrollWidth - innerWidth;
  const note = document.body.appendChild(document.createElement("pre"));
  note.id = "found";
  note.textContent = JSON.stringify({ found, requests, overflow, faults });
}, 300));
</script>"""
EMPTY = {"meta", "img", "input"}
HOSTILE = '</script><img src=x onerror="alert(1)"> & $\\frac{ <!--'


def errors_of(count: int = 30, category: str = "chair") -> Errors:
    rng = np.random.default_rng(0)
    R, t = Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3))
    methods = {}
    for name, size in {"identity": 1.0, "ICP": 0.1, "CMIGNet": 0.03, "CMIGNet + ICP": 0.0}.items():
        found_R = Rotation.from_rotvec(size * rng.normal(size=(count, 3))).as_matrix() @ R
        found_t = t + size * rng.normal(size=(count, 3))
        errors = isotropic_errors(RigidTransform(R=found_R, t=found_t), RigidTransform(R=R, t=t))
        methods[name] = Estimates(found_R, found_t, *errors)
    return Errors(
        methods=methods,
        network="CMIGNet",
        R=R,
        t=t,
        angle_deg=np.degrees(Rotation.from_matrix(R).magnitude()),
        overlap=rng.uniform(0.3, 1, count),
        category=[category, "table"] * (count // 2),
    )


def example_of(
    errors: Errors, position: int, rank: int, *, matched: bool = True, points: int = 50, views: tuple[int, ...] = (2, 6, 16, 16)
):
    rng = np.random.default_rng(position)
    source = rng.normal(size=(points, 3)).astype(np.float32)
    target = (source @ errors.R[position].T + errors.t[position]).astype(np.float32)
    pair = {"source": source, "target": target[::-1], "views": rng.integers(0, 256, views, dtype=np.uint8)}
    matches = Matches(
        source=source[:20],
        target=target[:20],
        chosen=np.roll(np.arange(20), np.arange(20) % 2),
        used=np.arange(20) < 14,
        right=np.arange(20) % 3 > 0,
    )
    return Example(position, rank, pair, matches if matched else None, f"object {position}")


def report_of(errors: Errors, examples: list[Example]) -> Report:
    results = {name: {"rmse_r_deg": float(np.sqrt(np.mean(f.rotation_deg**2))), "pairs": len(errors)} for name, f in errors.methods.items()}
    results |= {"command": "python evaluate.py 'runs/a <b>' --report", "config": {}, "versions": {"python": "3.11", "jax": "0.10"}}
    config = dataclasses.replace(PRESETS["corrected"](), data=DataConfig(source="shapes"))
    return Report("a <b>", "best, step 7", config, results, errors, examples, [])


class Page(HTMLParser):
    """The elements of a page, their attributes and texts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"{tag} closes another element"

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def text(self, tag: str) -> list[str]:
        return [text for name, text in self.texts if name == tag]

    def asks_for_nothing(self) -> None:
        """Check that no element makes a request, and that the policy forbids it."""
        assert not self.all("link")
        for _, attributes in self.elements:
            for name in ("src", "href", "xlink:href", "srcset", "action"):
                assert (attributes.get(name) or "#").startswith(("#", "data:"))
            assert "http" not in " ".join(value or "" for key, value in attributes.items() if key != "http-equiv")
        assert all("src" not in attributes for attributes in self.all("script"))
        assert not any("@import" in text or "http" in text for text in [*self.text("style"), *self.text("script")])
        policy = next(a["content"] for a in self.all("meta") if a.get("http-equiv") == "Content-Security-Policy")
        assert policy is not None
        assert policy.startswith("default-src 'none'; img-src data:;")


def page_of(path) -> Page:
    page = Page(path.read_text())
    assert not page.open
    return page


@pytest.fixture(scope="session")
def read_page():
    """Read a page whose elements are all closed."""
    return page_of


@pytest.fixture
def in_browser(tmp_path):
    """Open a page in Chromium, run a script that fills `found`, and return that; no faults, no requests, and the page fits the window."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")

    def run(path, script: str, width: int):
        text = path.read_text().replace("<style>", f"{WATCH}<style>", 1)
        probe = tmp_path / "probe.html"
        probe.write_text(text.replace("</body>", f"{RUN % script}</body>", 1))
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900", f"file://{probe}"]
        finished = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert "CONSOLE" not in finished.stderr
        result = json.loads(re.search(r'<pre id="found">(.*?)</pre>', finished.stdout, re.DOTALL)[1])  # pyright: ignore
        assert result["requests"] == result["faults"] == []
        assert result["overflow"] <= 0, "nothing is wider than the window"
        return result["found"]

    return run


@pytest.fixture(scope="session")
def hostile() -> str:
    """A name that tries to break out of a page, and to start a formula."""
    return HOSTILE


@pytest.fixture(scope="session")
def make_errors():
    """Make the errors of four methods, the last of which is always right; every other pair is of the given category."""
    return errors_of


@pytest.fixture(scope="session")
def make_example():
    """Make a pair to show."""
    return example_of


@pytest.fixture(scope="session")
def make_report():
    """Make a report of some pairs, without figures."""
    return report_of


@pytest.fixture(scope="session")
def report() -> Report:
    """Make a report of four pairs out of 30, without figures; the worst has a hostile name or the next."""
    errors = errors_of(category=HOSTILE)
    return report_of(errors, [example_of(errors, *chosen) for chosen in choose(errors.methods["CMIGNet"].rotation_deg, 4)])
