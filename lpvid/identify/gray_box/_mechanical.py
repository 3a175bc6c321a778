"""Mass, damping and stiffness from records (Olofsson et al. 2014)."""

import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify._checks import above_rank, few_samples
from lpvid.identify.gray_box._candidates import mechanical
from lpvid.identify.gray_box._cone import nearest_semidefinite
from lpvid.identify.gray_box._methods import AbstractContinuousTimeMethod, ContinuousTimeMOESP
from lpvid.identify.gray_box._search import (
    NEGLIGIBLE,
    UNEXCITED,
    FilterSearch,
    best,
    check_excitation,
    describe_filters,
    resolve_filters,
    search_table,
    unit_rms,
)
from lpvid.identify.gray_box._subspace import dynamics, ranges
from lpvid.mechanics import MassSpringDamper, UndampedModes
from lpvid.models import MechanicalStructure, StateSpace

# Share of the largest eigenvalue that the parameters' logarithms need a singular matrix to have.
_INTERIOR = 1e-4
_MATRICES = ("mass", "damping", "stiffness")


class MechanicalFit(eqx.Module):
    """Result of `identify_mechanical`: M ÿ + D ẏ + K y = u.

    Without covariances, since the filters colour the noise: `lpvid.refine(fit, data)` starts from
    it and has them.

    Attributes:
        mass: M (n, n), symmetric positive definite, in the units of input · s² / output.
        damping: D (n, n), symmetric positive semidefinite, input · s / output.
        stiffness: K (n, n), symmetric positive definite, input / output.
        model: the same in continuous time, states [y, ẏ].
        x0: initial state of every record, (record, 2 n).
        fit: simulation fit (BFT) to the identification data, percent for each output, (n,).
        tau: time constant of the filters that were kept, s.
        block_rows: number of rows that was kept.
        search: every filter that was tried.
        singular_values: of the projected data at the filters kept, (row,).
        status: how it ended.
        stats: arrays by name: `smallest_pivot` (share of a filtered input, in squares, that the
            others do not explain), `mass_clipped`, `damping_clipped`, `stiffness_clipped` (whether
            definiteness had to be enforced).

    Example:
        >>> import jax
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import ContinuousTimeMOESP, identify_mechanical
        >>> from lpvid.mechanics import MassSpringDamper, random_steps
        >>> system = MassSpringDamper([[2.0]], [[1.0]], [[50.0]])
        >>> u = random_steps(jax.random.key(0), 2000, dt=0.02)
        >>> y = system.state_space().simulate(u=u, dt=0.02)
        >>> fit = identify_mechanical(
        ...     IOData(u=u, y=y, dt=0.02), ContinuousTimeMOESP(tau=0.2, block_rows=4)
        ... )
        >>> fit.modes.frequencies.round(4).tolist()
        [5.0]
    """

    mass: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]
    stiffness: Float[Array, "dof dof"]
    model: StateSpace
    x0: Float[Array, "record nx"]
    fit: Float[Array, " dof"]
    tau: Float[Array, ""]
    block_rows: Int[Array, ""]
    search: FilterSearch
    singular_values: Float[Array, " row"]
    status: Status
    stats: dict[str, Array]

    @property
    def structure(self) -> MechanicalStructure:
        """The structure whose parameters `parameters` are."""
        return MechanicalStructure(n_degrees=self.mass.shape[0])

    @property
    def parameters(self) -> Float[Array, " parameter"]:
        """M, D and K in the coordinates of `structure`: where a refinement starts.

        Those coordinates are logarithmic: a singular D is moved inside its cone a little.
        """
        matrices = (self.mass, self.damping, self.stiffness)
        inside = [nearest_semidefinite(matrix, _INTERIOR)[0] for matrix in matrices]
        return self.structure.parameters_of(*inside)

    @property
    def system(self) -> MassSpringDamper:
        """The plant these matrices belong to."""
        return MassSpringDamper(self.mass, self.damping, self.stiffness)

    @property
    def modes(self) -> UndampedModes:
        """Modal analysis K v = ω² M v: frequencies in rad/s, damping ratios, shapes."""
        return self.system.modes()


