"""The patch transformer: what its pose depends on, its passes, its patches and its losses."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import log_softmax

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.data.render import render_views
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.patches.flags import PatchFlags
from cmig_jax.models.patches.images import PixelFeatures, project
from cmig_jax.models.patches.losses import losses
from cmig_jax.models.patches.network import PATCHES, PatchEncoder, PatchTransformer
from cmig_jax.transform import RigidTransform

from .random_pairs import assert_same, pairs

TINY = PatchFlags(k=4, patch_widths=(6, 8), dim=8, layers=1, heads=2, feed_forward=12, patches=9, test_patches=40, passes=1)
evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


def test_the_order_of_points_and_the_other_pairs_do_not_matter(random_variables):
    network, batch = PatchTransformer(TINY), pairs()
    variables = random_variables(network, batch, train=False)
    whole = evaluate(network, variables, batch)
    orders = np.random.default_rng(1).permutation(17), np.random.default_rng(2).permutation(23)
    permuted = evaluate(network, variables, batch.replace(source=batch.source[:, orders[0]], target=batch.target[:, orders[1]]))
    assert_same(permuted.target_from_source, whole.target_from_source)
    assert_same(
        (permuted.source_overlap, permuted.target_overlap), (whole.source_overlap[:, orders[0]], whole.target_overlap[:, orders[1]])
    )
    alone = evaluate(network, variables, jax.tree.map(lambda x: x[:1].repeat(2, 0), batch))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y[:1].repeat(2, 0), atol=1e-9), alone, whole)


def test_a_moved_cloud_has_the_same_rotation_and_a_moved_translation(random_variables):
    network, batch = PatchTransformer(TINY), pairs()
    variables = random_variables(network, batch, train=False)
    there, far = np.array([3.0, -2.0, 5.0]), np.array([-7.0, 1.0, 0.5])
    pose = jax.tree.map(np.asarray, evaluate(network, variables, batch).target_from_source)
    moved = evaluate(network, variables, batch.replace(source=batch.source + there, target=batch.target + far)).target_from_source
    assert_same(moved, RigidTransform(R=pose.R, t=pose.t + far - pose.R @ there))


def test_passes_are_passes_on_the_moved_source(random_variables):
    batch, once, twice = pairs(), *(PatchTransformer(dataclasses.replace(TINY, layers=2, passes=passes)) for passes in (1, 2))
    variables = random_variables(twice, batch, train=False)
    first = evaluate(once, variables, batch).target_from_source
    second = evaluate(once, variables, batch.replace(source=first.apply(batch.source))).target_from_source
    found = evaluate(twice, variables, batch)
    assert_same(found.target_from_source, second.compose(first))
    assert_same(found.matches.source[0].sum(0), first.apply(batch.source)[0].sum(0))


def test_a_pass_solves_for_means_of_the_target(random_variables):
    network, batch = PatchTransformer(TINY), pairs()
    found = evaluate(network, random_variables(network, batch, train=False), batch)
    matches, chosen = found.matches, found.correspondences
    for i in range(2):
        np.testing.assert_array_equal(matches.source[i], batch.source[i][chosen.source_index[i]])
        share = np.exp(log_softmax(matches.match[i], axis=-1))
        np.testing.assert_allclose(matches.corresponding[i], share @ batch.target[i][chosen.target_index[i]], atol=1e-12)
        np.testing.assert_array_equal(chosen.partner[i], share.argmax(-1))
        weight, x, y = (np.asarray(part[i]) for part in (chosen.weight, matches.source, matches.corresponding))
        centres = weight @ x, weight @ y
        rotation, _ = Rotation.align_vectors(y - centres[1], x - centres[0], weights=weight)
        np.testing.assert_allclose(found.target_from_source.R[i], rotation.as_matrix(), atol=1e-8)
        np.testing.assert_allclose(found.target_from_source.t[i], centres[1] - rotation.apply(centres[0]), atol=1e-8)
        np.testing.assert_allclose(weight, (score := 1 / (1 + np.exp(-matches.source_logit[i]))) / score.sum(), atol=1e-12)
        np.testing.assert_allclose(found.source_overlap[i][chosen.source_index[i]], score, atol=1e-12)


def test_evaluation_draws_the_same_patches_and_training_others(random_variables):
    few = PatchTransformer(dataclasses.replace(TINY, test_patches=9))
    batch = pairs()
    variables = random_variables(few, batch, train=False)
    once, again = (evaluate(few, variables, batch) for _ in range(2))
    assert once.correspondences.source_index.shape == once.correspondences.target_index.shape == (2, 9)
    assert once.source_overlap.shape == (2, 17)
    assert_same(once, again)
    train = jax.jit(lambda key: few.apply(variables, batch, train=True, key=key).correspondences.source_index)
    drawn = [train(jax.random.key(i)) for i in range(2)]
    assert all(len(np.unique(row)) == 9 for index in drawn for row in np.asarray(index))
    assert not np.array_equal(*drawn)


def test_a_patch_is_the_nearest_points_of_the_cloud():
    encoder, cloud, index = PatchEncoder(4, (6, 8), 5), pairs().source, np.array([[3, 11, 0]] * 2)
    variables = encoder.init(jax.random.key(0), cloud, index)
    layers = jax.tree.map(np.asarray, variables["params"])
    feature = encoder.apply(variables, cloud, index)
    for i in range(2):
        for j, point in enumerate(index[0]):
            near = np.argsort(np.linalg.norm(cloud[i] - cloud[i, point], axis=-1))[:4]
            first = 8 * (cloud[i, near] - cloud[i, point]) @ layers["offset"]["kernel"] + layers["offset"]["bias"]
            first = np.maximum(first + cloud[i, point] @ layers["centre"]["kernel"], 0)
            pooled = np.maximum(first @ layers["layer_0"]["kernel"] + layers["layer_0"]["bias"], 0).max(0)
            expected = pooled @ layers["last"]["kernel"] + layers["last"]["bias"] + cloud[i, point] @ layers["position"]["kernel"]
            np.testing.assert_allclose(feature[i, j], expected, atol=1e-12)


def test_the_losses(random_variables):
    flags = dataclasses.replace(TINY, near=0.9, offset_weight=3.0)
    network, batch = PatchTransformer(flags), pairs()
    variables = random_variables(network, batch, train=False)
    found = jax.jit(lambda v: network.apply(v, batch, train=True, key=jax.random.key(1)))(variables)
    terms, matches, truth = losses(found, batch, flags, ComputeConfig()), found.matches, batch.target_from_source
    rows, columns, offsets, entropies = [], [], [], [[], []]
    for i in range(2):
        moved = np.asarray(matches.source[i]) @ truth.R[i].T + truth.t[i]
        distance = np.linalg.norm(moved[:, None] - matches.target[i][None], axis=-1)
        for k in range(9):
            for side, (line, match, logit) in enumerate(
                (
                    (distance[k], matches.match[i][k], matches.source_logit[i][k]),
                    (distance[:, k], matches.match[i][:, k], matches.target_logit[i][k]),
                )
            ):
                near = line.min() < 0.9
                entropies[side].append(np.logaddexp(0, -logit if near else logit))
                if near:
                    (columns if side else rows).append(-log_softmax(match)[line.argmin()])
                    if not side:
                        offsets.append(np.abs(matches.corresponding[i][k] - moved[k]).sum())
    assert 0 < len(rows) < 18
    np.testing.assert_allclose(terms["matching"], np.mean(rows) + np.mean(columns))
    np.testing.assert_allclose(terms["overlap"], np.mean(entropies[0]) + np.mean(entropies[1]))
    np.testing.assert_allclose(terms["offset"], 3 * np.mean(offsets))


def test_pairs_without_overlap_have_finite_losses_and_derivatives():
    network, batch = PatchTransformer(TINY), pairs()
    variables = initial_variables(network, TINY.needs, jax.random.key(0))
    apart = batch.replace(target=batch.target + 100)

    def total(params):
        found = network.apply({"params": params}, apart, train=True, key=jax.random.key(0))
        return sum(losses(found, apart, TINY, ComputeConfig()).values())

    value, gradient = jax.jit(jax.value_and_grad(total))(variables["params"])
    assert np.isfinite(value)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))


@pytest.mark.parametrize("image", ["pixels", "views"])
def test_images_change_the_pose_and_missing_or_other_views_are_named(image, random_variables):
    network = PatchTransformer(dataclasses.replace(TINY, image=image))
    clouds, views = pairs(), np.random.default_rng(0).integers(0, 256, (2, 2, 6, 9, 9, 1)).astype(np.uint8)
    variables = random_variables(network, clouds.replace(views=views), train=False)
    found = [evaluate(network, variables, clouds.replace(views=v)).target_from_source.R for v in (views, 255 - views)]
    assert np.abs(found[0] - found[1]).max() > 1e-6
    for wrong, message in (
        (None, "got None"),
        (views[:, :1], r"got \(2, 1, 6, 9, 9, 1\)"),
        (views[:, :, :5], r"expected \[B, 6, H, W, 1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            predict(network, variables, clouds.replace(views=wrong))


def test_patches_are_projected_as_views_are_rendered():
    cloud = np.random.default_rng(0).normal(size=(300, 3)) * (1, 0.7, 0.4) + (5, 2, -3)
    views = render_views(cloud, layout="axes", count=6, size=32, fit=True)
    row, column, depth = (np.asarray(part[0]) for part in project(jnp.asarray(cloud[None]), np.arange(300)[None], 32))
    for view, r, c, d in zip(views, row, column, depth, strict=True):
        nearest = (view[r, c].astype(float) - 128) / 127
        assert (view[r, c] > 0).all()
        assert (nearest > d - 0.02).all(), "a point is not in front of what its view shows"
        assert (np.abs(nearest - d) < 0.02).sum() > 10, "and many are what it shows"


def test_a_patch_has_the_features_of_the_pixels_that_show_its_centre():
    cloud, index = np.random.default_rng(0).normal(size=(1, 40, 3)), np.arange(40)[None]
    views = render_views(cloud[0], layout="axes", count=6, size=32, fit=True)[None, ..., None]
    module = PixelFeatures(5)
    variables = module.init(jax.random.key(0), views, cloud, index)
    whole = module.apply(variables, views, cloud, index)
    row, column, depth = (np.asarray(part[0]) for part in project(jnp.asarray(cloud), index, 32))
    hidden = [(views[0, v, row[v, 7], column[v, 7], 0] - 128.0) / 127 > depth[v, 7] + 0.1 for v in range(6)]
    assert 0 < sum(hidden) < 6
    for v in range(6):
        changed = views.copy()
        changed[0, v] = 255 - changed[0, v]
        changed[0, v, row[v, 7], column[v, 7]] = views[0, v, row[v, 7], column[v, 7]]
        same = np.allclose(module.apply(variables, changed, cloud, index)[0, 7], whole[0, 7], atol=1e-6)
        assert same == hidden[v]


def test_it_learns():
    flags = dataclasses.replace(TINY, patches=17, near=0.3)
    network, rng = PatchTransformer(flags), np.random.default_rng(0)
    source = rng.normal(size=(4, 17, 3))
    truth = RigidTransform(R=Rotation.from_rotvec(rng.normal(size=(4, 3)) / 3).as_matrix(), t=rng.normal(size=(4, 3)))
    batch = pairs().replace(source=source, target=truth.apply(source), target_from_source=truth)
    params = initial_variables(network, flags.needs, jax.random.key(0))["params"]

    def total(params):
        return sum(
            PATCHES.losses(
                network.apply({"params": params}, batch, train=True, key=jax.random.key(0)), batch, flags, ComputeConfig()
            ).values()
        )

    step = jax.jit(jax.value_and_grad(total))
    first, moments = None, jax.tree.map(jnp.zeros_like, params)
    for _ in range(60):
        value, gradient = step(params)
        first = first or float(value)
        moments = jax.tree.map(lambda m, g: 0.9 * m + g, moments, gradient)
        params = jax.tree.map(lambda p, m: p - 2e-3 * m, params, moments)
    assert value < 0.7 * first


def test_too_few_points_and_bad_flags_are_named():
    network, batch = PatchTransformer(TINY), pairs()
    variables = initial_variables(network, TINY.needs, jax.random.key(0))
    with pytest.raises(ValueError, match=r"at least 4 points \(a patch\) in each cloud, got 3 and 23"):
        predict(network, variables, batch.replace(source=batch.source[:, :3]))
    refused = {"k": 0, "patch_widths": (), "layers": 0, "feed_forward": 0, "patches": 2, "test_patches": 2, "passes": 0, "near": 0.0}
    for flag, value in (refused | {"offset_weight": -1.0, "dim": 30}).items():
        with pytest.raises(FlagError, match=re.escape(f"model.{flag} = {value}") + ".*: expected .+"):
            dataclasses.replace(TINY, heads=4, **{"dim": 8, flag: value})
