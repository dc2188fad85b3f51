"""What is read back from an evaluation."""

import numpy as np
import pytest

from cmig_jax.evaluation.engine import ERRORS, evaluate
from cmig_jax.evaluation.errors import read_errors
from cmig_jax.transform import RigidTransform


@pytest.fixture
def path(tmp_path):
    rng = np.random.default_rng(0)
    pairs = [
        {"source": rng.normal(size=(9, 3)), "target": rng.normal(size=(9, 3)), "R": np.eye(3), "t": np.full(3, 0.1), "index": 40 + i}
        for i in range(3)
    ]
    pairs[1]["label"], pairs[2]["overlap"] = 1, 0.7

    def still(pairs):
        return RigidTransform.identity((len(pairs),))

    evaluate(pairs, {"still": still, "network": still}, tmp_path, command="", config={}, progress=False)
    return tmp_path / ERRORS


def test_methods_truth_and_names(path):
    errors = read_errors(path, network="network", categories=["chair", "lamp"])
    assert list(errors.methods) == ["still", "network"]
    assert len(errors) == 3
    np.testing.assert_allclose(errors.methods["still"].shift, np.sqrt(0.03))
    np.testing.assert_allclose(errors.methods["still"].rotation_deg, 0)
    assert errors.category == ["", "lamp", ""]
    assert errors.overlap[2] == 0.7
    assert (errors.overlap[:2] < 0.7).all(), "measured, where the data set does not know it"


def test_errors_of_another_network_are_refused(path):
    with pytest.raises(ValueError, match=r"errors\.npz: expected a row net, found still, network"):
        read_errors(path, network="net", categories=["chair", "lamp"])
