"""The page of a registration: both clouds before and after, the verdict, and other poses that fit almost as well.

Made of `registration.html`, `.css` and `.js` and what pages share (`parts`). Each cloud is stored from its own centre, so that single
precision resolves it whatever its offset. The frame of the page is the target's, moved to the target's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cmig_jax.clouds import thinned
from cmig_jax.files import write_text
from cmig_jax.registration.result import Registration
from cmig_jax.registration.verdict import TRUSTED
from cmig_jax.report.parts import encoded, html_page
from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]
MOST_DRAWN, MOST_MEASURED, MOST_MATCHES = 20_000, 100_000, 100
"""Points of a cloud that are drawn, points of the other one to which their distances are measured, and correspondences that are drawn."""
LEVELS = 16
"""Number of colours of distances."""
FAR, LEAST_FAR, MOST_FAR = 8.0, 0.001, 0.05
"""Distances have the last colour from so many median distances of partners on, within these shares of the target's radius."""
APART = 1.5
"""Largest distance of the centres that is drawn as it is, in sums of the clouds' radii."""


@dataclass(frozen=True)
class _Cloud:
    """What the page shows of a cloud.

    Attributes:
        name: of its file.
        count: finite points.
        centre: `[3]`, the median.
        drawn: `[n, 3]` from the centre.
        tree: of the points, from the centre, to which distances are measured.
        radius: of a ball around the centre that holds all but stray points.
        matched: `[k, 3]` from the centre, points of the correspondences.
    """

    name: str
    count: int
    centre: Floats
    drawn: Floats
    tree: KDTree
    radius: float
    matched: Floats


def write_registration_page(
    path: Path,
    source: ArrayLike,
    target: ArrayLike,
    found: Registration,
    names: tuple[str, str] = ("source", "target"),
    *,
    up: Literal["x", "y", "z"] = "z",
) -> None:
    """Write the page: one file, which asks for nothing outside itself.

    Args:
        path: the file; it is replaced as a whole.
        source: `[N, 3]`, as `register` was given it; rows that are not finite are not drawn.
        target: `[M, 3]`, in the same unit.
        found: their registration.
        names: of both clouds.
        up: axis of the target that points upward at first.
    """
    matches = thinned(found.correspondences, MOST_MATCHES)
    # Two seeds: with one, a cloud and its moved copy would be drawn at the same points.
    clouds = _cloud(source, names[0], matches[:, 0], 0), _cloud(target, names[1], matches[:, 1], 1)
    poses = (found.target_from_source, *found.alternatives)
    far = _far(found, *clouds)
    apart, before = _before(*clouds)
    data = {
        "up": up,
        "levels": LEVELS,
        "before": before.tolist(),
        "clouds": [{"points": _floats(c.drawn), "radius": c.radius, "matched": _floats(c.matched)} for c in clouds],
        "poses": [_pose(pose, *clouds, far) for pose in poses],
    }
    title = f"{names[0]} onto {names[1]}"
    page = html_page(
        "registration",
        f"{title}: registration",
        data,
        heading=escape(title),
        state="trusted" if found.trusted else "doubtful",
        verdict="trusted" if found.trusted else "not trusted",
        why=escape(found.why),
        only="" if found.alternatives else " hidden",
        poses=_options(poses, clouds[0].centre),
        matches=f"{len(matches):,}",
        far=f"{far:.2g}",
        facts=_facts(found, apart),
        clouds="\n".join(_row(*row) for row in zip(("source", "target"), clouds, found.overlap, strict=True)),
        matrices="\n".join(_matrix(pose, i) for i, pose in enumerate(poses)),
        note=escape(_note(found, nearer=not np.allclose(np.linalg.norm(before), apart))),
    )
    write_text(path, page)


def _cloud(given: ArrayLike, name: str, rows: NDArray[np.int64], seed: int) -> _Cloud:
    points = np.asarray(given, np.float64)
    finite = points[np.isfinite(points).all(axis=1)]
    drawn = thinned(finite, MOST_DRAWN, seed)
    centre = np.median(drawn, axis=0)
    radius = 1.5 * float(np.quantile(np.linalg.norm(drawn - centre, axis=1), 0.98))
    tree = KDTree(thinned(finite, MOST_MEASURED, seed) - centre)
    return _Cloud(name, len(finite), centre, drawn - centre, tree, radius, points[rows] - centre)


def _before(source: _Cloud, target: _Cloud) -> tuple[float, Floats]:
    """Return how far the centres are apart before registration, and the place `[3]` that the source's has in the page's frame."""
    gap = source.centre - target.centre
    apart, most = float(np.linalg.norm(gap)), APART * (source.radius + target.radius)
    return apart, gap * (most / max(apart, most))


def _far(found: Registration, source: _Cloud, target: _Cloud) -> float:
    """Return the distance from which on points have the last colour."""
    most = MOST_FAR * target.radius
    distances = np.concatenate(_distances(found.target_from_source, source, target, most))
    partners = distances[distances < min(most, 2 * found.inlier_rmse)]
    return float(np.clip(FAR * np.median(partners), LEAST_FAR * target.radius, most)) if len(partners) else most


