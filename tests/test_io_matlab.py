"""MATLAB files: laid out as MATLAB's functions take them, and read back."""

import numpy as np
import pytest
import scipy.io

from lpvid.interpolate import interpolate
from lpvid.io import ModelFileError, load_mat, save_mat
from lpvid.models import ModalStructure, Polynomial, Spline, StateSpace, StructuredModel

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1.0, 1.0, size=(8, 2)) * [10.0, 0.1]
MODELS = [
    StateSpace(*(np.reshape(a, s) for a, s in zip(blocks, [(2, 2), (2, 1), (3, 2)], strict=True)))
    for blocks in zip(*(RNG.normal(size=(8, n)) for n in (4, 2, 6)), strict=True)
]
LPV = interpolate(MODELS, POINTS, Polynomial(1))


def test_pages_are_models_and_polynomials_are_these(tmp_path):
    content = scipy.io.loadmat(save_mat(tmp_path / "model.mat", LPV, POINTS))
    assert content["A"].shape == (2, 2, 8) and content["C"].shape == (3, 2, 8)
    np.testing.assert_array_equal(content["kappa"], POINTS)
    assert content["dt"].item() == 0.0
    for k in range(8):
        np.testing.assert_array_equal(content["C"][:, :, k], LPV.at(POINTS[k]).C)
    # The lines of the readme, in NumPy.
    p = POINTS.mean(axis=0)
    scaled = (p - content["centre"]) / content["half_range"]
    phi = np.prod(scaled ** content["exponents"], axis=1)
    for name in "ABCD":
        found = np.sum(content[f"{name}_coefficients"] * phi, axis=2)
        np.testing.assert_allclose(found, getattr(LPV.at(p), name), atol=1e-12)
    readme = "\n".join(content["readme"])
    assert "struct('kappa1', s.kappa(:,1), 'kappa2', s.kappa(:,2))" in readme
    assert "lpvss({'kappa1', 'kappa2'}, @modelData, s.dt)" in readme


def test_a_grid_read_back_is_interpolated_to_the_same_model(tmp_path):
    models, kappas = load_mat(save_mat(tmp_path / "model.mat", LPV, POINTS))
    again = interpolate(models, kappas, Polynomial(1))
    np.testing.assert_allclose(again.coefficients, LPV.coefficients, atol=1e-12)


@pytest.mark.slow
def test_models_that_are_no_polynomials_come_as_a_grid_alone(tmp_path):
    structure = ModalStructure(1, 1, 1)
    local = [StructuredModel(structure, [k, -1.0, 1.0, 0.0]) for k in (1.0, 2.0, 3.0)]
    for method in (Polynomial(1), Spline()):
        lpv = interpolate(local, [1.0, 2.0, 3.0], method).discretise(0.1)
        path = save_mat(tmp_path / "model.mat", lpv, [1.0, 2.0])
        content = scipy.io.loadmat(path)
        assert "A_coefficients" not in content and content["dt"].item() == 0.1
        assert "lpvss" not in "".join(content["readme"])
    models, kappas = load_mat(path)
    assert models[0].dt == 0.1 and kappas.tolist() == [[1.0], [2.0]]
    with pytest.raises(ValueError, match=r"kappas: points of shape \(n_points, 1\)"):
        save_mat(tmp_path / "model.mat", lpv, POINTS)


def test_what_matlab_writes_is_read(tmp_path):
    path = tmp_path / "matlab.mat"
    A = -np.ones((1, 1, 3)) * np.arange(1.0, 4.0)
    content = {"A": A, "B": [[1.0]], "C": [[2.0]], "kappa": [[0.0, 0.5, 1.0]], "dt": 0.0}
    scipy.io.savemat(path, content)
    models, kappas = load_mat(path)
    assert kappas.shape == (3, 1)
    np.testing.assert_allclose([m.dc_gain().item() for m in models], 2.0 / np.arange(1, 4))
    scipy.io.savemat(path, {"A": [[-1.0]], "B": [[1.0]], "C": [[1.0]], "kappa": [[7.0]]})
    models, kappas = load_mat(path)
    assert len(models) == 1 and kappas.tolist() == [[7.0]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("kappa"), "it has no kappa"),
        (lambda c: c.update(kappa=[[1.0], [2.0]]), r"kappa has shape \(2, 1\) for 3 model"),
        (lambda c: c.update(B=np.ones((1, 1, 2))), "B has shape"),
        (lambda c: c.update(B=np.ones((2, 1))), "its arrays do not fit: B has shape"),
        (lambda c: c.update(A="text"), "its arrays do not fit"),
    ],
)
def test_arrays_that_do_not_fit_are_named(change, message, tmp_path):
    content = {"A": -np.ones((1, 1, 3)), "B": [[1.0]], "C": [[2.0]], "kappa": np.ones((3, 1))}
    change(content)
    scipy.io.savemat(tmp_path / "bad.mat", content)
    with pytest.raises(ModelFileError, match=message):
        load_mat(tmp_path / "bad.mat")


def test_damaged_and_missing_files_are_named(tmp_path):
    path = save_mat(tmp_path / "model.mat", LPV, POINTS)
    content = path.read_bytes()
    for length in range(0, len(content) - 1, 97):
        path.write_bytes(content[:length])
        with pytest.raises(ModelFileError, match="truncated or no MATLAB|it has no"):
            load_mat(path)
    path.write_text("time,u,y\n" * 30)
    with pytest.raises(ModelFileError, match="no MATLAB file"):
        load_mat(path)
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_mat(tmp_path / "nowhere.mat")
