"""The page of a registration holds both clouds to single precision of their extent, says the verdict, and its controls change the view."""

import base64
import dataclasses
import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.registration.result import Registration
from cmig_jax.report.registration_page import LEVELS, MOST_DRAWN, write_registration_page
from cmig_jax.transform import RigidTransform

UTM = np.array([500_000.0, 5_000_000.0, 100.0])


def make_clouds(count: int = 300, offset=0.0):
    """Return a source, a target that shares its points, and the pose."""
    rng = np.random.default_rng(0)
    target = rng.normal(size=(count, 3)) * [3, 2, 1] + offset
    R = Rotation.from_euler("zyx", [120, 20, 30], degrees=True).as_matrix()
    pose = RigidTransform(R=R, t=np.array([1.0, 2.0, 3.0]) + offset)
    return (target - pose.t) @ R, target, pose


def registration(pose: RigidTransform, count: int = 300, **changed) -> Registration:
    """Return a registration with one alternative, turned by half a turn about x."""
    half = np.diag([1.0, -1, -1])
    other = RigidTransform(R=half @ pose.R, t=half @ pose.t)
    values = {
        "target_from_source": pose,
        "trusted": True,
        "why": "aligned",
        "confidence": 0.87,
        "overlap": (0.9, 0.4),
        "inlier_rmse": 0.0123456,
        "correspondences": np.stack([np.arange(count)] * 2, axis=1),
        "information": np.eye(6),
        "alternatives": (other,),
        "dropped": (0, 0),
        "seconds": {"clouds": 0.1, "search": 1.25},
    }
    return Registration(**values | changed)


def decoded(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 3).astype(np.float64)


def data_of(page):
    return json.loads(page.text("script")[0])


@pytest.fixture
def written(tmp_path, read_page):
    """Write a page and read it."""

    def write(source, target, found, *names, **options):
        write_registration_page(tmp_path / "page.html", source, target, found, *names, **options)
        assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
        return read_page(tmp_path / "page.html")

    return write


@pytest.mark.parametrize("offset", [0.0, UTM])
def test_the_data_are_the_clouds_and_poses_at_any_offset(written, offset):
    source, target, pose = make_clouds(offset=offset)
    found = registration(pose)
    data = data_of(written(source, target, found))
    stored = [decoded(cloud["points"]) for cloud in data["clouds"]]
    centres = [np.median(cloud, axis=0) for cloud in (source, target)]
    for cloud, centre, points in zip((source, target), centres, stored, strict=True):
        np.testing.assert_allclose(points + centre, cloud, rtol=0, atol=2e-6)
    for stored_pose, true in zip(data["poses"], (pose, *found.alternatives), strict=True):
        moved = stored[0] @ Rotation.from_rotvec(stored_pose["turn"]).as_matrix().T + stored_pose["at"] + centres[1]
        np.testing.assert_allclose(moved, true.apply(source), rtol=0, atol=4e-6)
    pairs = [decoded(cloud["matched"]) for cloud in data["clouds"]]
    assert len(pairs[0]) == len(pairs[1]) == 100
    np.testing.assert_allclose(pose.apply(pairs[0] + centres[0]), pairs[1] + centres[1], rtol=0, atol=4e-6)


def test_the_page_asks_for_nothing_and_says_the_result(written):
    source, target, pose = make_clouds()
    page = written(source, target, registration(pose, dropped=(7, 0)), ("a.ply", "b.ply"))
    page.asks_for_nothing()
    assert page.text("h1") == ["a.ply onto b.ply"]
    assert "a.ply onto b.ply" in page.text("title")[0]
    assert "trusted" in page.text("strong")
    assert "aligned" in "".join(page.text("p"))
    said = " ".join([*page.text("dd"), *page.text("td"), *page.text("small"), *page.text("p")])
    angle = f"{np.degrees(pose.angle()):.2f}°"
    for part in ("0.87", "0.01235", "300", "90%", "40%", "1.35", "search 1.25", angle, "7 points of the source"):
        assert part in said, part
    first, second = (np.array([row.split() for row in (pre["data-full"] or "").split("\n")], float) for pre in page.all("pre"))
    np.testing.assert_array_equal(first, pose.as_matrix())
    np.testing.assert_array_equal(second[:3, 3], pose.t * [1, -1, -1])
    np.testing.assert_allclose(np.array(page.text("pre")[0].split(), float).reshape(4, 4), pose.as_matrix(), atol=1e-6)


def test_what_is_not_trusted_says_so(written):
    source, target, pose = make_clouds()
    found = registration(pose, trusted=False, why="the clouds share <too> little", inlier_rmse=float("inf"), alternatives=())
    page = written(source, target, dataclasses.replace(found, correspondences=np.zeros((0, 2), np.int64)))
    assert page.text("strong") == ["not trusted"]
    assert "the clouds share <too> little" in "".join(page.text("p"))
    assert "no partners" in page.text("dd")
    assert len(page.all("option")) == len(page.all("pre")) == 1


def test_a_hostile_name_stays_text(written, hostile):
    source, target, pose = make_clouds()
    page = written(source, target, registration(pose), (hostile, "b.ply"))
    assert [attributes.get("type") for attributes in page.all("script")] == ["application/json", None]
    assert not page.all("img")
    assert page.text("h1") == [f"{hostile} onto b.ply"]
    assert any(hostile in text for text in page.text("th"))


