"""LAS and LAZ: all attributes stay, and coordinates keep their step."""

import io
import struct
import sys

import numpy as np
import pytest

from cmig_jax.data.geometry_files import read_geometry

laspy = pytest.importorskip("laspy")


def las(points: np.ndarray, intensity: np.ndarray, version: str, *, compressed: bool) -> bytes:
    header = laspy.LasHeader(version=version, point_format=7 if version == "1.4" else 3)
    header.scales, header.offsets = np.full(3, 1e-4), points.min(0).round()
    header.add_extra_dim(laspy.ExtraBytesParams("roughness", "f4"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.intensity, data.classification, data.roughness, data.red = intensity, intensity % 5, intensity / 7, intensity * 2
    file = io.BytesIO()
    data.write(file, do_compress=compressed)
    return file.getvalue()


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_a_move_keeps_every_attribute(read, move, cloud, to_utm, suffix, version):
    intensity = cloud.colours[:, 0]
    points = cloud.points + np.array([300_000, 4_000_000, 50])
    pose = to_utm.copy()
    pose[:3, 3] -= pose[:3, :3] @ [300_000, 4_000_000, 50]
    source = read(f"a.{suffix}", las(points, intensity, version, compressed=suffix == "laz"))
    np.testing.assert_allclose(source.points, points, rtol=0, atol=6e-5)
    for name in (f"b.{suffix}", "c.las", "d.laz"):
        path, found = move(source, name, pose)
        expected = source.points @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(found.points, expected, rtol=0, atol=6e-5)
        data = laspy.read(path)
        assert data.header.are_points_compressed == name.endswith("z")
        np.testing.assert_array_equal(data.intensity, intensity)
        np.testing.assert_array_equal(data.classification, intensity % 5)
        np.testing.assert_array_equal(data.red, intensity * 2)
        np.testing.assert_allclose(data.roughness, intensity / 7, rtol=1e-6)
    np.testing.assert_allclose(source.points, points, rtol=0, atol=6e-5, err_msg="the source is not changed")


def test_a_cloud_becomes_las(read, move, cloud, to_utm):
    source = read("a.xyz", "\n".join(" ".join(map(str, row)) for row in cloud.points.tolist()))
    _, found = move(source, "b.laz", to_utm)
    np.testing.assert_allclose(found.points, cloud.points @ to_utm[:3, :3].T + to_utm[:3, 3], rtol=0, atol=2e-6)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_damage_is_named(read, cloud, suffix):
    content = las(cloud.points, cloud.colours[:, 0], "1.2", compressed=suffix == "laz")
    many = content[:107] + struct.pack("<I", 2**31) + content[111:]
    for damaged in (content[:-20], content[:300], content[:100], b"LASF", many, b"ply\n" * 100):
        with pytest.raises(ValueError, match=f"not a readable {suffix.upper()} file"):
            read(f"a.{suffix}", damaged)


def test_without_laspy_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.laz").write_bytes(b"LASF" * 100)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ValueError, match=r"a\.laz: .*need laspy: pip install 'cmig_jax\[formats\]'"):
        read_geometry(tmp_path / "a.laz")
