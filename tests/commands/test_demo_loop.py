"""The demo's last section, on a loop put together by hand."""

import json

from loop.loop_records import named

from lpvid.commands import _demo_loop
from lpvid.data import IOData
from lpvid.report import Report
from lpvid.study import Undeclared


def test_the_section_tells_what_was_hidden_and_what_was_found(tmp_path):
    record = IOData(u=[0.0, 1.0], y=[0.0, 1.0], dt=1e-3)
    hidden = Undeclared(record, "coulomb", 2, 0.0714, "N·m")
    ending = _demo_loop.Ending(hidden, named(100))
    page = _demo_loop.add_section(Report("Arm"), ending, tmp_path).to_html()
    assert "Hidden: coulomb at joint 2, 0.0714 N·m. Found: coulomb (force at joint)" in page
    assert page.count("held-out samples") == 2 and page.count("data:image/png") == 2
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"loop.html", "virtual_forces.png", "held_out.png"}
    figures = _demo_loop.summary(ending)
    assert figures["hidden"]["size"] == {"value": 0.0714, "unit": "N·m"}
    assert figures["verdict"] == "named"
    json.dumps(figures, allow_nan=False)
