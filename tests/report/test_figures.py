"""The figures are written, show what they are given, and fit into a page."""

import re

import matplotlib as mpl
import matplotlib.image
import numpy as np
import pytest

from cmig_jax.report.figures import colours, draw_against, write_figures

NAMES = ["errors", "error_vs_overlap", "error_vs_angle", "error_by_category"]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, make_errors, hostile):
    folder = tmp_path_factory.mktemp("figures")
    before = dict(mpl.rcParams)
    figures = write_figures(folder, make_errors(category=hostile))
    assert dict(mpl.rcParams) == before, "no global state"
    return folder, figures


def test_files(drawn):
    folder, figures = drawn
    assert [figure.name for figure in figures] == NAMES
    assert sorted(path.name for path in folder.iterdir()) == sorted(f"{name}.png" for name in NAMES)
    for name in NAMES:
        pixels = matplotlib.image.imread(folder / f"{name}.png")
        assert min(pixels.shape[:2]) >= 200
        assert np.abs(pixels[..., :3] - mpl.colors.to_rgb("#3179b5")).max(-1).min() < 0.1, "the network is drawn"


def test_svg_stands_in_a_page(drawn):
    names = [found for figure in drawn[1] for found in re.findall(r'\bid="([^"]*)"', figure.svg)]
    assert len(names) == len(set(names)), "no name twice in the page"
    for figure in drawn[1]:
        assert "http" not in figure.svg
        assert "<img src=x" not in figure.svg
        assert "currentColor" in figure.svg
        used = re.findall(r'(?:url\(#|href="#)([^")]*)', figure.svg)
        assert used
        assert set(used) <= set(names)
        assert len(figure.svg) < 200_000


def test_names_are_text(drawn):
    assert all("CMIGNet + ICP" in figure.svg for figure in drawn[1])
    assert r"$\frac{" in drawn[1][-1].svg, "a dollar sign starts no formula"


def test_every_method_has_its_colour(make_errors):
    found = colours(make_errors())
    assert len(set(found.values())) == len(found) == 4


@pytest.mark.parametrize("count", [2, 6])
def test_few_pairs(tmp_path, make_errors, count):
    assert len(write_figures(tmp_path, make_errors(count=count, category=""))) == len(NAMES)


def test_the_medians_are_those_of_the_bins(make_errors):
    errors = make_errors(count=20)
    x = np.repeat([1.0, 2.0], 10)
    figure = draw_against(errors, x, "x")
    line = next(line for line in figure.axes[0].lines if line.get_label() == "ICP")
    wanted = [np.median(errors.methods["ICP"].rotation_deg[x == value]) for value in (1, 2)]
    np.testing.assert_allclose(line.get_xdata(), [1, 2])
    np.testing.assert_allclose(line.get_ydata(), wanted)
