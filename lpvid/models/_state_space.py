"""Linear time-invariant state-space models."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from lpvid.models._hold import AbstractConversion, ZeroOrderHold
from lpvid.models._lifted import simulate_lti
from lpvid.models._transfer import transfer

# Plain lists of numbers are welcome where arrays are.
Numbers: TypeAlias = ArrayLike | Sequence


class Modes(eqx.Module):
    """Natural frequencies, damping ratios and poles, sorted by frequency.

    Attributes:
        frequency: natural frequency |s| in rad/s.
        damping: damping ratio −Re s / |s|, and one for a pole at s = 0.
        poles: poles s of the continuous-time (or equivalent continuous-time) model.
    """

    frequency: Float[Array, "*batch nx"]
    damping: Float[Array, "*batch nx"]
    poles: Complex[Array, "*batch nx"]


def _matrix(name: str, value: Numbers) -> Array:
    array = jnp.asarray(value)
    if array.ndim < 2:
        raise ValueError(
            f"{name} has shape {array.shape}; a matrix (two axes, with batch axes in front) is "
            f"needed. Write a row or a column explicitly, as in [[1.0, 0.0]]."
        )
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ValueError(f"{name} is complex; a real realisation is needed (see modal_form).")
    return array.astype(float)


def _common_batch(*matrices: Array) -> list[Array]:
    """The matrices with their leading axes broadcast, explicitly: the tests forbid promotion."""
    batch = jnp.broadcast_shapes(*(m.shape[:-2] for m in matrices))
    return [jnp.broadcast_to(m, (*batch, *m.shape[-2:])) for m in matrices]


def _join(first: Array, second: Array, axis: int) -> Array:
    return jnp.concatenate(_common_batch(first, second), axis=axis)


def _block_diagonal(first: Array, second: Array) -> Array:
    first, second = _common_batch(first, second)
    *batch, r1, c1 = first.shape
    r2, c2 = second.shape[-2:]
    upper = jnp.concatenate([first, jnp.zeros((*batch, r1, c2))], axis=-1)
    lower = jnp.concatenate([jnp.zeros((*batch, r2, c1)), second], axis=-1)
    return jnp.concatenate([upper, lower], axis=-2)


class StateSpace(eqx.Module):
    """A linear time-invariant model ẋ = A x + B u, y = C x + D u (or its discrete-time form).

    The matrices are leaves of the pytree and may have leading batch axes (operating points,
    Monte Carlo runs); every method broadcasts over them. `dt` is static.

    Example:
        >>> from lpvid.models import StateSpace
        >>> StateSpace([[-1.0]], [[1.0]], [[1.0]]).dc_gain().item()
        1.0
    """

    A: Float[Array, "*batch nx nx"]
    B: Float[Array, "*batch nx nu"]
    C: Float[Array, "*batch ny nx"]
    D: Float[Array, "*batch ny nu"]
    dt: float = eqx.field(static=True)

    def __init__(
        self,
        A: Numbers,
        B: Numbers,
        C: Numbers,
        D: Numbers | None = None,
        dt: float = 0.0,
    ):
        """Build a model from its matrices.

        Args:
            A: state matrix (nx, nx), with any leading batch axes, as the other matrices.
            B: input matrix (nx, nu).
            C: output matrix (ny, nx).
            D: feedthrough (ny, nu); zero when left out.
            dt: sample time in seconds; 0 means continuous time.

        Raises:
            ValueError: a matrix has the wrong shape or is complex, or dt is negative.
        """
        A, B, C = _matrix("A", A), _matrix("B", B), _matrix("C", C)
        nx, nu, ny = A.shape[-1], B.shape[-1], C.shape[-2]
        D = jnp.zeros((ny, nu)) if D is None else _matrix("D", D)
        for name, matrix, expected in (
            ("A", A, (nx, nx)),
            ("B", B, (nx, nu)),
            ("C", C, (ny, nx)),
            ("D", D, (ny, nu)),
        ):
            if matrix.shape[-2:] != expected:
                raise ValueError(
                    f"{name} has shape {matrix.shape}; with A {A.shape}, B {B.shape} and C "
                    f"{C.shape} it must end in {expected}. Check that no matrix is transposed."
                )
        try:
            self.A, self.B, self.C, self.D = _common_batch(A, B, C, D)
        except ValueError as error:
            shapes = ", ".join(str(m.shape) for m in (A, B, C, D))
            raise ValueError(f"The batch axes of A, B, C, D do not agree: {shapes}.") from error
        dt = float(dt)
        if not (dt >= 0.0 and math.isfinite(dt)):
            raise ValueError(f"dt is {dt}; give the sample time in seconds, or 0 (continuous).")
        self.dt = dt

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.A.shape[-1]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.B.shape[-1]

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return self.C.shape[-2]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of the matrices; `()` for one model."""
        return self.A.shape[:-2]

    @property
    def is_discrete(self) -> bool:
        """Whether the model has a sample time."""
        return self.dt > 0.0

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.is_discrete else "continuous"
        # During tree operations leaves may be anything: show what there is.
        if not all(hasattr(m, "shape") and len(m.shape) >= 2 for m in (self.A, self.B, self.C)):
            return f"StateSpace({time}, A={self.A!r})"
        batch = f", batch={self.batch_shape}" if self.batch_shape else ""
        return f"StateSpace(nx={self.nx}, nu={self.nu}, ny={self.ny}, {time}{batch})"

    def simulate(
        self, *, u: Numbers, x0: Numbers | None = None, dt: float | None = None
    ) -> Float[Array, "*batch time ny"]:
        """Response to an input.

        Args:
            u: input (time, nu), or (time,) for one input; leading axes are a batch.
            x0: first state (nx,), with any batch axes; zero when left out.
            dt: sample time in seconds of `u`; needed for a continuous-time model, which is
                converted by a zero-order hold first.

        Returns:
            Output (time, ny), with the batch axes in front.

        Raises:
            ValueError: shapes do not fit, or the sample time is missing or contradicts the model's.

        Example:
            >>> import numpy as np
            >>> from lpvid.models import StateSpace
            >>> StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1).simulate(u=np.ones(3))[:, 0].tolist()
            [0.0, 1.0, 1.5]
        """
        system, u, x0 = self._prepared(u, x0, dt)
        return simulate_lti(system.A, system.B, system.C, system.D, u=u, x0=x0)

    def simulate_states(
        self, *, u: Numbers, x0: Numbers | None = None, dt: float | None = None
    ) -> Float[Array, "*batch time nx"]:
        """States (time, nx) at the sample instants; arguments and errors as for `simulate`."""
        system, u, x0 = self._prepared(u, x0, dt)
        identity, nothing = jnp.eye(self.nx), jnp.zeros((self.nx, self.nu))
        return simulate_lti(system.A, system.B, identity, nothing, u=u, x0=x0)

    def _prepared(
        self, u: Numbers, x0: Numbers | None, dt: float | None
    ) -> tuple["StateSpace", Array, Array]:
        system = self._at_sample_time(dt)
        u = jnp.asarray(u, float)
        if u.ndim == 1 and self.nu == 1:
            u = u[:, None]
        if u.ndim < 2 or u.shape[-1] != self.nu:
            raise ValueError(
                f"u has shape {u.shape}; the model has {self.nu} inputs, so (time, {self.nu}) is "
                f"needed, time first."
            )
        x0 = jnp.zeros(self.nx) if x0 is None else jnp.asarray(x0, float)
        if x0.ndim < 1 or x0.shape[-1] != self.nx:
            raise ValueError(f"x0 has shape {x0.shape}; the model has {self.nx} states.")
        return system, u, x0

    def _at_sample_time(self, dt: float | None) -> "StateSpace":
        if self.is_discrete:
            if dt is not None and not math.isclose(dt, self.dt, rel_tol=1e-9):
                raise ValueError(
                    f"dt is {dt} s, the model's sample time {self.dt} s; leave dt out, or convert "
                    f"the model with to_continuous() first."
                )
            return self
        if dt is None:
            raise ValueError("The model is in continuous time: give the sample time dt of u.")
        return self.discretise(dt)

    def frequency_response(self, omega: Numbers) -> Complex[Array, "*batch frequency ny nu"]:
        """Transfer matrix at the angular frequencies `omega` (rad/s)."""
        omega = jnp.atleast_1d(jnp.asarray(omega, float))
        if self.is_discrete:
            points = jax.lax.complex(jnp.cos(omega * self.dt), jnp.sin(omega * self.dt))
        else:
            points = jax.lax.complex(jnp.zeros_like(omega), omega)
        return transfer(self.A, self.B, self.C, self.D, points)

    def poles(self) -> Complex[Array, "*batch nx"]:
        """Eigenvalues of A (in z for a discrete-time model)."""
        return jnp.linalg.eigvals(self.A)

    def is_stable(self) -> Bool[Array, "*batch"]:
        """Whether all poles lie strictly inside the stability region."""
        poles = self.poles()
        return jnp.all(jnp.abs(poles) < 1.0 if self.is_discrete else poles.real < 0.0, axis=-1)

    def modes(self) -> Modes:
        """Natural frequencies, damping ratios and poles s = log(z)/dt, sorted by frequency."""
        poles = self.poles()
        poles = jnp.log(poles) / self.dt if self.is_discrete else poles
        poles = jnp.take_along_axis(poles, jnp.argsort(jnp.abs(poles), axis=-1), axis=-1)
        frequency = jnp.abs(poles)
        moves = frequency > 0.0
        damping = jnp.where(moves, -poles.real / jnp.where(moves, frequency, 1.0), 1.0)
        return Modes(frequency, damping, poles)

    def dc_gain(self) -> Float[Array, "*batch ny nu"]:
        """Transfer matrix at frequency zero; not finite for a model with an integrator."""
        identity = jnp.broadcast_to(jnp.eye(self.nx), self.A.shape)
        shifted = identity - self.A if self.is_discrete else -self.A
        return self.C @ jnp.linalg.solve(shifted, self.B) + self.D

    def discretise(self, dt: float, method: AbstractConversion | None = None) -> "StateSpace":
        """Discrete-time model with sample time `dt` in seconds (zero-order hold by default)."""
        if self.is_discrete:
            raise ValueError(
                f"The model is in discrete time already (dt = {self.dt} s); to resample it use "
                f"to_continuous() first."
            )
        if not (float(dt) > 0.0 and math.isfinite(dt)):
            raise ValueError(f"dt is {dt}; the sample time must be a positive number of seconds.")
        method = ZeroOrderHold() if method is None else method
        return StateSpace(*method.discretise(self.A, self.B, self.C, self.D, float(dt)), dt=dt)

    def to_continuous(self, method: AbstractConversion | None = None) -> "StateSpace":
        """Continuous-time model (zero-order hold by default)."""
        if not self.is_discrete:
            raise ValueError("The model is in continuous time already.")
        method = ZeroOrderHold() if method is None else method
        return StateSpace(*method.to_continuous(self.A, self.B, self.C, self.D, self.dt))

    def transform(self, T: Numbers) -> "StateSpace":
        """The same model in the states T x: (T A T⁻¹, T B, C T⁻¹, D)."""
        T = _matrix("T", T)
        if T.shape[-2:] != (self.nx, self.nx):
            raise ValueError(f"T has shape {T.shape}; ({self.nx}, {self.nx}) is needed.")
        T, A, C = _common_batch(T, self.A, self.C)
        solved = jnp.linalg.solve(T.mT, _join((T @ A).mT, C.mT, axis=-1)).mT
        return StateSpace(
            solved[..., : self.nx, :], T @ self.B, solved[..., self.nx :, :], self.D, dt=self.dt
        )

    def _check_partner(self, other: "StateSpace", operation: str) -> None:
        if not math.isclose(self.dt, other.dt, rel_tol=1e-9):
            raise ValueError(
                f"Cannot {operation} models with dt = {self.dt} s and {other.dt} s: convert one of "
                f"them with discretise() or to_continuous()."
            )

    def __neg__(self) -> "StateSpace":
        return StateSpace(self.A, self.B, -self.C, -self.D, dt=self.dt)

    def __add__(self, other: "StateSpace") -> "StateSpace":
        if not isinstance(other, StateSpace):
            return NotImplemented
        self._check_partner(other, "add")
        if (self.ny, self.nu) != (other.ny, other.nu):
            raise ValueError(
                f"Cannot add models of {self.ny} × {self.nu} and {other.ny} × {other.nu} channels."
            )
        return StateSpace(
            _block_diagonal(self.A, other.A),
            _join(self.B, other.B, axis=-2),
            _join(self.C, other.C, axis=-1),
            sum(_common_batch(self.D, other.D)),
            dt=self.dt,
        )

    def __sub__(self, other: "StateSpace") -> "StateSpace":
        if not isinstance(other, StateSpace):
            return NotImplemented
        return self + (-other)

    def __matmul__(self, other: "StateSpace") -> "StateSpace":
        """Series connection: the input passes `other` first, as in the matrix product."""
        if not isinstance(other, StateSpace):
            return NotImplemented
        self._check_partner(other, "connect")
        if self.nu != other.ny:
            raise ValueError(
                f"Cannot connect: the first model has {other.ny} outputs, the second "
                f"{self.nu} inputs."
            )
        # States of `other` first; its output drives the states of this model.
        coupling = self.B @ other.C
        above = jnp.zeros((*coupling.shape[:-2], other.nx, other.nx + self.nx))
        beside = jnp.zeros((*coupling.shape[:-2], self.nx, self.nx))
        corner = _join(above, _join(coupling, beside, axis=-1), axis=-2)
        return StateSpace(
            sum(_common_batch(_block_diagonal(other.A, self.A), corner)),
            _join(other.B, self.B @ other.D, axis=-2),
            _join(self.D @ other.C, self.C, axis=-1),
            self.D @ other.D,
            dt=self.dt,
        )
