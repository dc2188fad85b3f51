"""What the pages share. A page is one file that opens from a folder, without a server, and asks for nothing outside itself.

`frame.html` is the frame, whose content security policy forbids every request; `page.css` the looks; `viewer.js` the 3D view. They are
written into the page together with its own parts and its data.
"""

from __future__ import annotations

import base64
import json
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from cmig_jax.report.colours import CORRECT, SOURCE, TARGET, TRUTH, WRONG

PARTS = Path(__file__).parent


def html_page(name: str, title: str, data: Any, **texts: str) -> str:
    """Return a page.

    Args:
        name: of its own parts: the body `NAME.html`, the looks `NAME.css`, and `NAME.js`, which ties the data to view and controls.
        title: plain text.
        data: for the script, as JSON.
        texts: HTML for the names in the body.
    """
    colours = {"source": SOURCE, "target": TARGET, "right": CORRECT, "wrong": WRONG, "truth": TRUTH}
    root = f":root {{ {' '.join(f'--{key}: {colour};' for key, colour in colours.items())} }}"
    return Template(_part("frame.html")).substitute(
        title=escape(title),
        style="\n".join([root, _part("page.css"), _part(f"{name}.css")]),
        body=Template(_part(f"{name}.html")).substitute(texts),
        # No script element may end early: a name may hold anything.
        data=json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        script="\n".join([_part("viewer.js"), _part(f"{name}.js")]),
    )


def encoded(array: np.ndarray) -> str:
    """Return the bytes of an array in base64, for `viewer.js`."""
    return base64.b64encode(array.tobytes()).decode()


def _part(name: str) -> str:
    return (PARTS / name).read_text()
