"""Every flag gives a network that trains and evaluates; inputs that it cannot use are named; compute flags keep types and memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.models.cmignet.network import CMIGNet

BFLOAT16 = ComputeConfig(precision="bfloat16")


def traced(net, batch, train):
    """Trace the network: the shapes of its variables and of its prediction."""
    prediction, variables = jax.eval_shape(lambda key, b: net.init_with_output(key, b, train=train, key=key), jax.random.key(0), batch)
    return variables, prediction


OTHER = {"score_from": "other", "activation": "sigmoid"}
VARIANTS = {
    "paper": {},
    "released": {"fusion": {"image": "transformer"}, "keypoints": OTHER, "pose": {"centroid": "unweighted"}},
    "views": {"fusion": {"image": "views"}, "loss": {"cross_modal": "nt-xent"}},
    "no image, but its loss": {"fusion": {"image": "none"}, "loss": {"cross_modal": "paper"}},
    "no image": {"fusion": {"image": "none"}},
    "no transformer": {"fusion": {"points": "none"}},
    "no fusion": {"fusion": {"points": "none", "image": "none"}},
    "idam": {"matching": {"head": "idam"}},
    "idam in rows": {"matching": {"head": "idam"}, "compute": ComputeConfig(rows=13)},
    "pcrnet": {"matching": {"head": "pcrnet"}},
    "random": {"keypoints": {"select": "random"}},
    "all": {"keypoints": {"select": "all"}},
    "all in rows": {"keypoints": {"select": "all"}, "compute": ComputeConfig(rows=13)},
    "soft": {"matching": {"correspondence": "soft"}},
    "Sinkhorn": {"matching": {"correspondence": "sinkhorn"}},
    "features anew": {"matching": {"features": "anew"}},
    "overlap scores": {"keypoints": {"target": "overlap"}},
    "point pairs": {"points": {"local": "pairs", "local_widths": (8,)}},
    "point pairs anew": {"points": {"local": "pairs", "local_widths": (8,)}, "matching": {"features": "anew"}},
    "through": {"pose": {"gradient": "through"}},
    "bfloat16": {"compute": BFLOAT16, "fusion": {"image": "views"}},
    "bfloat16 idam": {"compute": BFLOAT16, "matching": {"head": "idam"}, "fusion": {"image": "transformer"}},
    "bfloat16 pcrnet": {"compute": BFLOAT16, "matching": {"head": "pcrnet"}, "fusion": {"points": "none"}},
}


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_trains_and_evaluates_in_float32(name, tiny_flags, pairs):
    groups = dict(VARIANTS[name])
    compute, flags = groups.pop("compute", ComputeConfig()), tiny_flags(**groups)
    net, batch = CMIGNet(flags, compute), pairs(60, 60 if flags.needs.equal_sizes else 50, sets=2, dtype=np.float32)
    if flags.needs.normals:
        batch = batch.replace(source_normals=batch.source, target_normals=batch.target)
    variables, trained = traced(net, batch, True)
    evaluated = jax.eval_shape(lambda v: net.apply(v, batch, train=False), variables)
    K = [60, 50] if flags.keypoints.select == "all" else [32, 32]
    for prediction in (trained, evaluated):
        assert {x.dtype for x in jax.tree.leaves(prediction) if jnp.issubdtype(x.dtype, jnp.floating)} == {jnp.dtype("float32")}
        assert (prediction.target_from_source.R.shape, prediction.target_from_source.t.shape) == ((2, 3, 3), (2, 3))
        assert prediction.keypoints.source_index.shape == (2, K[0])
        assert len(prediction.iterations) == 2
        assert (prediction.source_scores is None) == (flags.keypoints.select != "predicted")
        assert (prediction.correspondences is None) == (flags.matching.head == "pcrnet")
        if flags.matching.head != "pcrnet":
            assert prediction.iterations[1].match.shape == (2, *K)
            assert prediction.correspondences.partner.shape == prediction.correspondences.weight.shape == (2, K[0])
    assert trained.keypoints.match_index.shape == (2, K[0])
    assert evaluated.keypoints.match_index is None
    reads = flags.fusion.image != "none"
    assert [x.image_features is not None for x in (trained, evaluated)] == [reads or flags.loss.cross_modal != "off", reads]
    assert {x.dtype for x in jax.tree.leaves(variables)} == {jnp.dtype("float32")}, "parameters and statistics stay in float32"


def test_tied_image_fusion_has_no_weights_of_its_own(tiny_flags, pairs):
    tied, none = (traced(CMIGNet(tiny_flags(fusion={"image": image})), pairs(), False)[0]["params"] for image in ("transformer", "none"))
    assert set(tied) - set(none) == {"views"}


def test_repeats_use_the_weights_of_the_last_iteration_in_evaluation_only(tiny_flags, pairs):
    once, repeated = (CMIGNet(tiny_flags(matching={"repeats": repeats})) for repeats in (0, 3))
    batch = pairs(dtype=np.float32)
    (variables, _), (same, trained) = traced(once, batch, True), traced(repeated, batch, True)
    assert variables == same
    assert len(trained.iterations) == 2
    assert len(jax.eval_shape(lambda v: repeated.apply(v, batch, train=False), variables).iterations) == 5


def test_bfloat16_gives_a_rotation_in_float32(tiny_flags, pairs, random_variables):
    flags, batch = tiny_flags(fusion={"points": "none", "image": "none"}), pairs(40, 40, dtype=np.float32)
    net = CMIGNet(flags, BFLOAT16)
    variables = random_variables(net, batch, dtype=np.float32, train=False)
    pose = jax.jit(lambda v, b: net.apply(v, b, train=False).target_from_source)(variables, batch)
    assert pose.R.dtype == pose.t.dtype == jnp.float32
    np.testing.assert_allclose(pose.R @ pose.R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-5)


def test_scores_of_the_other_cloud_need_clouds_of_equal_size(tiny_flags, pairs):
    with pytest.raises(ValueError, match=r"score_from=other .*expected N = M, got 70 and 90 points"):
        traced(CMIGNet(tiny_flags(keypoints={"score_from": "other"})), pairs(), False)


@pytest.mark.parametrize(("missing", "message"), [("views", r"batch\.views"), ("target_from_source", r"batch\.target_from_source")])
def test_a_missing_input_is_named(missing, message, tiny_flags, pairs):
    with pytest.raises(ValueError, match=f"expected {message}, got None"):
        traced(CMIGNet(tiny_flags()), pairs().replace(**{missing: None}), True)


def test_training_needs_a_key_or_source_keypoints(tiny_flags, pairs):
    net, index = CMIGNet(tiny_flags()), np.arange(64).reshape(2, 32)
    with pytest.raises(ValueError, match="expected a key or source_index"):
        jax.eval_shape(lambda b: net.init(jax.random.key(0), b, train=True), pairs())
    given = jax.eval_shape(lambda b: net.init_with_output(jax.random.key(0), b, train=True, source_index=index)[0], pairs())
    assert given.keypoints.source_index.shape == (2, 32)


def test_recomputing_keeps_less_for_the_derivative_of_the_same_variables(tiny_flags, pairs):
    flags = tiny_flags(fusion={"image": "transformer"}, loss={"cross_modal": "nt-xent"})
    batch = pairs(70, 70, dtype=np.float32)

    def kept(recompute):
        net = CMIGNet(flags, ComputeConfig(recompute=recompute))
        variables = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), traced(net, batch, True)[0])

        def loss(params):
            prediction, _ = net.apply({**variables, "params": params}, batch, train=True, key=jax.random.key(1), mutable=["batch_stats"])
            return sum(jnp.sum(i.match) + jnp.sum(i.logit) for i in prediction.iterations)

        pull = jax.eval_shape(lambda params: jax.vjp(loss, params)[1], variables["params"])
        return jax.tree.structure(variables), sum(x.size for x in jax.tree.leaves(pull))

    (without, more), (with_it, less) = kept(False), kept(True)
    assert without == with_it
    assert less < more / 2
