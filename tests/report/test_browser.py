"""The page in Chromium, where there is one: no error, no request, and every control changes what is drawn."""

import dataclasses

import pytest

from cmig_jax.report.page import write_page

PROBE = """
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
"""


@pytest.mark.parametrize(("matched", "width"), [(True, 1280), (False, 800)])
def test_the_page_in_a_browser(tmp_path, in_browser, report, matched, width):
    if not matched:
        report = dataclasses.replace(report, examples=[dataclasses.replace(example, matches=None) for example in report.examples])
    write_page(tmp_path / "report.html", report)
    found = in_browser(tmp_path / "report.html", PROBE, width)
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
    }
