"""The rows of the methods without learning, and the reasons for rows that are left out."""

import sys

import numpy as np

from cmig_jax import baselines
from cmig_jax.config import DataConfig

CORE = ["identity", "ICP (cutoff 0.02)", "ICP (tuned)", "ICP (mean pose)", "GICP"]
EXTRA = ["FPFH + RANSAC", "FGR", "KISS-Matcher"]


def test_every_row_is_there_or_has_a_reason(surface):
    rows, absent = baselines.classical(DataConfig()), baselines.missing()
    assert list(rows) == [name for name in CORE + EXTRA if name not in absent]
    assert set(rows) | set(absent) == set(CORE + EXTRA)
    cloud = surface(40, 0)
    for method in rows.values():
        pose = method.register(cloud, cloud)
        assert (pose.R.shape, pose.t.shape) == ((3, 3), (3,))
        assert isinstance(pose.R, np.ndarray)


def test_rows_without_their_package_are_left_out_with_the_command_that_installs_it(monkeypatch):
    for package in ("open3d", "kiss_matcher"):
        monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    assert list(baselines.classical(DataConfig())) == CORE
    absent = baselines.missing()
    assert list(absent) == EXTRA
    for package, reason in zip(("open3d", "open3d", "kiss_matcher"), absent.values(), strict=True):
        assert package in reason
        assert "pip install 'cmig_jax[baselines]'" in reason


def test_a_package_that_does_not_load_has_its_reason(monkeypatch):
    def load():
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(baselines, "load_open3d", load)
    assert "FGR" not in baselines.classical(DataConfig())
    assert "libusb-1.0-0" in baselines.missing()["FGR"]


def test_the_mean_pose_is_that_of_the_protocol():
    starts = [
        baselines.classical(data)["ICP (mean pose)"].settings["start_angle_deg"]
        for data in (DataConfig(), DataConfig(max_angle_deg=90.0), DataConfig(turn="either"), DataConfig(source="stanford-scans"))
    ]
    assert starts == [22.5, 45.0, 0.0, 0.0]
