"""Readers: every format, and every fault with the place where it is."""

import builtins
import re
import sys

import h5py
import numpy as np
import pandas
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.data import DataError, from_pandas, read, read_csv, read_mat, read_npz

N = 6
T = 0.5 * np.arange(N)
U = np.sin(T)
Y = np.stack([np.cos(T), T**2], axis=1)
PARTS = dict(inputs="u", outputs="y", dt=0.5)


def write(folder, text, name="run.csv"):
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def table(delimiter=",", header='"t","u","y1","y2"', end="\n", last=""):
    rows = [delimiter.join(f"{x:.17g}" for x in row) for row in np.column_stack([T, U, Y])]
    return end.join(line + last for line in ([header] if header else []) + rows) + end


class TestTextTables:
    @pytest.mark.parametrize(
        "text",
        [
            table(),
            table(last=","),
            table(end="\r\n"),
            table(end="\r"),
            table().rstrip(),
            table() + "\n\n",
            "\ufeff" + table(),
            table().encode("utf-16"),
            table(";", "t;u;y1;y2"),
            table("\t", "t\tu\ty1\ty2", last="\t"),
            table("  ", " t u   y1\ty2"),
            table(" , ", "t, u, y1, y2"),
            "# made by a rig\n\n% second remark\n" + table(header="t,u,y1,y2"),
            table().replace("\n", "\n\n", 3),
        ],
    )
    def test_dialects(self, tmp_path, text):
        data = read(write(tmp_path, text), inputs=["u"], outputs=["y2", "y1"], time="t")
        np.testing.assert_array_equal(data.u[:, 0], U)
        np.testing.assert_array_equal(data.y, Y[:, ::-1])
        assert (data.dt, data.names["y"]) == (0.5, ("y2", "y1"))

    @pytest.mark.parametrize("suffix", ["csv", "txt", "dat", "tsv", "CSV"])
    def test_without_header_columns_are_numbered(self, tmp_path, suffix):
        path = write(tmp_path, table("\t", None, last="\t"), f"run.{suffix}")
        data = read(path, inputs=2, outputs=["3", 4], scheduling=1, dt=0.5)
        np.testing.assert_array_equal(data.y, Y)
        np.testing.assert_array_equal(data.kappa[:, 0], T)
        assert data.names == {"u": ("2",), "y": ("3", "4"), "kappa": ("1",)}

    def test_an_unnamed_column_is_called_by_its_number(self, tmp_path):
        data = read(write(tmp_path, table(header=",u,y1,y2")), inputs="u", outputs="1", dt=1.0)
        np.testing.assert_array_equal(data.y[:, 0], T)

    def test_columns_not_asked_for_may_hold_anything(self, tmp_path):
        text = "u,y,note\n" + "".join(f'{k},{k + 1},"a, b"\n' for k in range(4)) + "4,5,\n"
        data = read(write(tmp_path, text), **PARTS)
        np.testing.assert_array_equal(data.y[:, 0], np.arange(1.0, 6.0))

    def test_quoted_numbers_and_latin_header(self, tmp_path):
        text = 'u,"winkel in °"\n"1","2"\n"3","4"\n'.encode("latin-1")
        data = read(write(tmp_path, text), inputs="u", outputs="winkel in °", dt=1.0)
        np.testing.assert_array_equal(data.y[:, 0], [2.0, 4.0])

    @settings(max_examples=20, deadline=None)
    @given(
        st.lists(
            st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 2),
            min_size=2,
            max_size=5,
        ),
        st.sampled_from([",", ";", "\t", " "]),
    )
    def test_numbers_survive(self, tmp_path_factory, rows, delimiter):
        text = f"u{delimiter}y\n" + "".join(f"{u!r}{delimiter}{y!r}\n" for u, y in rows)
        data = read_csv(write(tmp_path_factory.mktemp("csv"), text), **PARTS)
        np.testing.assert_array_equal(np.column_stack([data.u, data.y]), rows)

    @pytest.mark.parametrize(
        "text, message",
        [
            ("a,b\n1,2\n3,4\n", r"run\.csv: no column 'u'\. Available columns: a, b\."),
            ("u,u,y\n1,2,3\n", r"run\.csv: column 'u' appears 2 times \(columns 1 and 2\)"),
            ("u,y\n1,2\n3,abc\n5,6\n", r"run\.csv, line 3, column 'y': 'abc' is not a number"),
            ("u;y\n1;2\n3;4,5\n5;6\n", r"line 3, column 'y': '4,5'.*decimals with a point"),
            ("u,y\n1,2\n3,1_0\n5,6\n", r"line 3, column 'y': '1_0' is not a number"),
            ("u,y\n1,2\n\n,4\n5,6\n", r"run\.csv, line 4, column 'u': the cell is empty"),
            ("u,y\n1,2\n3,\n5,6\n", r"run\.csv, line 3, column 'y': the cell is empty"),
            ("u,y\n1,2\n3\n5,6\n", r"line 3 has 1 cell\(s\) but the table has 2 columns.*complete"),
            ("u,y\n1,2\n3,4,5\n6,7\n", r"line 3 has 3 cell\(s\) but the table has 2 columns"),
            ("u,y\n1,2\n3,4\n5", r"line 4 has 1 cell\(s\).*looks truncated there"),
            ("u,y\n1,2\n3,4\n5,", r"line 4, column 'y': the cell is empty.*looks truncated"),
            ("u,y\n1,2\n3,4\n5,1e-", r"line 4, column 'y': '1e-' is not a number.*truncated"),
            ("# c\nu,y\n1,2\n\n3,nan\n5,6\n", r"run\.csv, line 5, column 'y': nan is not a fin"),
            ("u,y\n1,2\n-inf,4\n", r"run\.csv, line 3, column 'u': -inf is not a finite number"),
            ("u,y\n1,2\n", r"run\.csv: only one row of samples"),
            ("u,y\n", r"run\.csv is empty below its header, line 1"),
            ("# u,y\n\n", r"run\.csv holds no table"),
            ("", r"run\.csv is empty\."),
            (" \n\n", r"run\.csv is empty\."),
            (b"u,y\n\0\0\0\0", r"run\.csv is not text"),
        ],
    )
    def test_faults(self, tmp_path, text, message):
        with pytest.raises(DataError, match=message):
            read(write(tmp_path, text), **PARTS)

    def test_a_long_file_is_read_and_its_fault_is_found(self, tmp_path):
        rows = [f"{k * 1e-3:.3f},{k % 7},{k % 5}" for k in range(131072)]
        good = write(tmp_path, "t,u,y\n" + "\n".join(rows))
        data = read(good, inputs="u", outputs="y", time="t")
        assert data.n_samples == 131072
        rows[100_000] = "100,x,0"
        with pytest.raises(DataError, match="line 100002, column 'u': 'x' is not a number"):
            read(write(tmp_path, "t,u,y\n" + "\n".join(rows)), inputs="u", outputs="y", time="t")


