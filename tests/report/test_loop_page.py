"""What closing the loop found, as page, as JSON and in words."""

import functools
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from loop.loop_records import abstained, named, nothing_to_add

from lpvid.loop import VERDICTS, EstimatedNumber
from lpvid.report import _report, headline, loop_page, loop_text, to_json, write_html, write_json
from lpvid.report._loop_words import estimate

VERDICT_RECORDS = {
    "nothing to add": nothing_to_add,
    "named": named,
    "named, remainder unknown": lambda: named(verdict="named, remainder unknown"),
    "abstain": abstained,
}


@pytest.fixture(scope="module", autouse=True)
def coarse_pictures():
    """Few dots: what the pictures show is tested elsewhere."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_report, "png_bytes", functools.partial(_report.png_bytes, dpi=10.0))
        yield


@pytest.fixture(scope="module")
def pages(tmp_path_factory, coarse_pictures):
    """The page of each verdict, as written."""
    folder = tmp_path_factory.mktemp("pages")
    return {
        verdict: write_html(make(), folder / "page.html").read_text()
        for verdict, make in VERDICT_RECORDS.items()
    }


def _strict(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_json_has_the_agreed_keys(tmp_path):
    content = _strict(write_json(named(), tmp_path / "loop.json").read_text())
    assert content == to_json(named())
    agreed = {"verdict", "effects", "error", "held_out", "p_value", "tests_made", "seconds"}
    assert agreed <= set(content)
    assert content["verdict"] == "named"
    assert set(content["error"]) == {"before", "after", "noise_floor"}
    for errors in content["error"].values():
        assert set(errors) == {"one_step", "horizon", "free_run", "bft"}
        assert all(len(values) == 1 for values in errors.values())
    assert content["held_out"] == [1200, 1799]
    first = content["effects"][0]
    assert {"name", "family", "port", "parameters", "confusable_with"} <= set(first)
    assert first["parameters"] == {
        "level": {"value": 0.7034, "std": 0.0061, "unit": "N m"},
        "speed": {"value": 0.021, "std": None, "unit": "rad/s"},
    }
    assert first["confusable_with"] == ["dahl at force at joint", "stribeck at force at joint"]


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_is_strict_json_and_said_first(verdict, pages):
    found = VERDICT_RECORDS[verdict]()
    assert _strict(json.dumps(to_json(found), allow_nan=False))["verdict"] == verdict
    page = pages[verdict]
    assert f"<h1>{headline(found)}</h1>" in page
    assert page.index(found.advice) < page.index("<table")
    assert loop_text(found).startswith(headline(found))
    assert "nan" not in loop_text(found)
    assert not re.search(r">[^<]*\bnan\b", page)


def test_the_floors_best_fit_is_that_of_a_model_that_errs_by_it():
    found = named()
    output = found.series.output[:, 0]
    share = np.linalg.norm(np.full(output.size, found.noise_floor[0]))
    expected = 100.0 * (1.0 - share / np.linalg.norm(output - output.mean()))
    assert to_json(found)["error"]["noise_floor"]["bft"][0] == pytest.approx(expected)


def test_the_page_holds_effects_ablation_and_pictures(pages):
    page = pages["named"]
    order = ("Error before and after", "What was missing", "Pictures", "The model", "How sure")
    places = [page.index(f"<h2>{heading}") for heading in order]
    assert places == sorted(places)
    for words in (
        "0.703 ± 0.012 N m",
        "0.021 rad/s (undecided)",
        "cannot tell it from dahl at joint or stribeck at joint",
        "To tell them apart: small reversals",
        "without coulomb at joint",
        "(−95 %)",
        "held-out samples 1200–1799",
    ):
        assert words in page
    assert page.count("data:image/png;base64,") == 6
    assert not re.search(r"https?:|url\(|@import|<script|<link", page)
    assert 'name="viewport"' in page


def test_a_page_without_effects_has_no_empty_parts(pages):
    page = pages["nothing to add"]
    assert "What was missing" not in page
    # A table of errors for each of the two outputs; responses, ladder, residuals, spectra, ranking.
    assert page.count("held-out samples") == 4  # caption and name of the box that scrolls
    assert page.count("data:image/png;base64,") == 5


def test_a_long_record_is_shown_where_it_errs_most():
    found = named(4000)
    worse = found.series.output + np.where(np.arange(4000) >= 2400, 3.0, 0.0)[:, None]
    worse[3500:] = found.series.output[3500:]
    page = loop_page(found._replace(series=found.series._replace(before=worse))).to_html()
    assert "the part where the model without effects errs most" in page


def test_estimates_have_as_many_digits_as_their_intervals():
    def text(value, std, unit=""):
        return estimate(EstimatedNumber("x", value, std, unit))

    assert text(20.3912, 0.21, "N") == "20.39 ± 0.41 N"
    assert text(203.5123, 11.0) == "204 ± 22"
    assert text(-0.00031234, 1e-6) == "-3.123e-04 ± 2.0e-06"
    assert text(1.0, 0.0, "kg") == "1 kg"
    assert text(np.nan, 1.0) == "nan"
    assert text(0.5, 0.005, "1") == "0.5000 ± 0.0098"
    assert text(5.0, np.inf, "s") == "5 s (undecided)"


@pytest.mark.slow
def test_nothing_sticks_out_on_a_phone(tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no headless browser on this machine")
    page = write_html(named(), tmp_path / "page.html")
    # A window is 500 pixels wide at least; a frame in it is as narrow as a phone.
    source = page.read_text().replace('"', "&quot;")
    (tmp_path / "frame.html").write_text(
        f"<body><iframe id='phone' width='390' height='800' srcdoc=\"{source}\"></iframe>"
        "<pre id='out'></pre><script>onload = () => {"
        "const inside = document.getElementById('phone').contentDocument.documentElement;"
        "document.getElementById('out').textContent = 'width=' + inside.scrollWidth;"
        "}</script></body>"
    )
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}/browser"]
    done = subprocess.run(
        [browser, *options, "--dump-dom", f"file://{tmp_path}/frame.html"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    (width,) = re.findall(r"width=(\d+)", done.stdout)
    assert int(width) <= 390
