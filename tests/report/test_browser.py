"""The page in Chromium, where there is one: no error, no request, and every control changes what is drawn."""

import dataclasses
import json
import re
import shutil
import subprocess

import pytest

from cmig_jax.report.page import write_page

CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync", "--enable-logging=stderr", "--virtual-time-budget=3000", "--dump-dom"]
WATCH = """<script>
const faults = [];
addEventListener("error", (event) => faults.push(event.message));
addEventListener("securitypolicyviolation", (event) => faults.push(event.blockedURI));
</script>"""
PROBE = """<script>
addEventListener("load", () => setTimeout(() => {
  const canvases = [...document.querySelectorAll("canvas")].slice(0, 2);
  const pictures = () => { cards[0].drawAll(); return canvases.map((canvas) => canvas.toDataURL()); };
  const found = {};
  const change = (name, act) => {
    const before = pictures();
    act();
    found[name] = pictures().map((picture, i) => picture !== before[i]);
  };
  const send = (type, kind, options) => canvases[1].dispatchEvent(new kind(type, { bubbles: true, cancelable: true, ...options }));
  const initial = pictures();
  change("nothing", () => {});
  canvases[1].setPointerCapture = () => {};
  change("drag", () => {
    send("pointerdown", PointerEvent, { pointerId: 1, clientX: 50, clientY: 50 });
    send("pointermove", PointerEvent, { pointerId: 1, clientX: 90, clientY: 70 });
    send("pointerup", PointerEvent, { pointerId: 1 });
  });
  change("move without a button", () => send("pointermove", PointerEvent, { pointerId: 1, clientX: 10, clientY: 10 }));
  change("wheel elsewhere", () => send("wheel", WheelEvent, { deltaY: -100 }));
  canvases[1].focus();
  change("wheel", () => send("wheel", WheelEvent, { deltaY: -100 }));
  for (const key of ["ArrowLeft", "ArrowUp", "+", "x"]) change(key, () => send("keydown", KeyboardEvent, { key }));
  send("keydown", KeyboardEvent, { key: "0" });
  found.reset = pictures().map((picture, i) => picture === initial[i]);
  for (const id of ["correspondences", "keypoints", "truth"]) change(id, () => control(id).click());
  change("method", () => { control("method").value = "identity"; control("method").dispatchEvent(new Event("change")); });
  found.shown = document.querySelector("tr.shown th").textContent;
  found.requests = performance.getEntriesByType("resource").map((entry) => entry.name).filter((name) => !name.startsWith("data:"));
  found.overflow = document.documentElement.scrollWidth - innerWidth;
  const note = document.body.appendChild(document.createElement("pre"));
  note.id = "found";
  note.textContent = JSON.stringify({ ...found, faults });
}, 300));
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize(("matched", "width"), [(True, 1280), (False, 800)])
def test_the_page_in_a_browser(tmp_path, report, matched, width):
    if not matched:
        report = dataclasses.replace(report, examples=[dataclasses.replace(example, matches=None) for example in report.examples])
    write_page(tmp_path / "report.html", report)
    text = (tmp_path / "report.html").read_text()
    (tmp_path / "probe.html").write_text(text.replace("<style>", f"{WATCH}<style>", 1).replace("</body>", f"{PROBE}</body>", 1))
    assert CHROMIUM is not None
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900", f"file://{tmp_path}/probe.html"]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "CONSOLE" not in finished.stderr
    found = json.loads(re.search(r'<pre id="found">(.*?)</pre>', finished.stdout, re.DOTALL)[1])  # pyright: ignore[reportOptionalSubscript]
    both, neither, after = [True, True], [False, False], [False, True]
    assert found == {
        "nothing": neither,
        "drag": both,
        "move without a button": neither,
        "wheel elsewhere": neither,
        "wheel": both,
        "ArrowLeft": both,
        "ArrowUp": both,
        "+": both,
        "x": neither,
        "reset": both,
        "correspondences": both if matched else neither,
        "keypoints": both if matched else neither,
        "truth": after,
        "method": after,
        "shown": "identity",
        "requests": [],
        "overflow": found["overflow"],
        "faults": [],
    }
    assert found["overflow"] <= 0, "nothing is wider than the window"
