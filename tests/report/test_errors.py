"""What is read back from an evaluation."""

import numpy as np
import pytest

from cmig_jax.evaluation import ERRORS, evaluate
from cmig_jax.report.errors import read_errors


@pytest.fixture
def path(tmp_path):
    rng = np.random.default_rng(0)
    pairs = [
        {"source": rng.normal(size=(9, 3)), "target": rng.normal(size=(9, 3)), "R": np.eye(3), "t": np.full(3, 0.1), "index": 40 + i}
        for i in range(3)
    ]
    pairs[1]["label"] = 1

    def still(pairs):
        return np.stack([np.eye(3)] * len(pairs)), np.zeros((len(pairs), 3))

    evaluate(pairs, {"still": still, "network": still}, tmp_path, command="", config={}, progress=False)
    return tmp_path / ERRORS


def test_methods_truth_and_names(path):
    errors = read_errors(path, network="network", overlap=[0.5, 0.6, 0.7], categories=["chair", "lamp"])
    assert list(errors.methods) == ["still", "network"]
    assert len(errors) == 3
    np.testing.assert_allclose(errors.methods["still"].shift, np.sqrt(0.03))
    np.testing.assert_allclose(errors.methods["still"].rotation_deg, 0)
    assert errors.category == ["", "lamp", ""]
    assert errors.index.tolist() == [40, 41, 42]
    assert errors.overlap.tolist() == [0.5, 0.6, 0.7]


@pytest.mark.parametrize(("network", "overlap"), [("net", [0.5] * 3), ("network", [0.5] * 2)])
def test_errors_of_another_evaluation_are_refused(path, network, overlap):
    with pytest.raises(ValueError, match=rf"errors\.npz: expected {network} and {len(overlap)} pairs, found still, network and 3 pairs"):
        read_errors(path, network=network, overlap=overlap, categories=["chair", "lamp"])
