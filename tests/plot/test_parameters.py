import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from lpvid.models import FreeStructure, LPVStateSpace, polynomial_basis
from lpvid.plot import parameters

KAPPAS = np.array([0.0, 1.0, 2.0])
LOCAL = np.arange(12.0).reshape(3, 4)


def test_dots_line_and_reference(lpv):
    def physics(kappa):
        return np.array([3.0 + kappa, -3.0, 1.0, 2.0 - kappa**2])

    panels = parameters(lpv, KAPPAS, LOCAL, reference=physics)
    assert panels.shape == (4,)
    grid = np.linspace(0.0, 2.0, 101)
    exact = np.stack([3.0 + grid, np.full(101, -3.0), np.ones(101), 2.0 - grid**2], axis=1)
    model = np.stack(
        [3.0 + grid, np.full(101, np.log(0.05)), np.ones(101), 1.5 + 0.5 * grid], axis=1
    )
    for index, panel in enumerate(panels):
        line, reference, dots = panel.lines
        np.testing.assert_allclose(line.get_xdata(), grid)
        np.testing.assert_allclose(line.get_ydata(), model[:, index], atol=1e-12)
        np.testing.assert_allclose(reference.get_ydata(), exact[:, index])
        assert reference.get_linestyle() == "--"
        np.testing.assert_array_equal(dots.get_xdata(), KAPPAS)
        np.testing.assert_array_equal(dots.get_ydata(), LOCAL[:, index])
        assert dots.get_linestyle() == "None"
        assert panel.get_title(loc="left") == lpv.structure.parameter_names[index]
    (legend,) = panels[0].figure.legends
    assert [t.get_text() for t in legend.get_texts()] == ["LPV model", "reference", "local models"]


def test_a_choice_with_names_and_results(lpv):
    class Result:
        def __init__(self, values):
            self.parameters = jnp.asarray(values)

    panels = parameters(
        lpv,
        KAPPAS,
        [Result(row) for row in LOCAL],
        reference=LOCAL + 1.0,
        names=["a", "b", "c", "d"],
        which=[3, 0, 1],
        name="load",
    )
    assert [panel.get_title(loc="left") for panel in panels] == ["d", "a", "b"]
    np.testing.assert_array_equal(panels[0].lines[1].get_ydata(), LOCAL[:, 3] + 1.0)
    np.testing.assert_array_equal(panels[0].lines[2].get_ydata(), LOCAL[:, 3])
    assert len(panels[0].figure.axes) == 3  # the fourth place of the grid is left empty
    assert panels[2].get_xlabel() == "load"


def test_two_scheduling_variables_are_cut_along_one():
    points = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0], [4.0, 0.0], [4.0, 1.0], [4.0, 2.0]])
    basis = polynomial_basis(points, 1)
    structure = FreeStructure(1, 1, 1, feedthrough=False)
    coefficients = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
    lpv = LPVStateSpace(
        structure, basis, coefficients, jnp.array([0.0, 0.0]), jnp.array([4.0, 2.0])
    )
    local = np.asarray(lpv.parameters(points))
    panels = parameters(lpv, points, local, along=0, at=[0.0, 2.0])
    line, here, elsewhere = panels[0].lines
    np.testing.assert_allclose(line.get_xdata(), np.linspace(0, 4, 101))
    # The local models on the cut lie on the line, since they were taken from it.
    np.testing.assert_allclose(here.get_xdata(), [0.0, 4.0])
    np.testing.assert_allclose(here.get_ydata(), line.get_ydata()[[0, -1]])
    assert elsewhere.get_xdata().size == 4
    assert panels[2].get_xlabel() == "κ1"


def test_given_axes(lpv):
    _, axes = plt.subplots(2, 2)
    panels = parameters(lpv, axes=axes)
    assert list(panels) == list(axes.ravel())
    assert all(len(panel.lines) == 1 for panel in panels)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameters": LOCAL}, "parameters: shape .* kappas needed"),
        ({"kappas": KAPPAS, "parameters": LOCAL[:2]}, "parameters: shape"),
        ({"names": ["a"]}, "names: 1 given for 4"),
        ({"reference": LOCAL}, "reference: values need kappas"),
        ({"reference": lambda kappa: np.zeros(2)}, "reference: 4 parameters"),
        ({"kappas": np.zeros((3, 2))}, "kappas: shape"),
    ],
)
def test_faults_are_named(lpv, arguments, message):
    with pytest.raises(ValueError, match=message):
        parameters(lpv, **arguments)
