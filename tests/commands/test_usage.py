"""Wrong use: exit code 2 and one clear line, never a traceback."""

import os
import subprocess
import sys

import jax
import pytest

import lpvid
from lpvid.commands import _cache, _info, main

COLUMNS = ["--input", "u", "--output", "y"]
IDENTIFY = [*COLUMNS, "--time", "t"]


def refused(capsys, argv, *words, code=2):
    """Run, and check exit code and the one line on stderr."""
    assert main(argv) == code
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("lpvid")
    for word in words:
        assert word in lines[0], lines[0]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], ["required: COMMAND"]),
        (["fit"], ["invalid choice: 'fit'", "demo"]),
        (["identify"], ["lpvid identify: error:", "FILE, --input, --output"]),
        (["identify", "FILE", *COLUMNS], ["--dt", "--time", "required"]),
        (["identify", "FILE", *IDENTIFY, "--dt", "1"], ["--dt", "not allowed with", "--time"]),
        (["identify", "FILE", *COLUMNS, "--dt", "0"], ["--dt", "0 is no positive"]),
        (["identify", "FILE", *COLUMNS, "--dt", "x"], ["--dt", "'x' is no number"]),
        (["identify", "FILE", *COLUMNS, "--dt", "nan"], ["--dt", "not finite"]),
        (["identify", "FILE", *IDENTIFY, "--order", "six"], ["--order", "'six'", "or auto"]),
        (["identify", "FILE", *IDENTIFY, "--order", "0"], ["--order", "below 1"]),
        (["identify", "FILE", *IDENTIFY, "--method", "n5sid"], ["--method", "po-moesp"]),
        (["identify", "FILE", *IDENTIFY, "--block-rows", "1"], ["--block-rows", "below 2"]),
        (["identify", "FILE", *IDENTIFY, "--split", "1"], ["--split", "between 0 and 1"]),
        (["identify", "FILE", *IDENTIFY, "--stabilise", "1.5"], ["--stabilise", "1.5"]),
        (["identify", "FILE", "--input", "u,", "--output", "y", "--dt", "1"], ["empty column"]),
        (
            ["identify", "FILE", "--input", "u", "--output", "u", "--dt", "1"],
            ["'u'", "--input and --output"],
        ),
        (["identify", "FILE", *COLUMNS, "--dt", "1", "--resample"], ["--resample", "--time"]),
        (["identify", "missing.csv", *IDENTIFY], ["missing.csv: no such file"]),
        (
            ["identify", "FILE", "--input", "torque", "--output", "y", "--time", "t"],
            ["no column 'torque'", "t, u, y, k"],
        ),
        (["identify", "FILE", *IDENTIFY, "--out", "gone/m.json"], ["--out", "does not exist"]),
        (["identify", "FILE", *IDENTIFY, "--json", "FILE"], ["--json", "overwritten"]),
        (
            ["identify", "FILE", *IDENTIFY, "--json", "a.json", "--out", "a.json"],
            ["--json", "--out's file too"],
        ),
        (["identify", "FILE", *IDENTIFY, "--order", "300"], ["400 samples", "needs at least"]),
        (
            ["identify", "FILE", *IDENTIFY, "--order", "4", "--block-rows", "3"],
            ["--block-rows 3", "raise --block-rows to 5"],
        ),
        (["demo", "--runs", "0"], ["--runs", "below 1"]),
        (["demo", "--seed", "-1"], ["--seed"]),
        (["demo", "--out", "FILE"], ["--out", "is a file"]),
        (["demo", "--out", "FILE/in"], ["--out", "cannot be made"]),
        (["lpv", "--order", "4", *IDENTIFY], ["--at"]),
        (["lpv", "--at", "0", "FILE", "--order", "4", *IDENTIFY], ["two operating points"]),
        (["lpv", "--at", "a", "FILE", "--order", "4", *IDENTIFY], ["--at", "'a' is no number"]),
        (["lpv", "PAIR", *IDENTIFY], ["--order"]),
        (["lpv", "PAIR", "--order", "auto", *IDENTIFY], ["--order", "'auto'"]),
        (["lpv", "PAIR", "--order", "3", *IDENTIFY], ["--order", "3 is odd"]),
        (["lpv", "PAIR", "--order", "4", "--degree", "-1", *IDENTIFY], ["--degree"]),
        (
            ["lpv", "PAIR", "--order", "4", "--degree", "2", *IDENTIFY],
            ["--degree: 2 in 1 scheduling", "needs 3 distinct points --at, 2 given"],
        ),
        (
            ["lpv", "PLANE", "--order", "4", "--degree", "2", *IDENTIFY],
            ["--degree: 2 in 2 scheduling", "needs 6 distinct points --at, 3 given"],
        ),
        (["lpv", "PLANE", "--order", "4", "--degree", "1", *IDENTIFY], ["do not all lie on"]),
        (["lpv", "PAIR", "--order", "4", "--structure", "x", *IDENTIFY], ["--structure"]),
        (
            ["lpv", "PAIR", "--order", "4", "--structure", "two-link-arm", *IDENTIFY],
            ["two-link-arm", "needs --lengths"],
        ),
        (
            ["lpv", "PAIR", "--order", "6", "--lengths", "1,2", *IDENTIFY],
            ["--lengths", "two-link-arm only"],
        ),
        (["lpv", "PAIR", "--order", "4", "--lengths", "1", *IDENTIFY], ["--lengths", "0.35,0.30"]),
        (
            ["lpv", "PAIR", "--order", "4", "--measured", "velocity", *IDENTIFY],
            ["--measured", "mechanical only"],
        ),
        (
            ["lpv", "PAIR", "--order", "4", "--structure", "mechanical", *IDENTIFY],
            ["one input and one output a degree of freedom"],
        ),
        (
            ["lpv", "PAIR", "--order", "4", "--test", "0,1", "FILE", *IDENTIFY],
            ["--test", "'0,1'"],
        ),
        (
            ["lpv", "PAIR", "--order", "4", "--test", "level", "FILE", *IDENTIFY],
            ["no column 'level'"],
        ),
        (
            ["lpv", "--at", "0", "FILE", "--at", "-0.5,1", "FILE", "--order", "4", *IDENTIFY],
            ["equally many"],
        ),
    ],
)
def test_wrong_use_is_said_in_one_line(capsys, tables, tmp_path, monkeypatch, argv, words):
    monkeypatch.chdir(tmp_path)
    file, other = tables["0.0"], tables["1.0"]
    full = []
    for word in argv:
        if word == "PAIR":
            full += ["--at", "0", file, "--at", "1", other]
        elif word == "PLANE":
            full += ["--at", "0,0", file, "--at", "1,1", other, "--at", "2,2", other]
        else:
            full.append(word.replace("FILE", file))
    refused(capsys, full, *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["is empty"]),
        ("t,u,y\n0,1,2\n1,x,2\n2,1,1\n", ["line 3", "'u'", "'x' is not a number"]),
        ("t,u,y\n0,1,2\n1,1\n2,1,1\n", ["line 3", "2 cell(s)"]),
        ("t,u,y\n0,1,2\n1,nan,2\n2,1,1\n", ["'u'", "nan is not a finite"]),
        ("t,u,y\n0,1,2\n1,1,2\n5,1,1\n6,2,2\n7,1,1\n", ["not uniform", "pass --resample"]),
        ("t,u,y\n" + "".join(f"{k},1,{k % 3}\n" for k in range(200)), ["'u' is constant"]),
    ],
)
def test_bad_data_name_the_place(capsys, tmp_path, content, words):
    file = tmp_path / "run.csv"
    file.write_text(content)
    assert main(["identify", str(file), *IDENTIFY, "--order", "1", "--keep-offsets"]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    for word in words:
        assert word in error


def test_test_records_of_another_sample_time_are_refused(capsys, tables):
    argv = ["lpv", "--at", "0", tables["0.0"], "--at", "1", tables["1.0"], "--order", "4"]
    slow = os.path.join(os.path.dirname(tables["0.0"]), "slow.csv")
    with open(slow, "w") as file:
        file.write("t,u,y\n" + "".join(f"{0.5 * k},{k % 2},{k % 3}\n" for k in range(50)))
    refused(capsys, [*argv, *IDENTIFY, "--test", "0.5", slow], "0.5 s", "0.01 s")


def test_interruption_ends_with_130(capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(_info, "run", interrupted)
    refused(capsys, ["info"], "interrupted", code=130)


def test_internal_faults_end_with_1_and_show_where_if_asked(capsys, monkeypatch):
    def broken(*_):
        raise KeyError("lost")

    monkeypatch.setattr(_info, "run", broken)
    refused(capsys, ["info"], "internal error", "KeyError", "LPVID_DEBUG=1", code=1)
    monkeypatch.setenv("LPVID_DEBUG", "1")
    assert main(["info"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_version_help_and_info(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"lpvid {lpvid.__version__}\n"
    assert main(["lpv", "--help"]) == 0
    assert "--structure" in capsys.readouterr().out
    assert main(["info"]) == 0
    out = capsys.readouterr().out
    for word in ("lpvid", "jaxlib", "equinox", "optimistix", "numpy", "cpu", "float64", "cores"):
        assert word in out


def test_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, "-m", "lpvid", "identify", "missing.csv", *IDENTIFY],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr == (
        "lpvid identify: error: missing.csv: no such file; check the path and the working folder\n"
    )


def test_cache_is_in_the_users_folder_and_never_a_reason_to_fail(monkeypatch, tmp_path):
    names = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _cache.keep_compiled_code() is None  # LPVID_NO_CACHE=1 in these tests
    monkeypatch.delenv("LPVID_NO_CACHE")
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        folder = _cache.keep_compiled_code()
        assert folder is not None and folder.is_dir() and folder.is_relative_to(tmp_path / "lpvid")
        assert jax.config.jax_compilation_cache_dir == str(folder)
        jax.config.update("jax_compilation_cache_dir", None)
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        assert _cache.keep_compiled_code() is None
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