def identify_mechanical(
    data: IOData, method: AbstractContinuousTimeMethod | None = None, *, throw: bool = True
) -> MechanicalFit:
    r"""Identify mass, damping and stiffness from forces and displacements.

    The signals are filtered by a chain of first-order filters with time constant τ (exactly: inputs
    held, outputs straight between samples). A subspace step gives A and C, and the state becomes
    $[y, \dot y]$ by $T = [C; C A]$. The lower block of B is found by least squares in the
    simulation error over the symmetric positive definite matrices; $M = B_2^{-1}$, and K and D are
    the (semi)definite matrices nearest to $-M A_{21}$ and $-M A_{22}$. Every τ and number of rows
    asked for is tried in one batch, and the one whose final model explains the records best is
    kept. Records may start in motion.

    Runs under `jit`, `vmap` and `lax.map` where the method gives τ; there the checks are not made
    and `status` says what happened. Differentiable with respect to the signals while the singular
    values are distinct and no eigenvalue is clipped.

    Args:
        data: one or several records with as many inputs (forces) as outputs (displacements), in the
            same order and positive in the same direction.
        method: `ContinuousTimeMOESP()` by default; its order, if given, must be twice the degrees
            of freedom.
        throw: raise where the data cannot give a model. `False` returns it with its status.

    Returns:
        The matrices, the model, the modes, and the table of the search.

    Raises:
        ValueError: numbers of inputs and outputs differ, another order, a feedthrough, too few
            samples, τ out of range, constant channels, inputs that excite too little.

    Warns:
        UserWarning: a matrix had to be made (semi)definite, the order is above the data's rank,
            or samples are few.

    Source: 000, section II.

    Example:
        >>> import jax
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import ContinuousTimeMOESP, identify_mechanical
        >>> from lpvid.mechanics import MassSpringDamper, random_steps
        >>> system = MassSpringDamper([[2.0]], [[1.0]], [[50.0]])
        >>> u = random_steps(jax.random.key(0), 2000, dt=0.02)
        >>> y = system.state_space().simulate(u=u, dt=0.02)
        >>> fit = identify_mechanical(
        ...     IOData(u=u, y=y, dt=0.02), ContinuousTimeMOESP(tau=0.2, block_rows=4)
        ... )
        >>> round(fit.mass.item(), 3), round(fit.stiffness.item(), 3)
        (2.0, 50.0)
    """
    method = ContinuousTimeMOESP() if method is None else method
    n, dt = data.ny, data.dt
    _check_degrees(method, data)
    traced = isinstance(data.u, Tracer) or isinstance(data.y, Tracer)
    taus, rows = resolve_filters(method, data, 2 * n)
    u, y, input_scale, output_scale = unit_rms(data.u, data.y)
    samples = jnp.asarray(taus) / dt
    found = ranges(u, y, samples, method=method.weights, block_rows=rows, lengths=data.lengths)
    if not traced and throw:
        check_excitation(data, found, min(rows))
    As, Cs = dynamics(found, samples, filters=method.filters, order=2 * n, ny=n)
    candidates = mechanical(
        As.reshape(-1, 2 * n, 2 * n),
        Cs.reshape(-1, n, 2 * n),
        u,
        y,
        # Relative to one another only: M, D and K come out near one in every unit.
        input_scale / jnp.max(input_scale),
        output_scale / jnp.max(output_scale),
        lengths=data.lengths,
    )
    values = _chosen(
        candidates,
        found,
        y,
        input_scale,
        output_scale,
        jnp.asarray(taus),
        dt=dt,
        rows=rows,
        lengths=data.lengths,
    )
    singular_values = values.pop("singular_values")
    if not traced:
        singular_values = singular_values[: int(values["block_rows"]) * n]
    fit = MechanicalFit(**values, singular_values=singular_values)
    if not traced:
        _report(fit, data, throw)
    return fit