class TestTime:
    def with_time(self, folder, stamps):
        rows = "".join(f"{t!r},{np.sin(t)},{2 * t}\n" for t in map(float, stamps))
        rows = rows.replace("nan,nan,nan", "nan,0,0")
        return write(folder, "t,u,y\n" + rows)

    def read(self, folder, stamps, **options):
        path = self.with_time(folder, stamps)
        return read(path, **{"inputs": "u", "outputs": "y", "time": "t", **options})

    def test_rounded_stamps_give_the_mean_step(self, tmp_path):
        stamps = np.round(np.arange(3000) / 610.35, 7)
        assert self.read(tmp_path, stamps).dt == pytest.approx(1 / 610.35, rel=1e-7)
        assert self.read(tmp_path, 0.01 * np.arange(1000)).dt == 0.01
        assert self.read(tmp_path, 1.7e9 + 1e-3 * np.arange(50)).dt == pytest.approx(1e-3, rel=1e-5)

    @pytest.mark.parametrize(
        "stamps, message",
        [
            ([0, 1, 2, 3.002, 4], r"run\.csv, line 5, column 't': time is not uniform.*resample"),
            ([0, 1, 2, 3, 5, 6], r"line 6, column 't'.*step there is 2 s where 1 s is usual"),
            ([0, 1, 2, 2, 3], r"run\.csv, line 5, column 't': time goes from 2 to 2, but must"),
            ([0, 1, 2, 1.5, 3], r"run\.csv, line 5, column 't': time goes from 2 to 1\.5"),
            ([0, 1, np.nan, 3], r"run\.csv, line 4, column 't': nan"),
        ],
    )
    def test_faults(self, tmp_path, stamps, message):
        with pytest.raises(DataError, match=message):
            self.read(tmp_path, stamps)

    def test_resampling_is_linear_at_the_median_step(self, tmp_path):
        stamps = np.array([0.0, 1.0, 2.0, 3.3, 4.0, 5.0, 7.0])
        data = self.read(tmp_path, stamps, resample=True)
        assert (data.dt, data.n_samples) == (1.0, 8)
        np.testing.assert_allclose(data.y[:, 0], 2 * np.arange(8.0), atol=1e-14)
        np.testing.assert_allclose(data.u[3, 0], np.interp(3.0, stamps, np.sin(stamps)))
        with pytest.raises(DataError, match="line 4.*must increase"):
            self.read(tmp_path, [0, 1, 0.5, 2], resample=True)

    @pytest.mark.parametrize(
        "options, message",
        [
            (dict(time=None), r"run\.csv: the sample time is unknown.*time='t'.*dt="),
            (dict(dt=1.0), r"run\.csv: time and dt are both given"),
            (dict(time=None, dt=0.0), r"run\.csv: dt is 0\.0"),
            (dict(time=None, dt=1.0, resample=True), r"resample=True needs the time column"),
            (dict(inputs=()), r"run\.csv: inputs is empty"),
            (dict(outputs=[]), r"run\.csv: outputs is empty"),
            (dict(outputs=["y", "y"]), r"run\.csv: names\['y'\] repeats a name"),
        ],
    )
    def test_arguments(self, tmp_path, options, message):
        with pytest.raises(DataError, match=message):
            self.read(tmp_path, [0, 1, 2], **options)


