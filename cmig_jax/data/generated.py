"""Generated objects of 40 categories, with which everything runs without a download.

They replace ModelNet40 in the protocols of Sec. IV: labels 0 to 19 are the categories to train on, 20 to 39 the unseen ones. Each half
has four categories of every family (furniture, vessels, vehicles, fittings, tools).
"""

from __future__ import annotations

import numpy as np
import trimesh

from cmig_jax.data.catalogue import craft, fittings, furniture, tools, vehicles, vessels

_FIRST_HALF = (
    *(furniture.chair, furniture.table, furniture.bookshelf, furniture.sofa),
    *(vessels.mug, vessels.teapot, vessels.bucket, vessels.saucepan),
    *(vehicles.car, craft.airplane, craft.boat, vehicles.truck),
    *(fittings.tap, fittings.valve, fittings.bracket, fittings.hook),
    *(tools.hammer, tools.wrench, tools.saw, tools.drill),
)
_SECOND_HALF = (
    *(furniture.bed, furniture.desk, furniture.cabinet, furniture.piano),
    *(vessels.jug, vessels.watering_can, vessels.bathtub, vessels.spray_bottle),
    *(vehicles.bicycle, craft.helicopter, vehicles.tractor, vehicles.locomotive),
    *(fittings.hinge, fittings.door_handle, fittings.shower, fittings.wall_lamp),
    *(tools.axe, tools.pliers, tools.plane, tools.shovel),
)
_MAKERS = _FIRST_HALF + _SECOND_HALF

CATEGORIES: tuple[str, ...] = tuple(maker.__name__ for maker in _MAKERS)


def make_object(label: int, rng: np.random.Generator) -> trimesh.Trimesh:
    """Make one object of a category.

    Args:
        label: index into `CATEGORIES`.
        rng: random generator; the object is a function of the label and of this generator's state.

    Returns:
        A mesh of closed, outward-facing, possibly overlapping parts, z up, in any unit (`data.sample` normalises it).

    Raises:
        ValueError: the label is not 0 to 39.
    """
    if not 0 <= label < len(_MAKERS):
        raise ValueError(f"label = {label}: expected 0 to {len(_MAKERS) - 1}")
    parts = _MAKERS[label](rng)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    # Objects of a category with the same options still differ in their proportions.
    stretch = np.exp(rng.uniform(-0.15, 0.15, 3))
    return trimesh.Trimesh(vertices * stretch, faces, process=False)
