"""The page is one file that asks for nothing, says what it was given, and is not broken by a name."""

import dataclasses
import json

import pytest

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.report.figures import write_figures
from cmig_jax.report.page import protocol, view_titles, write_page
from configs import PRESETS


@pytest.fixture(scope="module")
def written(read_page):
    """Write the page of a report as the only file of a folder, and read it."""

    def write(folder, report):
        write_page(folder / "report.html", report)
        assert [path.name for path in folder.iterdir()] == ["report.html"]
        return read_page(folder / "report.html")

    return write


@pytest.fixture(scope="module")
def page(tmp_path_factory, written, report):
    figures = write_figures(tmp_path_factory.mktemp("figures"), report.errors)
    return written(tmp_path_factory.mktemp("page"), dataclasses.replace(report, figures=figures))


def test_it_asks_for_nothing(page):
    page.asks_for_nothing()


def test_a_hostile_name_stays_text(page, report, hostile):
    assert [attributes.get("type") for attributes in page.all("script")] == ["application/json", None]
    assert all("onerror" not in attributes for _, attributes in page.elements)
    named = sum(report.errors.category[example.position] == hostile for example in report.examples)
    assert named >= 1
    assert sum(hostile in text for text in page.text("h3")) == named
    assert page.text("h1") == ["a <b>"]
    assert "python evaluate.py 'runs/a <b>' --report" in page.text("code")


def test_the_data_names_every_pair_and_method(page, report):
    data = json.loads(page.text("script")[0])
    assert data["network"] == "CMIGNet"
    assert len(data["pairs"]) == len(report.examples) == len(page.all("article"))
    assert all(list(pair["poses"]) == list(report.errors.methods) for pair in data["pairs"])
    assert [option["value"] for option in page.all("option")] == list(report.errors.methods)
    assert len(page.all("canvas")) == 2 * len(report.examples)
    assert len(page.all("img")) == 2 * len(report.examples), "the views of both clouds"


def test_sections_in_order(page):
    assert page.text("h2") == ["Results", "Pairs, worst first", "Figures"]
    assert "best, step 7" in page.text("dd")
    identity = f"{page_value(page, 'identity'):.2f}"
    assert identity in page.text("td")


def page_value(page, method):
    return float(page.text("td")[page.text("th").index(method) - page.text("th").index("identity")])


def test_without_correspondences_or_views(tmp_path, written, make_errors, make_example, make_report):
    errors = make_errors()
    example = make_example(errors, 0, 0, matched=False)
    del example.pair["views"]
    page = written(tmp_path, make_report(errors, [example]))
    assert not page.all("img")
    assert "matches" not in json.loads(page.text("script")[0])["pairs"][0]


def test_twenty_large_pairs_stay_below_ten_megabytes(tmp_path, make_errors, make_example, make_report):
    errors = make_errors()
    examples = [make_example(errors, i, i, points=10_000, views=(2, 20, 224, 224)) for i in range(20)]
    write_page(tmp_path / "report.html", make_report(errors, examples))
    assert (tmp_path / "report.html").stat().st_size < 10_000_000


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({}, ["modelnet40-hdf5, all categories, 12 pairs; 1024 points sampled once", "shared crop to 75%", "noise 0.01 clipped at 0.05"]),
        ({"noise_std": 0.0, "crop": "none", "sampling": "twice"}, ["sampled twice, no crop, no noise"]),
        ({"exclude": ("cone", "vase"), "max_angle_deg": 60.0}, ["all categories without cone, vase", "up to 60° per axis,"]),
        ({"keep_least": 0.4, "noise": "uniform"}, ["shared crop to 40% to 75%", "noise up to 0.01 clipped"]),
        ({"tested": "validation"}, ["held out for validation, all categories, 12 pairs"]),
        ({"turn": "either"}, ["up to 45° per axis to either side,"]),
        ({"frame": "any"}, ["translations up to 0.5, in any frame"]),
        ({"turn": "any"}, ["; any rotation, translations up to 0.5"]),
        ({"source": "stanford-scans"}, ["stanford-scans, 12 recorded pairs turned by up to 45°, 768 points per cloud"]),
    ],
)
def test_the_protocol_in_one_line(data, said):
    line = protocol(dataclasses.replace(PRESETS["corrected"](), data=DataConfig(**data)), 12)
    assert all(text in line for text in said)
    assert "\n" not in line


@pytest.mark.parametrize(
    ("views", "titles"),
    [
        ({"of": "object"}, ["6 depth views of the complete object"]),
        ({"of": "source"}, ["6 depth views of the source"]),
        ({"of": "target"}, ["6 depth views of the target"]),
        ({"of": "both"}, ["6 depth views of the source", "6 depth views of the target"]),
        ({"of": "object", "shown": "shuffled"}, ["6 depth views of the complete object of another pair"]),
        ({"of": "target", "shown": "zero"}, ["6 black views in place of depth views of the target"]),
    ],
)
def test_the_title_of_views_says_what_they_show(views, titles):
    assert view_titles(ViewsConfig(count=6, layout="axes", **views)) == titles
