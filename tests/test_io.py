import json
import math
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import InnovationModel, PastOutputMOESP, identify
from lpvid.io import ModelFileError, load, save
from lpvid.io._encoding import field_names
from lpvid.io._known import known_classes
from lpvid.mechanics import (
    ArmScales,
    DissipativeTwoLinkArm,
    TwoLinkArmStructure,
    two_link_arm_structure,
)
from lpvid.models import (
    FreeStructure,
    FunctionStructure,
    LPVStateSpace,
    MechanicalStructure,
    ModalStructure,
    PolynomialBasis,
    Spline,
    StateSpace,
    StructuredModel,
    Tustin,
    convex_hull,
    feedback,
    polynomial_basis,
    series,
)
from lpvid.refinement import refine
from lpvid.restructure import restructure

RNG = np.random.default_rng(0)
SCALES = ArmScales(jnp.full(4, 1 / 3), jnp.array([1e-300, 7.0]), jnp.array([0.1, 0.2]))
STRUCTURES = [
    FreeStructure(2, 1, 1),
    FreeStructure(2, 1, 3, feedthrough=False),
    ModalStructure(n_modes=2, n_inputs=2, n_outputs=1, feedthrough=True, reference_input=1),
    MechanicalStructure(n_degrees=2, measured="velocity"),
    two_link_arm_structure(lengths=(0.1, 0.7)),
    two_link_arm_structure(lengths=(0.35, 0.3), scales=SCALES),
    DissipativeTwoLinkArm((0.35, 0.3), SCALES),
]


@pytest.fixture
def path(tmp_path):
    return save(tmp_path / "model.json", StateSpace([[-1.0]], [[1.0]], [[2.0]]))


def _edit(path, change) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def _lpv(structure) -> LPVStateSpace:
    basis = polynomial_basis(np.array([[0.1, -1.0], [0.4, 0.0], [1.3, 1.0]]), 1)
    return LPVStateSpace(
        structure,
        basis,
        jnp.asarray(RNG.normal(size=(3, structure.n_parameters))),
        jnp.array([0.1, -1.0]),
        jnp.array([1.3, 1.0]),
    )


def _same(first, second) -> bool:
    """Equal structure, static fields, dtypes and bits (NaN equals NaN, 0.0 is not -0.0)."""
    if jax.tree.structure(first) != jax.tree.structure(second):
        return False
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    return all(a.dtype == b.dtype and np.array_equal(_bits(a), _bits(b)) for a, b in pairs)


def _bits(array) -> np.ndarray:
    array = np.asarray(array)
    # NaNs of any payload count as one.
    canonical = np.where(np.isnan(array), np.nan, array).astype(array.dtype)
    return np.frombuffer(canonical.tobytes(), np.uint8)


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: type(s).__name__)
def test_lpv_models_come_back_exactly(structure, tmp_path):
    lpv = _lpv(structure)
    path = save(tmp_path / "model.json", lpv)
    assert _same(load(path), lpv)
    assert type(load(path).structure) is type(structure)


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: type(s).__name__)
def test_structures_come_back_alone(structure, tmp_path):
    assert _same(load(save(tmp_path / "structure.json", structure)), structure)


def test_a_loaded_model_computes_the_same(tmp_path):
    model = StateSpace(-np.eye(2), RNG.normal(size=(2, 1)), RNG.normal(size=(1, 2)))
    loaded = load(save(tmp_path / "model.json", model))
    omega = np.array([0.1, 1.0, 10.0])
    np.testing.assert_array_equal(loaded.frequency_response(omega), model.frequency_response(omega))


def test_basis_and_batch_of_models(tmp_path):
    basis = polynomial_basis(np.array([[0.0], [1.0], [5.0]]), 2)
    assert _same(load(save(tmp_path / "basis.json", basis)), basis)
    batch = StateSpace(RNG.normal(size=(3, 2, 2)), np.ones((2, 1)), np.ones((1, 2)), dt=1 / 3)
    loaded = load(save(tmp_path / "batch.json", batch))
    assert _same(loaded, batch)
    assert loaded.dt == 1 / 3 and loaded.batch_shape == (3,)


