"""The pairs of an evaluation: the same for every method and machine."""

from __future__ import annotations

from cmig_jax.config import Config, views_to_prepare
from cmig_jax.data.pairs import Pairs, evenly_spaced, in_categories, training_objects
from cmig_jax.data.prepare import ensure_prepared
from cmig_jax.data.recorded_pairs import RecordedPairs
from cmig_jax.data.recordings import ensure_recordings
from cmig_jax.data.shards import Shards
from cmig_jax.data.sources import source_of


def pairs_to_test(config: Config, limit: int | None = None) -> Pairs | RecordedPairs:
    """Return the pairs to evaluate on: test objects of `data.test_categories`, the objects held out for validation, or recorded pairs.

    Args:
        config: `data`, `views`, and whether the network reads views and normals.
        limit: how many of them, evenly spaced; None: all.

    Raises:
        ValueError: there is no test object, fewer than two training objects to hold some out, recorded pairs with `data.tested =
            validation`, or fewer points per cloud than the network needs.
    """
    data, needs = config.data.as_tested, config.model.needs
    if data.cropped_points < needs.points:
        left = f"data.points = {data.points} leaves {data.cropped_points} points after the crop"
        raise ValueError(f"{left}: expected at least {needs.points}, which the network needs")
    views = config.views if needs.views else None
    if source_of(data).records:
        if data.tested == "validation":
            raise ValueError(f"data.tested = validation with data.source = {data.source}: recorded pairs hold none out; expected test")
        return RecordedPairs(ensure_recordings(data), data, views, limit, normals=needs.normals)
    folder = ensure_prepared(data, views_to_prepare(config))
    if data.tested == "validation":
        objects = Shards(folder, "train")
        chosen = training_objects(objects, data)[1]
    else:
        objects = Shards(folder, "test")
        chosen = in_categories(objects.labels, objects.categories, data.test_categories, data.exclude)
    chosen = chosen[evenly_spaced(len(chosen), limit)]
    if len(chosen) == 0:
        where = f"data.test_categories={data.test_categories} without data.exclude={data.exclude}"
        raise ValueError(f"{folder}: expected test objects in {where}, found none")
    return Pairs(objects, chosen, data, views, data.test_seed, normals=needs.normals)