def _pose(pose: RigidTransform, source: _Cloud, target: _Cloud, far: float) -> dict[str, Any]:
    """Return a pose for the script: turn about the source's centre, place of that centre, and colours of both clouds' distances."""
    shades = [encoded(np.round(d / far * (LEVELS - 1)).astype(np.uint8)) for d in _distances(pose, source, target, far)]
    turn = Rotation.from_matrix(np.asarray(pose.R, np.float64)).as_rotvec()
    return {"turn": turn.tolist(), "at": (_moved(source.centre, pose) - target.centre).tolist(), "shades": shades}


def _moved(point: Floats, pose: RigidTransform) -> Floats:
    return np.asarray(pose.apply(point[None]))[0]


def _distances(pose: RigidTransform, source: _Cloud, target: _Cloud, most: float) -> list[Floats]:
    """Return the distances `[n]` and `[m]` of both clouds' drawn points to the nearest point of the other, at most `most`."""
    R, at = np.asarray(pose.R, np.float64), _moved(source.centre, pose) - target.centre
    asked = (source.drawn @ R.T + at, target.tree), ((target.drawn - at) @ R, source.tree)
    return [np.minimum(tree.query(points, distance_upper_bound=most, workers=-1)[0], most) for points, tree in asked]


def _floats(points: Floats) -> str:
    return encoded(points.astype("<f4"))


def _options(poses: Sequence[RigidTransform], centre: Floats) -> str:
    best = poses[0]
    options = ['<option value="0" selected>best</option>']
    for i, pose in enumerate(poses[1:], start=1):
        angle = np.degrees(pose.compose(best.inverse()).angle())
        shift = np.linalg.norm(_moved(centre, pose) - _moved(centre, best))
        options.append(f'<option value="{i}">alternative {i}: {angle:.0f}° and {shift:.3g} from the best</option>')
    return "".join(options)


def _facts(found: Registration, apart: float) -> str:
    stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in found.seconds.items() if seconds >= 0.005)
    meter = f'<meter aria-label="confidence" min="0" max="1" low="{TRUSTED}" optimum="1" value="{found.confidence:.3f}"></meter>'
    rmse = f"{_length(found.inlier_rmse)} <small>in the clouds' unit</small>" if np.isfinite(found.inlier_rmse) else "no partners"
    facts = {
        "confidence": f"{meter} {found.confidence:.2f} <small>trusted from {TRUSTED:g}</small>",
        "inlier RMSE": rmse,
        "rotation": f"{np.degrees(found.target_from_source.angle()):.2f}°",
        "centres before": f"{_length(apart)} apart",
        "seconds": f"{sum(found.seconds.values()):.2f} <small>{escape(stages)}</small>",
    }
    return "\n".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in facts.items())


def _length(value: float) -> str:
    return f"{value:.4g}" if value < 1e4 else f"{value:,.0f}"


def _row(role: str, cloud: _Cloud, overlap: float) -> str:
    return (
        f'<tr><th scope="row" style="--colour: var(--{role})">{escape(cloud.name)} <small>{role}</small></th>'
        f"<td>{cloud.count:,}</td><td>{len(cloud.drawn):,}</td><td>{overlap:.0%}</td></tr>"
    )


def _matrix(pose: RigidTransform, i: int) -> str:
    """Write a matrix with few digits to read, and with all that are copied."""
    matrix = np.asarray(pose.as_matrix(), np.float64)
    decimals = int(np.clip(9 - np.floor(np.log10(max(np.abs(matrix[:3, 3]).max(), 1e-9))), 0, 9))
    last = [f"{value:.{decimals}f}" for value in matrix[:, 3]]
    width = max(map(len, last))
    short = "\n".join(f"{row[0]:9.6f} {row[1]:9.6f} {row[2]:9.6f} {end:>{width}}" for row, end in zip(matrix, last, strict=True))
    full = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in matrix)
    hidden = " hidden" if i else ""
    return f'<pre data-pose="{i}" data-full="{full}" tabindex="0" role="region" aria-labelledby="matrix"{hidden}>{short}</pre>'


def _note(found: Registration, nearer: bool) -> str:
    sentences = [
        f"At most {MOST_DRAWN:,} points of a cloud are drawn, chosen at random.",
        f"Distances are those to the nearest point of the other cloud after registration, among {MOST_MEASURED:,} at most.",
        "Overlap is the share of a cloud's surface that has a partner in the other; inlier RMSE is of the partners' distances.",
    ]
    if found.alternatives:
        sentences.append("Confidence, overlap, inlier RMSE and rotation are those of the best pose.")
    if nearer:
        sentences.append("Before registration the clouds are farther apart than they are drawn.")
    if sum(found.dropped):
        sentences.append(f"Not finite, and left out: {found.dropped[0]:,} points of the source, {found.dropped[1]:,} of the target.")
    return " ".join(sentences)