@settings(max_examples=25, deadline=None)
@given(
    entries=hnp.arrays(np.float64, (3, 3), elements=st.floats(width=64)),
    dt=st.floats(0.0, 1e6),
)
def test_every_float_comes_back_bit_for_bit(entries, dt, tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "model.json"
    model = StateSpace(entries, entries[:, :1], entries[:2], dt=dt)
    loaded = load(save(path, model))
    assert _same(loaded, model)
    assert loaded.dt == dt


def test_nonfinite_and_extreme_values(tmp_path):
    values = np.array([[np.nan, np.inf], [-np.inf, -0.0]])
    extreme = np.array([[5e-324], [1.7976931348623157e308]])
    model = StateSpace(values, extreme, extreme.T)
    path = save(tmp_path / "model.json", model)
    assert _same(load(path), model)
    assert math.copysign(1.0, float(load(path).A[1, 1])) == -1.0
    # Standard JSON: no bare NaN or Infinity that other readers would refuse.
    json.loads(path.read_text(), parse_constant=pytest.fail)


def test_the_header_says_what_it_is(tmp_path):
    document = json.loads(save(tmp_path / "m.json", _lpv(STRUCTURES[0])).read_text())
    assert document["format"] == "lpvid"
    assert document["version"] == 2
    assert document["kind"] == "LPVStateSpace"


def test_constructors_take_every_field_by_name():
    import inspect

    for cls in known_classes().values():
        assert list(inspect.signature(cls).parameters) == list(field_names(cls))


def test_every_structure_and_basis_of_the_library_is_known():
    for cls in (PolynomialBasis, TwoLinkArmStructure, FreeStructure, MechanicalStructure):
        assert known_classes()[cls.__name__] is cls


CONNECTED = series(
    LPVStateSpace(
        FreeStructure(1, 1, 1, feedthrough=False),
        Spline((0.0, 1.0, 3.0)).basis([0.0]),
        -jnp.ones((3, 3)) / 3.0,
        jnp.zeros(1),
        jnp.full(1, 3.0),
        convex_hull([0.0, 3.0]),
    ),
    StateSpace([[-1 / 3]], [[1.0]], [[0.1]]),
)


@pytest.mark.parametrize(
    "lpv",
    [
        CONNECTED,
        CONNECTED.discretise(0.1, Tustin()),
        feedback(CONNECTED, eqx.tree_at(lambda m: m.basis, CONNECTED, Spline().basis([0, 1, 2.0]))),
    ],
    ids=["spline in series", "discrete", "loop of two"],
)
def test_new_bases_hulls_and_connections_come_back_exactly(lpv, tmp_path):
    loaded = load(save(tmp_path / "model.json", lpv))
    assert _same(loaded, lpv)
    np.testing.assert_array_equal(loaded.at(1.7).A, lpv.at(1.7).A)


def test_files_of_version_1_are_read(path):
    lpv = _lpv(STRUCTURES[0])
    save(path, lpv)
    _edit(path, lambda document: document["fields"].pop("hull"))
    with pytest.raises(ModelFileError, match="needs the fields"):
        load(path)
    _edit(path, lambda document: document.update(version=1))
    assert _same(load(path), lpv)


def _record():
    u = RNG.normal(size=200)
    model = StateSpace([[-3.0, 2.0], [-2.0, -1.0]], [[1.0], [0.5]], [[1.0, 0.0]])
    y = np.asarray(model.simulate(u=u, dt=0.05)) + 0.01 * RNG.normal(size=(200, 1)) + 2.0
    return model, IOData(u=u, y=y, dt=0.05)


def test_fits_come_back_with_offsets_and_noise_models(path):
    _, data = _record()
    fit = identify(data, PastOutputMOESP(order=2, block_rows=6, offset=True))
    loaded = load(save(path, fit))
    assert _same(loaded, fit) and type(loaded) is type(fit)
    assert abs(loaded.output_offset[0] - 2.0) < 0.1
    assert Status[loaded.status] == Status[fit.status]
    # What is worked out from the moments when asked for.
    np.testing.assert_array_equal(loaded.innovation_gain, fit.innovation_gain)
    assert _same(load(save(path, fit.innovation)), fit.innovation)


@pytest.mark.slow
def test_refined_and_restructured_models_come_back(path):
    model, data = _record()
    data = eqx.tree_at(lambda record: record.y, data, data.y - 2.0)
    structure = ModalStructure(1, 1, 1, feedthrough=True)
    start = StructuredModel(structure, structure.parameters_of(model))
    for refined in (refine(model, data), refine(start, data)):
        loaded = load(save(path, refined))
        assert _same(loaded, refined)
        assert loaded.advice == refined.advice
    found = restructure(model, structure, starts=2, key=jax.random.key(0))
    assert _same(load(save(path, found)), found)


def test_an_unknown_status_is_named(path):
    noise = InnovationModel(jnp.ones((1, 1)), jnp.ones((1, 1)), Status.no_stable_gain)
    assert _same(load(save(path, noise)), noise)
    _edit(path, lambda document: document["fields"]["status"].update(status=["Fine."]))
    with pytest.raises(ModelFileError, match="unknown status 'Fine.'"):
        load(path)


# What cannot be saved


def test_functions_are_refused_and_no_file_is_left(tmp_path):
    structure = FunctionStructure(
        lambda p: (-p[None, None, 0], jnp.ones((1, 1)), jnp.ones((1, 1))), nominal=[1.0]
    )
    for obj in (structure, eqx.tree_at(lambda m: m.structure, _lpv(STRUCTURES[0]), structure)):
        with pytest.raises(ValueError, match="Python function, which cannot be saved"):
            save(tmp_path / "model.json", obj)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("obj", [np.ones(3), {"a": 1}, "text", 1.0, None])
def test_other_objects_are_refused(obj, tmp_path):
    with pytest.raises(ValueError, match="cannot be saved; saved are StateSpace"):
        save(tmp_path / "model.json", obj)


def test_traced_values_are_refused(tmp_path):
    def inside(a):
        save(tmp_path / "model.json", StateSpace(a, jnp.ones((1, 1)), jnp.ones((1, 1))))
        return a

    with pytest.raises(ValueError, match="obj.A: its values are traced"):
        jax.jit(inside)(jnp.ones((1, 1)))


def test_foreign_fields_are_named(tmp_path):
    broken = eqx.tree_at(lambda m: m.coefficients, _lpv(STRUCTURES[0]), replace=object())
    with pytest.raises(ValueError, match="obj.coefficients: a object cannot be saved"):
        save(tmp_path / "model.json", broken)


# Files that cannot be read


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ModelFileError, match=r"nowhere\.json: it cannot be read .*check the path"):
        load(tmp_path / "nowhere.json")
    with pytest.raises(ModelFileError, match="cannot be read"):
        load(tmp_path)


