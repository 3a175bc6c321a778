"""LPV models to MATLAB files, frozen on a grid of the scheduling; and such grids back."""

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from lpvid._files import write_atomically
from lpvid.io._json import ModelFileError
from lpvid.models import GrayBoxLPV, LPVStateSpace, PolynomialBasis, StateSpace

_NAMES = ("A", "B", "C", "D")
# Relative: entries that are polynomials in κ reproduce the frozen models to rounding.
_EXACT = 1e-9

_GRID_LINES = """\
% Frozen models of an LPV model, written by lpvid. A(:,:,i), B(:,:,i), C(:,:,i), D(:,:,i) are the
% matrices at kappa(i,:); dt is the sample time in seconds, 0 for continuous time.
s = load('model.mat');
sys = ss(s.A, s.B, s.C, s.D, s.dt);              % an array of models
sys.SamplingGrid = struct({grid});
G = ssInterpolant(sys);                          % an LPV model, linear between the points
"""
_COEFFICIENT_LINES = """\
% The model as a polynomial: with phi(j) = prod(((p - s.centre) ./ s.half_range) .^
% s.exponents(j,:)) the matrix A at p is the sum over j of phi(j) * s.A_coefficients(:,:,j), and B,
% C, D alike. Put these lines in a file modelData.m of their own:
%   function [A,B,C,D,E,dx0,x0,u0,y0,Delays] = modelData(t,p)
%   persistent s; if isempty(s), s = load('model.mat'); end
%   phi = prod(((p(:).' - s.centre) ./ s.half_range) .^ s.exponents, 2);
%   at = @(M) sum(M .* reshape(phi,1,1,[]), 3);
%   A = at(s.A_coefficients); B = at(s.B_coefficients);
%   C = at(s.C_coefficients); D = at(s.D_coefficients);
%   E = []; dx0 = []; x0 = []; u0 = []; y0 = []; Delays = [];
%   end
G = lpvss({parameters}, @modelData, s.dt);
"""


def save_mat(
    path: str | os.PathLike[str], lpv: LPVStateSpace | GrayBoxLPV, kappas: ArrayLike | Sequence
) -> Path:
    """Write an LPV model, frozen on a grid, to a MATLAB file laid out for `ss`, `lpvss` and kin.

    The file holds `A` (nx, nx, point) and so on, `kappa` (point, scheduling), `dt`, and `readme`:
    the MATLAB lines that make an LPV model of it. Where the matrices are polynomials in κ (a
    `PolynomialBasis`, and a structure affine in its parameters), also `A_coefficients` (nx, nx,
    function) and so on, with `exponents`, `centre` and `half_range` of the functions, so that
    MATLAB's model is this one at every κ. `save` keeps the model itself.

    Args:
        path: where to, with the ending `.mat`.
        lpv: the model.
        kappas: the grid, shape (n_points,) or (n_points, n_scheduling); warns outside of the hull.

    Returns:
        The path.

    Raises:
        ValueError: the grid has another shape.
        OSError: the folder is missing or not writable.

    Example:
        >>> from lpvid.interpolate import interpolate
        >>> models = [StateSpace([[-k]], [[1.0]], [[1.0]]) for k in (1.0, 2.0, 3.0)]
        >>> path = save_mat("lags.mat", interpolate(models, [1.0, 2.0, 3.0]), [1.0, 1.5, 2.0])
        >>> models, kappas = load_mat(path)
        >>> models[1].A.round(6).item(), kappas.tolist()
        (-1.5, [[1.0], [1.5], [2.0]])
    """
    from scipy.io import savemat

    lpv = lpv.lpv if isinstance(lpv, GrayBoxLPV) else lpv
    grid = np.asarray(kappas, float)
    grid = grid[:, None] if grid.ndim == 1 else grid
    if grid.ndim != 2 or grid.shape[1] != lpv.n_scheduling or not len(grid):
        raise ValueError(
            f"kappas: points of shape (n_points, {lpv.n_scheduling}) are needed, got {grid.shape}."
        )
    frozen = lpv.at(grid)
    content: dict[str, Any] = {
        name: np.moveaxis(np.asarray(getattr(frozen, name)), 0, -1) for name in _NAMES
    }
    coefficients = _coefficients(lpv, frozen, grid)
    content |= {"kappa": grid, "dt": frozen.dt, "readme": _readme(lpv, bool(coefficients))}
    buffer = io.BytesIO()
    savemat(buffer, content | coefficients, do_compression=True)
    return write_atomically(path, buffer.getvalue())


def _readme(lpv: LPVStateSpace, polynomial: bool) -> str:
    count = lpv.n_scheduling
    names = ["kappa"] if count == 1 else [f"kappa{k + 1}" for k in range(count)]
    columns = ["s.kappa"] if count == 1 else [f"s.kappa(:,{k + 1})" for k in range(count)]
    grid = ", ".join(f"'{name}', {column}" for name, column in zip(names, columns, strict=True))
    parameters = "{" + ", ".join(f"'{name}'" for name in names) + "}"
    text = _GRID_LINES.format(grid=grid)
    return text + _COEFFICIENT_LINES.format(parameters=parameters) if polynomial else text


