"""The four tables of one result."""

import pytest

from cmig_jax.evaluation.tables import html_table, latex_table, markdown_table, text_table

RESULTS = {
    "identity": {"rmse_r_deg": 26.123, "rmse_t": 0.28961, "recall": 0.0, "seconds_per_pair": 1e-6},
    "icp_tuned": {"rmse_r_deg": 9.284, "rmse_t": 0.0172, "recall": 0.9, "seconds_per_pair": 0.0068},
    "CMIGNet": {"rmse_r_deg": 4.5, "rmse_t": 0.0172, "recall": 0.951, "closest_point": 0.0123, "seconds_per_pair": 0.05},
    "command": "python evaluate.py runs/x",
    "config": {"seed": 0},
    "versions": {"jax": "0.10.2"},
}


def test_text():
    lines = text_table(RESULTS).splitlines()
    assert lines[0].split("  ")[0].strip() == "method"
    assert lines[1].split() == ["[deg]", "[units]", "[%]", "[units]", "[ms/pair]"]
    assert lines[3].split() == ["identity", "26.12", "0.2896", "0.0", "–", "0.0"]
    assert lines[5].split() == ["CMIGNet", "4.50", "0.0172", "95.1", "0.0123", "50.0"]
    assert len(lines) == 6
    assert len({len(line) for line in lines}) == 1


def test_markdown():
    lines = markdown_table(RESULTS).splitlines()
    assert lines[0].startswith("| method ")
    assert "RMSE(R) [deg] |" in lines[0]
    assert set(lines[1]) == set("|-: ")
    assert [cell.strip() for cell in lines[3].split("|")[1:-1]] == ["icp_tuned", "9.28", "**0.0172**", "90.0", "–", "6.8"]
    assert [cell.strip() for cell in lines[4].split("|")[1:-1]] == ["CMIGNet", "**4.50**", "**0.0172**", "**95.1**", "0.0123", "50.0"]
    assert len({len(line) for line in lines}) == 1


def test_latex():
    text = latex_table(RESULTS)
    assert text.startswith("\\begin{tabular}{lrrrrr}\n\\toprule\n")
    assert r"icp\_tuned" in text
    assert r"[\%]" in text
    assert r"\textbf{4.50}" in text
    assert "–" not in text
    assert text.count(r"\\") == 5


def test_html():
    text = html_table({"a <b>": RESULTS["identity"]} | RESULTS)
    assert text.count("<tr>") == text.count("</tr>") == 5
    assert '<th scope="row">a &lt;b&gt;</th>' in text
    assert '<th scope="col">RMSE(R) <small>deg</small></th>' in text
    assert "<td><strong>4.50</strong></td>" in text
    assert text.count("<td>–</td>") == 3


def test_a_column_without_a_value_is_left_out():
    assert "closest" not in text_table({"icp_tuned": RESULTS["icp_tuned"]})


@pytest.mark.parametrize("table", [text_table, markdown_table, latex_table, html_table])
def test_no_method_is_an_error(table):
    with pytest.raises(ValueError, match="at least one method"):
        table({"command": "python evaluate.py"})