def test_distances_are_those_to_the_other_cloud(written):
    """Under the right pose points of one cloud alone have the last colour; under another pose, most do."""
    source, target, pose = make_clouds(2000)
    best, other = data_of(written(source[:1500], target[500:], registration(pose, 500)))["poses"]
    shades = [np.frombuffer(base64.b64decode(text), np.uint8) for text in (*best["shades"], *other["shades"])]
    assert (shades[0][500:] == 0).all()
    assert (shades[1][:1000] == 0).all()
    assert np.median(shades[0][:500]) == LEVELS - 1
    assert np.median(shades[2]) == LEVELS - 1
    assert max(map(np.max, shades)) == LEVELS - 1


def test_large_clouds_are_thinned_and_the_page_is_bounded(tmp_path, written):
    source, target, pose = make_clouds(60_000)
    alternative = registration(pose).alternatives[0]
    page = written(source, target, registration(pose, 60_000, alternatives=(alternative,) * 8))
    assert [len(decoded(cloud["points"])) for cloud in data_of(page)["clouds"]] == [MOST_DRAWN] * 2
    assert page.text("td")[:2] == ["60,000", "20,000"]
    assert (tmp_path / "page.html").stat().st_size < 1_500_000


def test_stray_points_and_clouds_far_apart_do_not_shrink_the_view(written):
    source, target, pose = make_clouds(offset=UTM)
    source = source - pose.R.T @ UTM  # in a frame of its own
    pose = dataclasses.replace(pose, t=pose.t - UTM + pose.R @ (pose.R.T @ UTM))
    target[0] += 1000
    page = written(source, target, registration(pose))
    data = data_of(page)
    assert data["clouds"][1]["radius"] < 30
    assert 10 < np.linalg.norm(data["before"]) < 100
    assert "farther apart than they are drawn" in "".join(page.text("p"))


def test_rows_that_are_not_finite_are_not_drawn(written):
    source, target, pose = make_clouds()
    source = np.insert(source, [0, 10], np.nan, axis=0)
    rows = np.flatnonzero(np.isfinite(source).all(axis=1))
    page = written(source, target, registration(pose, correspondences=np.stack([rows, np.arange(300)], axis=1)))
    cloud, matched = (decoded(data_of(page)["clouds"][0][name]) for name in ("points", "matched"))
    assert len(cloud) == 300
    assert np.isfinite(matched).all()
    assert page.text("td")[0] == "300"


PROBE = """
  const found = { texts: [] };
  const picture = () => { drawAll(); return canvas.toDataURL(); };
  const record = () => found.texts.push([control("shown").textContent, document.querySelector("[data-pose]:not([hidden])").dataset.pose]);
  const change = (name, act) => {
    const before = picture();
    act();
    found[name] = picture() !== before;
  };
  const send = (type, kind, options) => canvas.dispatchEvent(new kind(type, { bubbles: true, cancelable: true, ...options }));
  const drag = (options) => {
    send("pointerdown", PointerEvent, { pointerId: 1, clientX: 50, clientY: 50, ...options });
    send("pointermove", PointerEvent, { pointerId: 1, clientX: 90, clientY: 70, ...options });
    send("pointerup", PointerEvent, { pointerId: 1, ...options });
  };
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  canvas.setPointerCapture = () => {};
  const initial = picture();
  record();
  change("nothing", () => {});
  change("drag", () => drag({}));
  const turned = view.turn;
  change("shift drag", () => drag({ shiftKey: true }));
  change("wheel", () => send("wheel", WheelEvent, { deltaY: -100 }));
  change("shift arrow", () => send("keydown", KeyboardEvent, { key: "ArrowLeft", shiftKey: true }));
  found.moved = view.turn === turned && view.at.every((value) => value !== 0);
  control("reset").click();
  found.reset = picture() === initial;
  for (const id of ["source", "target", "matches", "distance"]) {
    change(id, () => control(id).click());
    control(id).click();
  }
  change("slider", () => { control("share").value = 0.5; control("share").dispatchEvent(new Event("input")); });
  record();
  const halfway = picture();
  control("before").click();
  await wait(800);
  found.before = picture() !== halfway;
  record();
  send("keydown", KeyboardEvent, { key: " " });
  await wait(800);
  found.after = picture() === initial;
  change("alternative", () => { control("pose").value = 1; control("pose").dispatchEvent(new Event("change")); });
  record();
  control("distance").click();
  change("distances", () => { poses[1].shades[0].fill(0); });
  found.disabled = control("matches").disabled;
  found.up = ["x", "y", "z"].map((up) => { const t = camera(up).turn.slice(3, 6); return t.indexOf(Math.max(...t)); });
  found.place = Array.from(moved(source, placed(poses[0], 1)).slice(0, 3));
  found.start = Array.from(moved(source, placed(poses[0], 0)).slice(0, 3));
  await copy();
  found.copied = control("copy").textContent;
"""


@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_in_a_browser(tmp_path, in_browser, width):
    source, target, pose = make_clouds()
    source = source + UTM
    pose = dataclasses.replace(pose, t=pose.t - pose.R @ UTM)
    write_registration_page(tmp_path / "page.html", source, target, registration(pose), ("a" * 80, "b.ply"), up="y")
    found = in_browser(tmp_path / "page.html", PROBE, width)
    texts, up, place, start = (found.pop(name) for name in ("texts", "up", "place", "start"))
    assert [text.split(",")[0] for text, _ in texts] == ["after", "on the way", "before", "after"]
    assert [shown for _, shown in texts] == ["0", "0", "0", "1"]
    assert re.fullmatch(r"after, alternative 1: 180° and [\d.]+ from the best", texts[-1][0])
    assert up == [0, 1, 2]
    np.testing.assert_allclose(place, target[0] - np.median(target, axis=0), atol=1e-5)
    assert np.linalg.norm(np.subtract(start, place)) > 1
    assert found.pop("copied") in ("copied", "selected")
    assert found.pop("nothing") is False
    assert all(found.values()), found