def _coefficients(
    lpv: LPVStateSpace, frozen: StateSpace, grid: Float[np.ndarray, "point scheduling"]
) -> dict[str, Any]:
    """The matrices' own polynomials, where they are polynomials in κ."""
    basis = lpv.basis
    if not isinstance(basis, PolynomialBasis):
        return {}

    def matrices(parameters):
        model = lpv.structure.matrices(parameters)
        return {name: getattr(model, name) for name in _NAMES}

    nothing = jnp.zeros(lpv.structure.n_parameters)
    constant, slope = jax.jit(lambda p: (matrices(p), jax.jacfwd(matrices)(p)))(nothing)
    functions = np.asarray(basis(grid))
    first = [index for index, powers in enumerate(basis.exponents) if not any(powers)]
    content = {}
    for name in _NAMES:
        blocks = np.asarray(slope[name]) @ np.asarray(lpv.coefficients).T
        blocks[..., first[0]] += np.asarray(constant[name])
        wanted = np.moveaxis(np.asarray(getattr(frozen, name)), 0, -1)
        size = np.max(np.abs(wanted)) or 1.0
        if not np.max(np.abs(blocks @ functions.T - wanted)) <= _EXACT * size:
            return {}
        content[f"{name}_coefficients"] = blocks
    return content | {
        "exponents": np.array(basis.exponents, float),
        "centre": np.asarray(basis.centre)[None],
        "half_range": np.asarray(basis.half_range)[None],
    }


def load_mat(
    path: str | os.PathLike[str],
) -> tuple[list[StateSpace], Float[np.ndarray, "point scheduling"]]:
    """Read models on a grid of the scheduling: a file of `save_mat`, or one written in MATLAB.

    In MATLAB, `save('model.mat', 'A', 'B', 'C', 'D', 'kappa', 'dt', '-v7')` with the matrices along
    the third axis. `interpolate(models, kappas, ...)` makes an LPV model of what is returned.

    Args:
        path: the file; `D` and `dt` may be missing (zero, continuous time).

    Returns:
        The models, and κ of each, (n_points, n_scheduling).

    Raises:
        ModelFileError: the file is missing or damaged, or its arrays do not fit together.

    Example:
        >>> import scipy.io
        >>> one = np.ones((1, 1, 2))
        >>> content = {"A": -one, "B": one, "C": one, "kappa": [[0.0], [1.0]]}
        >>> scipy.io.savemat("from_matlab.mat", content)
        >>> load_mat("from_matlab.mat")[0][1].dc_gain().item()
        1.0
    """
    from scipy.io import loadmat

    try:
        stored = Path(path).read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise _error(path, f"it cannot be read ({reason})", "check the path") from error
    try:
        content = loadmat(io.BytesIO(stored))
    except NotImplementedError as error:
        raise _error(path, "it is of MATLAB's version 7.3", "save it with '-v7'") from error
    # SciPy meets a damaged file with whatever its reader runs into.
    except Exception as error:
        raise _error(
            path, f"it is truncated or no MATLAB file ({error})", "take an undamaged copy"
        ) from error
    missing = [name for name in ("A", "B", "C", "kappa") if name not in content]
    if missing:
        raise _error(path, f"it has no {', '.join(missing)}", "see save_mat for the layout")
    try:
        return _models(content)
    except (ValueError, TypeError) as error:
        raise _error(
            path, f"its arrays do not fit: {error}", "see save_mat for the layout"
        ) from error


def _models(content: dict[str, Any]) -> tuple[list[StateSpace], np.ndarray]:
    kappas = np.asarray(content["kappa"], float)
    A = np.asarray(content["A"], float)
    # MATLAB drops a last axis of one, and has rows of points as well as columns.
    count = A.shape[2] if A.ndim == 3 else 1
    if kappas.shape[0] != count and kappas.shape == (1, count):
        kappas = kappas.T
    if kappas.ndim != 2 or kappas.shape[0] != count:
        raise ValueError(f"kappa has shape {kappas.shape} for {count} model(s)")
    dt = float(np.asarray(content["dt"]).item()) if "dt" in content else 0.0
    stacked = {}
    for name in _NAMES:
        if name not in content:
            continue
        array = np.asarray(content[name], float)
        array = array[:, :, None] if array.ndim == 2 else array
        if array.ndim != 3 or array.shape[2] not in (1, count):
            raise ValueError(f"{name} has shape {array.shape} for {count} model(s)")
        stacked[name] = np.broadcast_to(array, (*array.shape[:2], count))
    models = [
        StateSpace(**{name: array[:, :, i] for name, array in stacked.items()}, dt=dt)
        for i in range(count)
    ]
    return models, kappas


def _error(path: str | os.PathLike[str], reason: str, remedy: str) -> ModelFileError:
    return ModelFileError(f"{os.fspath(path)}: {reason}; {remedy}.")
