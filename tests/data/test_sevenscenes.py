"""The paper's 7-Scenes protocol (Table 5): 2,048 points of a fragment, 1,536 after the crop, Office held out."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from cmig_jax.config import Config, DataConfig, ViewsConfig
from cmig_jax.data.pairs import Pairs
from cmig_jax.data.prepare import prepare
from cmig_jax.data.shards import Shards, check_settings

FRAGMENT = 5000


def room(seed: int) -> np.ndarray:
    """Points on the walls of a box, metres, as a fragment has them: not centred, not scaled."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (FRAGMENT, 3))
    axis = rng.integers(0, 3, FRAGMENT)
    points[np.arange(FRAGMENT), axis] = np.sign(points[np.arange(FRAGMENT), axis])
    return points * [2.0, 1.2, 1.5] + [0.5, 0.2, 3.0]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Seven scenes of two ready-made fragments each; a mesh among the clouds."""
    folder = tmp_path_factory.mktemp("scenes")
    for k, scene in enumerate(("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")):
        (folder / scene).mkdir()
        for i in range(2):
            trimesh.PointCloud(room(10 * k + i)).export(folder / scene / f"cloud_bin_{i}.ply")
    trimesh.creation.box((2, 1, 3)).export(folder / "office" / "cloud_bin_1.ply")
    return folder


def flags(root, **views) -> Config:
    return Config(
        data=DataConfig(source="sevenscenes", root=str(root), points=2048, keep=0.75, noise_std=0.0),
        views=ViewsConfig(**{"count": 6, "size": 24, "layout": "axes"} | views),
    )


@pytest.mark.parametrize("of", ["object", "both"])
def test_six_scenes_train_and_the_office_tests(root, tmp_path, of):
    config = flags(root, of=of)
    folder = prepare(config, tmp_path / "out", workers=1, progress=False)
    check_settings(folder, config)
    train, test = Shards(folder, "train"), Shards(folder, "test")
    assert (len(train), len(test)) == (12, 2)
    assert {test.categories[label] for label in test.labels} == {"office"}
    assert "office" not in {train.categories[label] for label in train.labels}
    for pair in Pairs(test, np.arange(2), config, 0):
        assert pair["source"].shape == pair["target"].shape == (1536, 3)
        assert pair["views"].shape == ((1 if of == "object" else 2), 6, 24, 24)
        assert pair["views"].any(axis=(2, 3)).all()


def test_a_fragment_is_normalised_whole_and_subsampled_at_random_without_repetition(root, tmp_path):
    folder = prepare(flags(root, of="both"), tmp_path / "out", workers=1, progress=False)
    points = Shards(folder, "train").points(0)
    whole = room(0) - room(0).mean(0)
    whole /= np.linalg.norm(whole, axis=1).max()
    assert points.shape == (4096, 3)
    distance = np.linalg.norm(points[:200, None] - whole[None], axis=-1)
    assert distance.min(1).max() < 1e-5
    assert len(np.unique(points, axis=0)) == 4096
    assert distance.argmin(1).max() > 0.9 * FRAGMENT  # not the first points of the file


def test_a_fragment_of_too_few_points_is_refused(root, tmp_path):
    config = flags(root, of="both")
    config = replace(config, data=replace(config.data, points=5001))
    folder = prepare(config, tmp_path / "out", workers=1, progress=False)
    with pytest.raises(ValueError, match=r"needs 5001 points of every object, but .* has objects of 5000"):
        check_settings(folder, config)
