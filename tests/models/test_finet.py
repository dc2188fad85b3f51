"""FINet: what its branches see of each other and of a motion, and the losses of that."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.finet.network import FINET, Encoder, FINetFlags, FINetPrediction, Probes, Stage, Step, losses, sensitivity
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

FLAGS = FINetFlags(iterations=3, encoder_widths=(4, 8), exchange_after=(1,), fusion_widths=(12,), regression_widths=(8,))


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    pose = RigidTransform(R=Rotation.random(3, rng=rng).as_matrix(), t=rng.normal(size=(3, 3)))
    source = rng.normal(size=(3, 24, 3))
    with jax.enable_x64(True):
        return jax.tree.map(jnp.asarray, Batch(source=source, target=pose.apply(source)[:, :20], target_from_source=pose))


def terms_of(flags, batch, key):
    """Return the names of the losses of a training pass, which is not run."""

    def run(key):
        module = FINET.build(flags, ComputeConfig())
        prediction, _ = module.init_with_output(jax.random.key(0), batch, train=True, key=key)
        return losses(prediction, batch, flags, ComputeConfig())

    return set(jax.eval_shape(run, key))


def encode(flags, source, target, train=False):
    encoder = Encoder(flags, ComputeConfig())
    variables = encoder.init(jax.random.key(0), (source, target), train=False)
    variables = jax.tree.map(lambda x: x.astype(jnp.float64), variables)
    return encoder.apply(variables, (source, target), train=train, mutable=["batch_stats"])[0]


def test_clouds_exchange_features_and_the_exchange_has_no_gradient(batch):
    def of_source(target, flags):
        return encode(flags, batch.source, target)[0]

    apart = dataclasses.replace(FLAGS, exchange_after=())
    change = [np.abs(of_source(batch.target, flags) - of_source(batch.target + 1, flags)).max(axis=(0, 1)) for flags in (FLAGS, apart)]
    assert not np.any(change[0][:4])  # the first layer
    assert np.any(change[0][4:])
    assert not np.any(change[1])
    gradient = jax.grad(lambda target: jnp.sum(of_source(target, FLAGS)))(batch.target)
    assert not np.any(gradient)


def test_both_clouds_are_one_batch_for_the_statistics(batch):
    apart = dataclasses.replace(FLAGS, exchange_after=())
    two, one = encode(apart, batch.source, batch.target, True), encode(apart, batch.source[:, :4], batch.source[:, 4:], True)
    whole = encode(apart, batch.source[:, :12], batch.source[:, 12:], True)
    np.testing.assert_allclose(jnp.concatenate(one, axis=1), jnp.concatenate(whole, axis=1), atol=1e-12)
    assert np.abs(two[0][:, :4] - one[0]).max() > 1e-3


def test_terms_belong_to_the_first_iterations_and_can_be_off(batch):
    pose = {f"{name}_{i}" for name in ("quaternion", "translation") for i in range(3)}
    key = jax.random.key(0)
    assert terms_of(FLAGS, batch, key) == pose | {f"{name}_{i}" for name in ("sensitivity", "dropout") for i in range(2)}
    assert terms_of(dataclasses.replace(FLAGS, dropout_weight=0.0, regularised=1), batch, None) == pose | {"sensitivity_0"}
    assert terms_of(dataclasses.replace(FLAGS, sensitivity_weight=0.0, regularised=1), batch, key) == pose | {"dropout_0"}
    with pytest.raises(ValueError, match="expected a key, got None"):
        terms_of(FLAGS, batch, None)


def test_leaving_out_no_points_changes_nothing_and_few_points_lower_the_maximum(batch, random_variables):
    inputs = batch.source, batch.target, jax.random.key(0)
    variables = random_variables(Stage(FLAGS), *inputs, train=False, probed=False)
    for share in (0.0, 0.7):
        flags = dataclasses.replace(FLAGS, dropout=share, sensitivity_weight=0.0)
        stage = Stage(flags)
        run = jax.jit(lambda x, stage=stage: stage.apply(x, *inputs, train=False, probed=True))
        pose, probes = run(variables)
        difference = probes.whole - probes.thinned
        assert np.all(difference >= 0)
        assert np.any(difference) == (share > 0)
        prediction = FINetPrediction(target_from_source=pose.transform(), steps=(Step(pose, probes),))
        assert losses(prediction, batch, flags, ComputeConfig())["dropout_0"] == pytest.approx(0.0025 * np.mean(difference**2))


def test_probes_are_of_the_rotated_and_of_the_translated_source(batch, random_variables):
    inputs = batch.source, batch.target
    flags = dataclasses.replace(FLAGS, dropout_weight=0.0)
    variables = random_variables(Stage(flags), *inputs, None, train=False, probed=False)
    run = jax.jit(lambda x, y: Stage(flags).apply(variables, x, y, None, train=False, probed=True))
    pose, probes = run(*inputs)
    turn = pose.transform()
    rotated = run(jnp.einsum("bij,bnj->bni", turn.R, batch.source), batch.target)[1].whole[:, :, 0]
    translated = run(batch.source + turn.t[:, None], batch.target)[1].whole[:, :, 0]
    np.testing.assert_allclose(probes.rotated, rotated, atol=1e-10)
    np.testing.assert_allclose(probes.translated, translated, atol=1e-10)


def test_sensitivity_wants_change_under_a_branchs_own_motion_alone():
    whole = jnp.asarray(np.random.default_rng(0).normal(size=(3, 2, 2, 5)))
    source = whole[:, :, 0]
    own = jnp.asarray([1.0, 0.0])[None, :, None]  # rotation, translation
    ideal = Probes(whole, rotated=source + own, translated=source + own[:, ::-1])
    assert sensitivity(ideal, 0.01) == 0
    assert sensitivity(Probes(whole, rotated=source, translated=source), 0.01) == pytest.approx(0.02)
    assert sensitivity(Probes(whole, rotated=source + 1 - own, translated=source + own), 0.01) == pytest.approx(2.02)


def test_evaluation_needs_no_key_and_makes_no_probes(batch):
    module = FINET.build(FLAGS, ComputeConfig())
    prediction = jax.eval_shape(lambda key: predict(module, initial_variables(module, FLAGS.needs, key), batch), jax.random.key(3))
    assert all(step.probes is None for step in prediction.steps)
    assert prediction.source_overlap is None