@functools.partial(jax.jit, static_argnames=("dt", "rows", "lengths"))
def _chosen(candidates, found, y, input_scale, output_scale, taus, *, dt, rows, lengths):
    """Attributes of the fit: the best candidate in the data's units."""
    table = search_table(taus, rows, candidates["residual"], y, lengths)
    index = best(candidates)
    filters = describe_filters(found, index, taus.shape[0])
    chosen = jax.tree.map(lambda leaf: leaf[index], candidates)
    unit = jnp.max(input_scale) / jnp.max(output_scale)
    mass, damping, stiffness = (
        unit * dt**power * chosen[name]
        for name, power in (("mass", 2), ("damping", 1), ("stiffness", 0))
    )
    clipped = {f"{name}_clipped": chosen[f"{name}_clipped"] for name in _MATRICES}
    indefinite = jnp.any(jnp.stack(list(clipped.values())))
    finite = jnp.isfinite(jnp.sum(chosen["residual"])) & jnp.isfinite(jnp.sum(mass + stiffness))
    pivot = filters.pivot
    status = Status.where(indefinite, Status.indefinite, Status.successful)
    values, order = filters.singular_values, 2 * mass.shape[0]
    poor = ~(pivot > UNEXCITED) | (values[order - 1] <= NEGLIGIBLE * values[0])
    status = Status.where(poor, Status.ill_conditioned, status)
    status = Status.where(finite, status, Status.nonfinite)
    position = output_scale[None, :]
    return dict(
        mass=mass,
        damping=damping,
        stiffness=stiffness,
        model=_model(mass, damping, stiffness),
        x0=chosen["x0"] * jnp.concatenate([position, position / dt], axis=1),
        fit=table.fit[index],
        tau=table.tau[index],
        block_rows=table.block_rows[index],
        search=table,
        singular_values=filters.singular_values,
        status=status,
        stats={"smallest_pivot": pivot, **clipped},
    )


def _model(mass, damping, stiffness):
    n = mass.shape[0]
    zero, identity = jnp.zeros((n, n)), jnp.eye(n)
    solved = jnp.linalg.solve(mass, jnp.concatenate([-stiffness, -damping, identity], axis=1))
    upper = jnp.concatenate([zero, identity], axis=1)
    return StateSpace(
        A=jnp.concatenate([upper, solved[:, : 2 * n]]),
        B=jnp.concatenate([zero, solved[:, 2 * n :]]),
        C=jnp.concatenate([identity, zero], axis=1),
    )


def _check_degrees(method, data):
    if not isinstance(method, AbstractContinuousTimeMethod):
        raise ValueError(
            f"method={method!r}: give a continuous-time method such as "
            f"ContinuousTimeMOESP(tau=0.1, block_rows=6)."
        )
    if data.nu != data.ny:
        raise ValueError(
            f"data has {data.nu} inputs ({', '.join(data.input_names)}) and {data.ny} outputs "
            f"({', '.join(data.output_names)}): every degree of freedom needs one force and one "
            f"displacement; choose them with data.select, or use identify for a black box."
        )
    if method.order not in ("auto", 2 * data.ny):
        raise ValueError(
            f"order={method.order}: with {data.ny} degrees of freedom it is {2 * data.ny}; leave "
            f"it out."
        )
    if method.feedthrough:
        raise ValueError("feedthrough=True: a displacement does not jump with a force; leave it.")


def _report(fit: MechanicalFit, data: IOData, throw: bool) -> None:
    """Raise or warn, with the remedy."""
    order = fit.model.nx
    for message in (
        few_samples(order, data.nu, data.ny, data.n_samples),
        above_rank(order, np.asarray(fit.singular_values), NEGLIGIBLE),
    ):
        if message is not None:
            warnings.warn(message, stacklevel=3)
    if fit.status == Status.nonfinite:
        if throw:
            raise ValueError(
                "No filter gave a finite model. Look for outliers or wrong channels, give longer "
                "records, or try tau and block_rows of your own; throw=False returns what there is."
            )
    elif fit.status == Status.indefinite:
        names = [n for n in _MATRICES if bool(fit.stats[f"{n}_clipped"])]
        warnings.warn(
            f"The records alone give an indefinite {' and '.join(names)} matrix; the nearest "
            f"definite one is returned. Check the signs of the signals, the pairing of "
            f"inputs ({', '.join(data.input_names)}) with outputs ({', '.join(data.output_names)}) "
            f"and the length of the records.",
            stacklevel=3,
        )
