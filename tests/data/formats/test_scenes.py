"""STL, GLB and 3MF."""

import sys

import numpy as np
import pytest
import trimesh

from cmig_jax.data.formats.scenes import _with_unit

BOX = trimesh.creation.box((1, 2, 3))


def scene() -> trimesh.Scene:
    """Two boxes, one of them placed by the graph, with a colour each."""
    first, second = BOX.copy(), BOX.copy()
    first.visual.face_colors, second.visual.face_colors = [255, 0, 0, 255], [0, 255, 0, 255]
    place = trimesh.transformations.translation_matrix([5, 0, 0])
    made = trimesh.Scene([first])
    made.add_geometry(second, transform=place)
    return made


@pytest.mark.parametrize("suffix", ["stl", "glb", "3mf"])
def test_a_mesh_is_read_and_moved(read, move, matrix, suffix):
    source = read(f"a.{suffix}", BOX.export(file_type=suffix))
    assert source.mesh.area == pytest.approx(22, rel=1e-5)
    _, found = move(source, f"b.{suffix}", matrix)
    np.testing.assert_allclose(found.mesh.bounds, BOX.copy().apply_transform(matrix).bounds, atol=1e-5)
    assert found.mesh.volume == pytest.approx(6, rel=1e-5)


def test_the_parts_of_a_scene_are_placed_and_keep_their_colours(read, move, matrix):
    source = read("a.glb", scene().export(file_type="glb"))
    np.testing.assert_allclose(source.mesh.bounds, [[-0.5, -1, -1.5], [5.5, 1, 1.5]], atol=1e-6)
    path, found = move(source, "b.glb", matrix)
    np.testing.assert_allclose(found.mesh.bounds, scene().apply_transform(matrix).bounds, atol=1e-5)
    again = trimesh.load(path)
    colours = sorted(tuple(part.visual.main_color[:3].tolist()) for part in again.geometry.values())
    assert colours == [(0, 255, 0), (255, 0, 0)]


def test_a_glb_of_points_is_a_cloud(read, cloud):
    found = read("a.glb", trimesh.Scene(trimesh.PointCloud(cloud.points)).export(file_type="glb"))
    assert found.mesh is None
    np.testing.assert_allclose(found.points, cloud.points, atol=1e-6)


def test_the_unit_of_3mf_is_said(read):
    assert read("a.3mf", BOX.export(file_type="3mf")).unit == "millimeter"
    assert read("a.stl", BOX.export(file_type="stl")).unit is None


def test_the_unit_of_3mf_stays(read, move, matrix):
    """The library that writes it knows millimetres only."""
    source = read("a.3mf", _with_unit(BOX.export(file_type="3mf"), "inch"))
    _, found = move(source, "b.3mf", matrix)
    assert (source.unit, found.unit) == ("inch", "inch")
    np.testing.assert_allclose(found.mesh.bounds, BOX.copy().apply_transform(matrix).bounds, atol=1e-5)
    assert move(read("a.glb", BOX.export(file_type="glb")), "c.3mf", matrix)[1].unit == "meter"


def test_stl_as_text(read):
    text = BOX.export(file_type="stl_ascii")
    assert read("a.stl", text).mesh.area == pytest.approx(22)
    with pytest.raises(ValueError, match="no line endsolid"):
        read("a.stl", text[: len(text) // 2])


@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_coordinates_beyond_single_precision_are_refused(read, move, to_utm, tmp_path, suffix):
    with pytest.raises(ValueError, match=rf"b\.{suffix}: {suffix.upper()} has single precision.*expected a file of .ply"):
        move(read("a.ply", BOX.export(file_type="ply")), f"b.{suffix}", to_utm)
    assert not (tmp_path / f"b.{suffix}").exists()


@pytest.mark.parametrize("suffix", ["stl", "glb", "3mf"])
def test_damage_is_named(read, suffix):
    content = BOX.export(file_type=suffix)
    for damaged in (content[:-50], content[:90], content[:10], b"ply\n" * 50):
        with pytest.raises(ValueError, match=f"not a readable {suffix.upper()} file"):
            read(f"a.{suffix}", damaged)
    for empty in (b"\0" * 84, b"solid x\nendsolid x\n"):
        with pytest.raises(ValueError, match=r"a\.stl: .*no triangles"):
            read("a.stl", empty)


def test_an_stl_of_fewer_triangles_than_declared_is_refused(read):
    content = BOX.export(file_type="stl")
    with pytest.raises(ValueError, match="600 bytes of triangles; expected 107374182400 for 2147483648"):
        read("a.stl", content[:80] + (2**31).to_bytes(4, "little") + content[84:])


@pytest.mark.parametrize("library", ["lxml", "networkx"])
def test_what_3mf_needs_is_named(read, monkeypatch, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=r"a\.3mf: .*3MF needs lxml and networkx: pip install 'cmig_jax\[formats\]'"):
        read("a.3mf", b"PK")
