import base64
import os
import re
from html.parser import HTMLParser

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from lpvid.report import Report, text_table

_VOID = {"meta", "img"}


class _Page(HTMLParser):
    """Tags in order, attributes and text; fails on a tag closed out of turn."""

    def __init__(self, source: str):
        super().__init__()
        self.open, self.found, self.words = [], [], []
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style" and data.strip():
            self.words.append((self.open[-1], data))

    def all(self, tag):
        return [attributes for name, attributes in self.found if name == tag]

    def text(self, tag):
        return [words for name, words in self.words if name == tag]


@pytest.fixture
def picture(tmp_path):
    figure, axes = plt.subplots(figsize=(2, 1))
    axes.plot([0, 1])
    figure.savefig(tmp_path / "plot.png", dpi=50)
    plt.close(figure)
    return tmp_path / "plot.png"


def test_the_parts_are_there_in_order(picture):
    report = (
        Report("Arm")
        .heading("Fit")
        .paragraph("First.\n\nSecond.")
        .table([["a", 1.23456], ["b", None]], ["point", "BFT (%)"], "Fit of each point")
        .heading("Detail", 3)
        .preformatted("a  b\nc")
        .figure(picture, "Response")
    )
    page = _Page(report.to_html())
    assert page.text("title") == page.text("h1") == ["Arm"]
    assert page.text("h2") == ["Fit"] and page.text("h3") == ["Detail"]
    assert page.text("p") == ["First.", "Second."]
    assert page.text("caption") == ["Fit of each point"]
    assert page.text("th") == ["point", "BFT (%)"]
    assert page.text("td") == ["a", "1.235", "b", "–"]
    assert [cell.get("class") for cell in page.all("td")] == [None, "number"] * 2
    assert page.text("pre") == ["a  b\nc"]
    tags = [tag for tag, _ in page.found if tag in ("h2", "p", "table", "h3", "pre", "figure")]
    assert tags == ["h2", "p", "p", "table", "h3", "pre", "figure"]


def test_pictures_are_inside(picture):
    page = _Page(Report("x").figure(picture, "Response").to_html())
    (image,) = page.all("img")
    kind, content = image["src"].split(",", 1)
    assert kind == "data:image/png;base64"
    assert base64.b64decode(content) == picture.read_bytes()
    assert (image["width"], image["height"]) == ("100", "50")
    assert image["alt"] == "Response"
    assert page.text("figcaption") == ["Response"]


def test_axes_are_drawn_and_their_figure_closed():
    _, axes = plt.subplots(1, 2, figsize=(4, 2))
    page = _Page(Report("x").figure(axes, alt="two curves").to_html())
    (image,) = page.all("img")
    assert (image["width"], image["height"], image["alt"]) == ("600", "300", "two curves")
    assert plt.get_fignums() == []


def test_text_is_escaped_everywhere(picture):
    evil = "<script>alert('1')</script> & \"quoted\""
    report = (
        Report(evil)
        .heading(evil)
        .paragraph(evil)
        .preformatted(evil)
        .table([[evil]], [evil], evil)
        .figure(picture, evil)
    )
    page = _Page(report.to_html())
    assert page.all("script") == []
    for tag in ("title", "h1", "h2", "p", "pre", "th", "td", "caption", "figcaption"):
        assert page.text(tag) == [evil]
    assert page.all("img")[0]["alt"] == evil
    assert page.all("div")[0]["aria-label"] == evil


def test_nothing_is_fetched_and_no_script_runs(picture):
    source = Report("x").figure(picture, "y").table([[1]], ["a"]).to_html()
    page = _Page(source)
    assert not {"script", "link", "iframe", "object", "embed"} & {tag for tag, _ in page.found}
    assert all(image["src"].startswith("data:") for image in page.all("img"))
    assert not re.search(r"https?:|url\(|@import|\son\w+=", source)
    policy = [meta["content"] for meta in page.all("meta") if "http-equiv" in meta]
    assert policy == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_it_reads_on_a_phone_and_in_the_dark():
    source = Report("x").table([[1]], ["a"]).to_html()
    page = _Page(source)
    names = {meta.get("name"): meta.get("content") for meta in page.all("meta")}
    assert names["viewport"] == "width=device-width, initial-scale=1"
    assert names["color-scheme"] == "light dark"
    assert "prefers-color-scheme: dark" in source
    assert page.all("html")[0]["lang"] == "en"
    # The table lies in a box that scrolls, which the keyboard reaches.
    box = page.all("div")[0]
    assert box["class"] == "scroll" and box["tabindex"] == "0"


def test_reports_do_not_change():
    empty = Report("x")
    empty.paragraph("more")
    assert empty.parts == ()


def test_write_is_whole_or_not_at_all(tmp_path, monkeypatch):
    report = Report("κ and ϑ").paragraph("α")
    path = report.write(tmp_path / "report.html")
    assert path.read_text(encoding="utf-8") == report.to_html()

    def fail(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(KeyboardInterrupt):
        Report("new").write(path)
    assert path.read_text(encoding="utf-8") == report.to_html()
    assert os.listdir(tmp_path) == ["report.html"]


def test_faults_are_named(tmp_path):
    with pytest.raises(ValueError, match="level: 2, 3 or 4"):
        Report("x").heading("y", 1)
    with pytest.raises(ValueError, match="row 1 has 1 cells for 2 headers"):
        Report("x").table([[1, 2], [3]], ["a", "b"])
    (tmp_path / "plot.png").write_bytes(b"GIF89a")
    with pytest.raises(ValueError, match="no PNG file"):
        Report("x").figure(tmp_path / "plot.png")


def test_text_table_is_aligned():
    rows = [["arm", 99.123456, 12, True], ["wafer stage", jnp.asarray(7.5), None, np.bool_(False)]]
    assert text_table(rows, ["plant", "BFT (%)", "n", "stable"]) == (
        "plant        BFT (%)   n  stable\n"
        "-----------  -------  --  ------\n"
        "arm            99.12  12  yes\n"
        "wafer stage      7.5   –  no"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (100.0, "100"),
        (0.00012345678, "0.0001235"),
        (1.5e-7, "1.5e-07"),
        (123456.7, "123457"),
        (1.5e9, "1.5e+09"),
        (-12345.6, "-12346"),
        (float("nan"), "nan"),
        (float("-inf"), "-inf"),
        (1234567, "1234567"),
        (jnp.float64(0.5), "0.5"),
        (np.int64(7), "7"),
        (1 + 2j, "1+2j"),
        ("two\nlines", "two lines"),
        (None, "–"),
    ],
)
def test_numbers_are_written_sensibly(value, text):
    assert text_table([[value]], ["v"]).splitlines()[-1].strip() == text


def test_an_empty_table_has_its_head():
    assert text_table([], ["a", "bc"]) == "a  bc\n-  --"
