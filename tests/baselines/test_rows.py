"""Which rows there are, and what is said about those that are not."""

import sys

from cmig_jax import baselines
from cmig_jax.config import DataConfig

CORE = ["identity", "ICP (cutoff 0.02)", "ICP (tuned)", "ICP (mean pose)", "GICP"]
EXTRA = ["FPFH + RANSAC", "FGR", "KISS-Matcher"]


def test_every_row_is_there_or_explained(surface):
    rows, absent = baselines.classical(DataConfig()), baselines.missing()
    assert list(rows) == [name for name in CORE + EXTRA if name not in absent]
    assert set(rows) | set(absent) == set(CORE + EXTRA)
    cloud = surface(40, 0)
    for method in rows.values():
        R, t = method.register(cloud, cloud)
        assert R.shape == (3, 3)
        assert t.shape == (3,)


def test_rows_without_their_package_are_left_out_with_the_command_that_brings_them(monkeypatch):
    for package in ("open3d", "kiss_matcher"):
        monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    assert list(baselines.classical(DataConfig())) == CORE
    absent = baselines.missing()
    assert list(absent) == EXTRA
    for package, reason in zip(("open3d", "open3d", "kiss_matcher"), absent.values(), strict=True):
        assert package in reason
        assert "pip install -e '.[baselines]'" in reason


def test_a_package_that_does_not_load_is_explained(monkeypatch):
    def load():
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(baselines, "load_open3d", load)
    assert "FGR" not in baselines.classical(DataConfig())
    assert "libusb-1.0-0" in baselines.missing()["FGR"]


def test_the_functions_are_the_rows(surface):
    source, target = surface(60, 0), surface(50, 1)
    for name, function in {"identity": baselines.identity, "ICP (tuned)": baselines.icp_tuned}.items():
        for one, other in zip(baselines.classical(DataConfig())[name].register(source, target), function(source, target), strict=True):
            assert (one == other).all()