def test_every_truncation_is_noticed(path):
    content = path.read_bytes()
    for length in range(0, len(content.rstrip()), 7):
        path.write_bytes(content[:length])
        with pytest.raises(ModelFileError, match=r"model\.json: it is (empty|truncated)"):
            load(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"time,u,y\n0,1,2\n", "not a JSON object"),
        (b"\x89PNG\r\n", "not a JSON object"),
        (b"[1, 2]", "not a JSON object"),
        (b'{"a": "\xff"}', "not text in UTF-8"),
        (b'{"a": 1}', "not a model file"),
        (b'{"a": ' + b"[" * 100_000, "nested too deeply|truncated"),
    ],
)
def test_other_files_are_told_apart(path, content, message):
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=message):
        load(path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("version", 3, "its version is 3, and this lpvid reads up to 2; update lpvid"),
        ("version", "1", "'1' is no version number"),
        ("kind", "KalmanFilter", "its kind 'KalmanFilter' is unknown"),
        ("kind", "FreeStructure", "needs the fields"),
        ("kind", ["StateSpace"], "is unknown"),
        ("fields", None, "needs the fields"),
    ],
)
def test_headers_are_checked(path, key, value, message):
    _edit(path, lambda document: document.update({key: value}))
    with pytest.raises(ModelFileError, match=message):
        load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("dt"), "needs the fields"),
        (lambda f: f.update(extra=1), "needs the fields"),
        (lambda f: f.update(dt=-1.0), "dt is -1.0"),
        (lambda f: f["A"]["array"].update(shape=[2, 1]), "1 values for the shape"),
        (lambda f: f["A"]["array"].update(shape=[-1, -1]), "values for the shape"),
        (lambda f: f["A"]["array"].update(dtype="object"), "unknown dtype 'object'"),
        (lambda f: f["A"]["array"].update(values=["one"]), "content does not fit"),
        (lambda f: f["A"]["array"].update(values=[[1.0]]), "values for the shape"),
        (lambda f: f["A"]["array"].update(dtype="int32", values=[10**30]), "does not fit"),
        (lambda f: f["A"]["array"].pop("dtype"), "needs dtype, shape and values"),
        (lambda f: f.update(A={"class": "os.system", "fields": {}}), "unknown class 'os.system'"),
        (lambda f: f.update(A={"what": 1}), "neither a value nor"),
        (lambda f: f["B"]["array"].update(shape=[1, 1, 1]), None),
    ],
)
def test_content_is_checked(path, change, message):
    _edit(path, lambda document: change(document["fields"]))
    if message is None:  # a leading batch axis is a model too
        assert load(path).batch_shape == (1,)
        return
    with pytest.raises(ModelFileError, match=message):
        load(path)


def test_an_interrupted_write_leaves_the_old_file(path, monkeypatch):
    before = path.read_bytes()

    def fail(*args):
        raise OSError("disk full")

    for name in ("fsync", "replace"):
        with monkeypatch.context() as patched:
            patched.setattr(os, name, fail)
            with pytest.raises(OSError, match="disk full"):
                save(path, STRUCTURES[0])
        assert path.read_bytes() == before
        assert os.listdir(path.parent) == ["model.json"]
    save(path, STRUCTURES[0])
    assert _same(load(path), STRUCTURES[0])


def test_a_link_is_followed_and_a_missing_folder_named(path, tmp_path):
    link = tmp_path / "latest.json"
    link.symlink_to(path)
    save(link, STRUCTURES[0])
    assert link.is_symlink()
    assert _same(load(path), STRUCTURES[0])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        save(tmp_path / "nowhere" / "model.json", STRUCTURES[0])
