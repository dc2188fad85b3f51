"""The report of an evaluation as one HTML page, made of `evaluation.html`, `.css` and `.js` and what pages share (`parts`)."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from cmig_jax.config import Config, DataConfig, ViewsConfig
from cmig_jax.data.sources import source_of
from cmig_jax.evaluation.engine import MATCH_DISTANCE
from cmig_jax.evaluation.errors import Errors
from cmig_jax.evaluation.metrics import RECALL_CLOSEST_POINT, RECALL_DEG, RECALL_LENGTH
from cmig_jax.evaluation.tables import html_table
from cmig_jax.files import write_text
from cmig_jax.report.figures import Drawn
from cmig_jax.report.gallery import MAX_POINTS, Example, contact_sheet, describe
from cmig_jax.report.parts import html_page


@dataclass(frozen=True)
class Report:
    """What the page says.

    Attributes:
        run: name of the run.
        checkpoint: which one, and its step.
        config: the network's flags, with those of the test data.
        results: what `evaluate` returned.
        errors: the same, pair by pair.
        examples: the pairs to show, in this order.
        figures: to stand at the end.
    """

    run: str
    checkpoint: str
    config: Config
    results: Mapping[str, Any]
    errors: Errors
    examples: Sequence[Example]
    figures: Sequence[Drawn]


def write_page(path: Path, report: Report) -> None:
    """Write the page."""
    page = html_page(
        "evaluation",
        f"{report.run}: evaluation",
        {"network": report.errors.network, "pairs": [describe(e, report.errors) for e in report.examples]},
        run=escape(report.run),
        facts=_facts(report),
        table=html_table(report.results),
        reading=escape(_reading(report.config)),
        methods=_methods(report.errors),
        pairs_note=escape(_pairs_note(report)),
        pairs="\n".join(_pair(example, number, report) for number, example in enumerate(report.examples, start=1)),
        figures="\n".join(_figure(figure) for figure in report.figures),
    )
    write_text(path, page)


def protocol(config: Config, pairs: int) -> str:
    """Describe in one line what the pairs are and how they were made."""
    data, views = config.data, config.views
    shown = "" if views.shown == "real" else f"; views: {views.shown}"
    if source_of(data).records:
        return f"{data.source}, {pairs} recorded pairs turned by up to {data.max_angle_deg:g}°, {_points(data)} points per cloud{shown}"
    tested = f"{data.test_categories} categories" if data.tested == "test" else f"held out for validation, {data.categories} categories"
    categories = tested + (f" without {', '.join(data.exclude)}" if data.exclude else "")
    kept = f"{data.keep_least:.0%} to {data.keep:.0%}" if data.keep_least else f"{data.keep:.0%}"
    crop = {"none": "no crop", "source": f"source cropped to {kept}"}.get(data.crop, f"{data.crop} crop to {kept}")
    level = f"up to {data.noise_std:g}" if data.noise == "uniform" else f"{data.noise_std:g}"
    noise = f"noise {level} clipped at {data.noise_clip:g}" if data.noise_std > 0 else "no noise"
    turn = " to either side" if data.turn == "either" else ""
    rotations = "any rotation" if data.turn == "any" else f"rotations up to {data.max_angle_deg:g}° per axis{turn}"
    pose = f"{rotations}, translations up to {data.max_translation:g}"
    pose = f"twists up to {data.max_twist:g}" if data.pose == "twist" else pose
    pose += ", in any frame" if data.frame == "any" else ""
    normals = f", normals: {data.normals}" if config.model.needs.normals else ""
    made = f"{data.points} points sampled {data.sampling}, {crop}, {noise}{normals}"
    return f"{data.source}, {categories}, {pairs} pairs; {made}; {pose}{shown}"


def _points(data: DataConfig) -> str:
    source, target = data.cropped_points, data.target_points
    return f"{source}" if source == target else f"{source} and {target}"


def _facts(report: Report) -> str:
    versions = ", ".join(f"{package} {version}" for package, version in report.results["versions"].items())
    facts = {
        "checkpoint": escape(report.checkpoint),
        "protocol": escape(protocol(report.config, len(report.errors))),
        "command": f"<code>{escape(report.results['command'])}</code>",
        "versions": escape(versions),
    }
    return "\n".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in facts.items())


def _reading(config: Config) -> str:
    frame = "of the recordings' common scale" if source_of(config.data).records else "of the normalised object"
    return (
        f"Lengths are in units {frame}. RMSE and MAE compare Euler angles and components of the translation; angle and shift are those "
        f"of the motion between the found and the true pose. Recall: below {RECALL_DEG:g}° and {RECALL_LENGTH:g}; recall (closest): "
        f"mean closest-point distance below {RECALL_CLOSEST_POINT:g}, which forgives symmetries. Best values are bold."
    )


def _methods(errors: Errors) -> str:
    return "".join(
        f'<option value="{escape(name)}"{" selected" if name == errors.network else ""}>{escape(name)}</option>' for name in errors.methods
    )


def _pairs_note(report: Report) -> str:
    return (
        f"{len(report.examples)} of {len(report.errors)} pairs, by the rotation error of {report.errors.network}, the largest first. "
        f"A correspondence is right if it lies within {MATCH_DISTANCE:g} under the true pose. Overlap is the smaller share of either "
        f"cloud's points with a point of the other within {MATCH_DISTANCE:g} under the true pose (of recordings: on all their points). "
        f"Coordinates are rounded to 16 bits, clouds thinned to {MAX_POINTS:,} points where they have more."
    )


def _pair(example: Example, number: int, report: Report) -> str:
    """Write the card of a pair; the script finds its canvases by class."""
    errors, i = report.errors, example.position
    title = f"{number}. {errors.category[i] or 'pair'}"
    facts = (
        f"{_standing(example.rank, len(errors))} · {example.name} · true angle {errors.angle_deg[i]:.1f}°, "
        f"shift {np.linalg.norm(errors.t[i]):.2f} · overlap {errors.overlap[i]:.0%}"
    )
    panes = "".join(
        f'<figure><canvas tabindex="0" role="application" aria-roledescription="3D view" aria-label="Pair {number} {when} registration. '
        f'Arrow keys turn it, plus and minus zoom, 0 resets." data-when="{when}"></canvas><figcaption>{when}</figcaption></figure>'
        for when in ("before", "after")
    )
    return (
        f'<article class="pair" id="pair-{number}"><header><h3>{escape(title)}</h3><p>{escape(facts)}</p></header>\n'
        f'<div class="panes">{panes}</div>\n{_errors_of_pair(errors, i)}\n{_views(example, report.config)}</article>'
    )


def _standing(rank: int, count: int) -> str:
    if rank == count - 1:
        return f"best of {count}"
    if rank == (count - 1) // 2:
        return f"median of {count}"
    return f"rank {rank + 1} of {count}, worst first" if rank else f"worst of {count}"


def _errors_of_pair(errors: Errors, i: int) -> str:
    rows = "".join(
        f'<tr data-method="{escape(name)}"><th scope="row">{escape(name)}</th>'
        f"<td>{found.rotation_deg[i]:.2f}</td><td>{found.shift[i]:.4f}</td></tr>"
        for name, found in errors.methods.items()
    )
    head = '<th scope="col">method</th><th scope="col">angle <small>deg</small></th><th scope="col">shift <small>units</small></th>'
    return f'<table class="errors"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'


def _views(example: Example, config: Config) -> str:
    views = example.pair.get("views")
    if views is None:
        return ""
    sheets = []
    for text, seen in zip(view_titles(config.views), views, strict=True):
        sheet, width = contact_sheet(np.asarray(seen))
        picture = base64.b64encode(sheet).decode()
        image = f'<img width="{width}" src="data:image/png;base64,{picture}" alt="{escape(text)}">'
        sheets.append(f"<figure>{image}<figcaption>{escape(text)}</figcaption></figure>")
    return f'<div class="views">{"".join(sheets)}</div>'


def view_titles(views: ViewsConfig) -> list[str]:
    """Say of each view set of a pair what it shows."""
    of = {"object": ["the complete object"], "source": ["the source"], "target": ["the target"], "both": ["the source", "the target"]}
    if views.shown == "zero":
        return [f"{views.count} black views in place of depth views of {name}" for name in of[views.of]]
    shuffled = " of another pair" if views.shown == "shuffled" else ""
    return [f"{views.count} depth views of {name}{shuffled}" for name in of[views.of]]


def _figure(figure: Drawn) -> str:
    heading = escape(figure.heading)
    picture = f'<div class="drawing" role="img" aria-label="{heading}">{figure.svg}</div>'
    return f"<figure><h3>{heading}</h3>{picture}<figcaption>{escape(figure.caption)}</figcaption></figure>"