def save_npz(path, **arrays):
    np.savez(path, **arrays)


def save_mat(path, **arrays):
    scipy.io.savemat(path, arrays)


def save_mat73(path, **arrays):
    # As MATLAB does: a user block, and the axes reversed.
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            array = np.asarray(array)
            file[name] = (array[:, None] if array.ndim == 1 else np.atleast_2d(array)).T
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


FORMATS = [("run.npz", save_npz), ("v5.mat", save_mat), ("v73.mat", save_mat73)]


@pytest.fixture(params=FORMATS, ids=[name for name, _ in FORMATS])
def arrays(request, tmp_path):
    name, save = request.param

    def saved(**values):
        save(tmp_path / name, **values)
        return tmp_path / name

    return saved


class TestArrays:
    def test_columns_expand_and_are_picked(self, arrays):
        path = arrays(t=T, u=U.astype(np.float32), acc=Y, fs=2.0)
        data = read(path, inputs="u", outputs="acc", time="t")
        np.testing.assert_array_equal(data.y, Y)
        np.testing.assert_array_equal(data.u[:, 0], U.astype(np.float32))
        assert data.names["y"] == ("acc[0]", "acc[1]") and data.dt == 0.5
        one = read(path, inputs="u", outputs="acc[1]", scheduling="t", dt=0.5)
        np.testing.assert_array_equal(one.y[:, 0], Y[:, 1])
        assert one.names == {"u": ("u",), "y": ("acc[1]",), "kappa": ("t",)}

    def test_rows_are_vectors_too(self, arrays):
        data = read(arrays(u=U[None, :], y=U[:, None]), **PARTS)
        np.testing.assert_array_equal(data.u, data.y)

    @pytest.mark.parametrize(
        "changes, options, message",
        [
            ({}, dict(inputs="v"), r"no column 'v'\. Available columns: t, u, y\.$"),
            ({}, dict(inputs="fs"), r"'fs' has shape .*no column of samples.*dt="),
            ({}, dict(outputs="y[2]"), r"y\[2\] is not there: 'y' has 2 column\(s\), y\[0\] to y"),
            (dict(y=Y.T), {}, r"'y' has 6 columns but only 2 samples.*transpose"),
            (dict(y=U[:-1]), {}, r"column 'y' has 5 samples but 'u' has 6"),
            (dict(u=np.where(T == 1.0, np.nan, U)), {}, r", sample 2, column 'u': nan is not a f"),
            (
                dict(t=np.append(T[:-1], 9.0)),
                dict(time="t", dt=None),
                r", sample 5, column 't': time is not unif",
            ),
            (dict(t=Y), dict(time="t", dt=None), r"time 't' has 2 columns; name one.*'t\[0\]'"),
            (dict(u=U + 1j), {}, r"'u' holds complex128 values"),
        ],
    )
    def test_faults(self, arrays, changes, options, message):
        path = arrays(**{"t": T, "u": U, "y": Y, "fs": 2.0, **changes})
        with pytest.raises(DataError, match=re.escape(str(path)) + ".*" + message):
            read(path, **{**PARTS, **options})

    @pytest.mark.parametrize("keep", [0.97, 0.5, 0.1])
    def test_truncated_files(self, arrays, keep):
        rng = np.random.default_rng(0)
        path = arrays(u=rng.standard_normal(4000), y=rng.standard_normal(4000))
        content = path.read_bytes()
        path.write_bytes(content[: int(keep * len(content))])
        with pytest.raises(DataError, match=re.escape(str(path)) + " is truncated or not a"):
            read(path, **PARTS)

    @pytest.mark.parametrize("name", ["run.npz", "run.mat"])
    def test_files_of_another_kind(self, tmp_path, name):
        with pytest.raises(DataError, match=rf"{name} is truncated or not an? "):
            read(write(tmp_path, "u,y\n1,2\n" * 50, name), **PARTS)
        with pytest.raises(DataError, match=rf"{name} is empty"):
            read(write(tmp_path, "", name), **PARTS)

    def test_objects_are_not_loaded(self, tmp_path):
        np.savez(tmp_path / "run.npz", u=U, y=U, note=np.array([{}] * N, object))
        assert read_npz(tmp_path / "run.npz", **PARTS).n_samples == N
        with pytest.raises(DataError, match="'note' holds object values"):
            read_npz(tmp_path / "run.npz", inputs="note", outputs="y", dt=1.0)

    def test_structures(self, tmp_path):
        scipy.io.savemat(tmp_path / "v5.mat", {"run": {"u": U, "sensor": {"y": Y}}, "x": "text"})
        with h5py.File(tmp_path / "v73.mat", "w") as file:
            file["run/u"], file["run/sensor/y"] = U[None, :], Y.T
        for name in ("v5.mat", "v73.mat"):
            data = read_mat(tmp_path / name, inputs="run.u", outputs="run.sensor.y", dt=1.0)
            np.testing.assert_array_equal(data.y, Y)

    def test_version_73_without_h5py(self, tmp_path, monkeypatch):
        path = tmp_path / "v73.mat"
        save_mat73(path, u=U, y=Y)
        monkeypatch.setitem(sys.modules, "h5py", None)
        with pytest.raises(ImportError, match=r"v73\.mat is a MATLAB 7\.3.*pip install h5py"):
            read(path, **PARTS)


