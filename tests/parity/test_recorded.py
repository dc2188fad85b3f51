"""The recorded format: weights by name and seed, reading, writing, refusing."""

import numpy as np
import pytest

from cmig_jax.parity.recorded import Case, condensed, named_weights, random_inputs, read_case, recorded_form, write_case


def test_weights_depend_on_name_and_seed_alone():
    shapes = {
        "a.weight": (4, 3),
        "a.bias": (4,),
        "bn.weight": (4,),
        "bn.running_var": (4,),
        "bn.num_batches_tracked": (),
        "head.reflect": (3, 3),
    }
    first, again = named_weights(shapes, 0), named_weights(dict(reversed(shapes.items())), 0)
    assert all(np.array_equal(first[name], again[name]) for name in shapes)
    assert not np.array_equal(first["a.weight"], named_weights(shapes, 1)["a.weight"])
    assert (first["bn.running_var"] >= 1).all()
    assert np.array_equal(first["head.reflect"], np.diag([1, 1, -1]))
    assert first["bn.num_batches_tracked"].dtype == np.int64


def test_known_weights():
    weights = named_weights({"h3.6.weight": (1, 4, 1), "h3.6.bias": (1,)}, 0)
    assert weights["h3.6.weight"].ravel() == pytest.approx([-0.22457108, -0.73310759, -0.33217256, 0.70139021])
    assert weights["h3.6.bias"] == pytest.approx([0.05550615])


def test_a_case_survives_writing(tmp_path):
    inputs = random_inputs(0, pairs=2, points=24, views=1, size=16)
    case = Case(inputs, {"it0/logit": np.zeros((2, 6)), "it1/logit": np.zeros((2, 6)), "R": np.zeros((2, 3, 3)), "t": np.zeros((2, 3))})
    write_case(tmp_path / "case.npz", case)
    read = read_case(tmp_path / "case.npz")
    assert np.array_equal(read.inputs.src, inputs.src)
    assert read.inputs.src_idx is None
    assert (read.training, read.keypoints, read.iterations) == (False, 6, 2)


def test_inputs_obey_the_true_pose():
    inputs = random_inputs(3, pairs=2, points=60, views=2, size=20)
    assert inputs.views.shape == (2, 2, 3, 20, 20)
    moved = inputs.R_gt @ inputs.src + inputs.t_gt[..., None]
    nearest = np.linalg.norm(moved[:, :, :, None] - inputs.tgt[:, :, None, :], axis=1).min(2)
    assert nearest.max() < 0.05


def test_condensed_forms_are_found_again():
    value = np.arange(2 * 4 * 1000.0).reshape(2, 4, 1000)
    kept = condensed({"feat_src": value, "feat_views": value[0], "it0/R": value})
    assert set(kept) == {"feat_src/stats", "feat_src/head", "feat_views", "it0/R"}
    assert all(np.array_equal(recorded_form(key, {"feat_src": value, "feat_views": value[0], "it0/R": value}), kept[key]) for key in kept)
    assert recorded_form("feat_src/tail", {"feat_src": value}) is None


def test_files_that_are_no_case_are_refused(tmp_path):
    text, whole, cut, other = (tmp_path / name for name in ("text.npz", "whole.npz", "cut.npz", "other.npz"))
    text.write_text("not numpy")
    np.savez(other, src=np.zeros((2, 3, 5)))
    inputs = random_inputs(0, pairs=1, points=24, views=1, size=16)
    write_case(whole, Case(inputs, {"it0/logit": np.zeros((1, 6)), "R": np.zeros((1, 3, 3)), "t": np.zeros((1, 3))}))
    cut.write_bytes(whole.read_bytes()[:2000])
    for path in (text, cut, tmp_path / "absent.npz"):
        with pytest.raises(ValueError, match="expected a recorded case"):
            read_case(path)
    with pytest.raises(ValueError, match="no tgt, views, R_gt, t_gt, it0/logit, R, t"):
        read_case(other)
    np.savez(other, **(dict(np.load(whole)) | {"views": np.zeros((1, 3, 16, 16))}))
    with pytest.raises(ValueError, match=r"views has shape \(1, 3, 16, 16\), expected"):
        read_case(other)
