"""Refinement of LPV models in the command line: what is kept, and what is said of a failure."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid._results import Status
from lpvid.commands import _lpv_refine
from lpvid.commands._lpv_refine import refine_all
from lpvid.commands._messages import Warnings
from lpvid.data import IOData
from lpvid.models import FreeStructure, LPVStateSpace, ModalStructure, polynomial_basis


def of(structure):
    return LPVStateSpace(
        structure=structure,
        basis=polynomial_basis([0.0, 1.0], 1),
        coefficients=jnp.ones((2, structure.n_parameters)),
        kappa_low=jnp.zeros(1),
        kappa_high=jnp.ones(1),
    )


@pytest.fixture
def data():
    return IOData(u=np.ones(20), y=np.ones(20), dt=0.1, kappa=0.5)


@pytest.fixture
def ends(monkeypatch):
    """Makes `refine` end with a status and a cost, that of the start being 2."""

    def so(status, cost, model):
        found = types.SimpleNamespace(
            status=status,
            advice=f"{Status[status]} Not identified: coefficients[1,1].",
            cost=jnp.asarray(cost),
            initial_cost=jnp.asarray(2.0),
            stats={"steps": jnp.asarray(7)},
            model=model,
        )
        monkeypatch.setattr(_lpv_refine, "refine", lambda *_, **__: found)

    return so


@pytest.mark.parametrize(
    ("status", "cost", "kept", "words"),
    [
        (Status.overflow, 1.0, False, "as interpolated: The simulation grows without bound"),
        (Status.nonfinite, np.nan, False, "as interpolated: A non-finite number appeared"),
        (Status.successful, 3.0, False, "The cost did not fall"),
        (Status.max_steps, 1.0, True, "refined, but: The iteration limit"),
        (Status.unidentified, 1.0, True, "Not identified: mode 1 log damping of degree 1."),
    ],
)
def test_a_failed_refinement_leaves_the_interpolated_model(
    capsys, data, ends, status, cost, kept, words
):
    lpv = of(ModalStructure(n_modes=1, n_inputs=1, n_outputs=1))
    ends(status, cost, lpv)
    with Warnings("lpvid lpv") as warnings:
        result = refine_all(lpv, data, warnings)
    assert (result.model is lpv) is kept and result.content["kept"] is kept
    assert result.content["steps"] == 7
    (said,) = warnings.messages
    assert words in said and "coefficients" not in said
    assert said in capsys.readouterr().err


def test_the_free_basis_of_a_black_box_is_no_reason_for_advice(data, ends):
    lpv = of(FreeStructure(n_states=2, n_inputs=1, n_outputs=1))
    ends(Status.unidentified, 1.0, lpv)
    with Warnings("lpvid lpv") as warnings:
        result = refine_all(lpv, data, warnings)
    assert result.model is lpv and warnings.messages == []
    assert result.content["status"] == result.content["advice"] == "Successful."
    ends(Status.max_steps, 1.0, lpv)
    with Warnings("lpvid lpv") as warnings:
        refine_all(lpv, data, warnings)
    (said,) = warnings.messages
    assert "The iteration limit" in said and "coefficients" not in said