class TestFiles:
    @pytest.mark.parametrize("suffix", ["csv", "mat", "npz"])
    def test_missing_and_folders(self, tmp_path, suffix):
        with pytest.raises(DataError, match=rf"none\.{suffix}: no such file"):
            read(tmp_path / f"none.{suffix}", **PARTS)
        (tmp_path / f"folder.{suffix}").mkdir()
        with pytest.raises(DataError, match=rf"folder\.{suffix} is a folder"):
            read(str(tmp_path / f"folder.{suffix}"), **PARTS)

    def test_unreadable(self, tmp_path, monkeypatch):
        path = write(tmp_path, "u,y\n1,2\n3,4\n")

        def refuse(*_, **__):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr("pathlib.Path.read_bytes", refuse)
        monkeypatch.setattr(builtins, "open", refuse)
        with pytest.raises(DataError, match=r"run\.csv cannot be read: Permission denied"):
            read(path, **PARTS)

    def test_suffix(self, tmp_path):
        with pytest.raises(DataError, match=r"run\.xls: the suffix '\.xls' is not known"):
            read(write(tmp_path, "x", "run.xls"), **PARTS)

    def test_several_paths_become_records(self, tmp_path):
        one = write(tmp_path, "u,y\n1,2\n3,4\n", "one.csv")
        two = write(tmp_path, "y;u\n6;5\n8;7\n1;1\n", "two.txt")
        data = read([one, str(two)], **PARTS)
        assert data.lengths == (2, 3)
        np.testing.assert_array_equal(data.u[:, 0], [1, 3, 5, 7, 1])
        with pytest.raises(DataError, match="no path given"):
            read([], **PARTS)

    def test_several_paths_that_do_not_fit(self, tmp_path):
        one = write(tmp_path, "t,u,y\n0,1,2\n1,3,4\n", "one.csv")
        two = write(tmp_path, "t,u,y\n0,1,2\n2,3,4\n", "two.csv")
        with pytest.raises(DataError, match=r"two\.csv: the sample time is 2 s but .*one\.csv has"):
            read([one, two], inputs="u", outputs="y", time="t")
        np.savez(tmp_path / "a.npz", u=U, y=U)
        np.savez(tmp_path / "b.npz", u=U, y=Y)
        with pytest.raises(DataError, match=r"b\.npz: the channels are .* but .*a\.npz has"):
            read([tmp_path / "a.npz", tmp_path / "b.npz"], **PARTS)


class TestDataFrames:
    frame = pandas.DataFrame({"t": T, "u": U, "y1": Y[:, 0], 7: np.arange(N)})

    def test_columns(self):
        data = from_pandas(self.frame, inputs="u", outputs=["y1", 7], time="t")
        np.testing.assert_array_equal(data.y[:, 0], Y[:, 0])
        assert data.names["y"] == ("y1", "7") and data.dt == 0.5

    def test_index_of_dates(self):
        index = pandas.date_range("2024-01-01", periods=N, freq="250ms", name="when")
        data = from_pandas(self.frame.set_index(index), inputs="u", outputs="y1", time="when")
        assert data.dt == 0.25

    @pytest.mark.parametrize(
        "changes, options, message",
        [
            ({}, dict(inputs="v"), r"data frame: no column 'v'.*t, u, y1, 7"),
            ({"u": ["1", "x", *"2345"]}, {}, r"row 1, column 'u': 'x' is not a number"),
            (
                {"u": pandas.array([1, 2, None, 4, 5, 6], dtype="Int64")},
                {},
                r"row 2, column 'u': nan is not a finite",
            ),
            ({"t": T[::-1]}, dict(dt=None, time="t"), r"row 1, column 't': time goes from 2\.5"),
            ({}, dict(dt=None), r"the sample time is unknown"),
        ],
    )
    def test_faults(self, changes, options, message):
        frame = self.frame.assign(**changes)
        with pytest.raises(DataError, match=message):
            from_pandas(frame, **{"inputs": "u", "outputs": "y1", "dt": 0.5, **options})

    def test_not_a_frame(self):
        with pytest.raises(DataError, match="frame is a dict: give a pandas DataFrame"):
            from_pandas({"u": U}, **PARTS)

    def test_repeated_column(self):
        frame = pandas.concat([self.frame, self.frame[["u"]]], axis=1)
        with pytest.raises(DataError, match="column 'u' appears 2 times"):
            from_pandas(frame, inputs="u", outputs="y1", dt=1.0)


class TestMeasuredFiles:
    def test_positioning_system(self, measured_data):
        files = [measured_data / "emps" / f"DATA_EMPS{end}.mat" for end in ("", "_PULSES")]
        data = read(files, time="t", inputs=["vir"], outputs=["qm"])
        assert data.lengths == (24841, 24841) and data.dt == 1e-3
        raw = scipy.io.loadmat(files[1])
        np.testing.assert_array_equal(data.records[1].y, raw["qm"])

    @pytest.mark.parametrize(
        "name, inputs, outputs, shape",
        [
            ("robot_arm.dat", "1", "2", (1024, 1)),
            ("CD_player_arm.dat", [1, 2], [3, 4], (2048, 2)),
        ],
    )
    def test_daisy(self, measured_data, name, inputs, outputs, shape):
        path = measured_data / "daisy" / name
        data = read(path, inputs=inputs, outputs=outputs, dt=1.0)
        assert data.y.shape == shape
        raw = np.loadtxt(path)
        np.testing.assert_array_equal(np.column_stack([data.u, data.y]), raw)

    def test_aircraft(self, measured_data):
        path = measured_data / "f16gvt" / "f16_full_multisine_averaged.npz"
        data = read(path, inputs="force_1", outputs="acc_1", dt=1 / 400)
        assert data.y.shape == (8192, 3) and data.output_names[2] == "acc_1[2]"
        np.testing.assert_array_equal(data.y, np.load(path)["acc_1"].astype(float))
        with pytest.raises(DataError, match="'fs' has shape"):
            read(path, inputs="fs", outputs="acc_1", dt=1 / 400)
        with pytest.raises(DataError, match="'acc_noise_std_1' has 3 samples but 'force_1' has"):
            read(path, inputs="force_1", outputs="acc_noise_std_1", dt=1 / 400)

    @pytest.mark.parametrize("name, pairs", [("DATAUNIF", 2), ("DATAPRBS", 3)])
    def test_coupled_drives(self, measured_data, name, pairs):
        path = measured_data / "ced" / f"{name}.csv"
        for pair in range(1, pairs + 1):
            digits = f"1{pair}" if name == "DATAUNIF" else str(pair)
            data = read(path, inputs=f"u{digits}", outputs=f"z{digits}", dt=0.02)
            assert data.n_samples == 500

    def test_quarter_drone(self, measured_data):
        for path in sorted((measured_data / "quarter_drone").glob("*.csv")):
            data = read(
                path, inputs="Controle_u", outputs="Saida_y", scheduling="Saida_y", time="Tempo_s"
            )
            assert data.dt == 0.01 and data.n_samples >= 10000
            np.testing.assert_array_equal(data.y, data.kappa)

    def test_silverbox(self, measured_data):
        path = measured_data / "silverbox" / "SNLS80mV.csv"
        data = read(path, inputs="V1", outputs="V2", dt=1 / 610.35)
        assert data.n_samples == 131072
        np.testing.assert_array_equal(data[:2].y[:, 0], [0.0093978, 0.012971])
