"""Modal structure: frequencies, dampings and shapes, for plants without first principles."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load when first used
from jaxtyping import Array, PRNGKeyArray

from lpvid.models._state_space import StateSpace
from lpvid.models._structures import AbstractStructure, Parameters, Starts

# Damping ratio that stands in for a mode found unstable.
_LEAST_DAMPING = 1e-4


class ModalStructure(AbstractStructure):
    """Second-order modes, each with frequency, damping and free input and output shapes.

    Mode k has the block A_k = [[0, ω_k], [−ω_k, −2 ζ_k ω_k]], the input rows [0, 1] in the column
    of the reference input (which fixes the basis), free input rows in the other columns, and two
    free columns in C: ω (c₁ s' + c₂)-shaped residues of any phase, so that every stable minimal
    model of even order with simple poles, all of them excited by the reference input, can be
    written this way. The states are scaled so that displacement-like and velocity-like entries
    have one size.

    ϑ holds, mode after mode: log ω_k (ω in rad/s), log ζ_k, the 2·n_outputs entries of C, the
    2·(n_inputs − 1) free entries of B; last the entries of D if there is `feedthrough`. Starts
    list the modes by rising frequency. With the logarithms every ϑ is a stable model, also
    between and beyond the points of an interpolation; damping above one stands for two real
    poles.

    Attributes:
        n_modes: second-order modes.
        n_inputs: number of inputs.
        n_outputs: number of outputs.
        feedthrough: whether D is free; zero otherwise.
        reference_input: the input whose column of B is fixed.

    Raises:
        ValueError: there is no mode, or `reference_input` is not one of the inputs.

    Example:
        >>> ModalStructure(n_modes=1, n_inputs=1, n_outputs=1).parameter_names
        ('mode 1 log frequency', 'mode 1 log damping', 'mode 1 C[0,0]', 'mode 1 C[0,1]')
    """

    n_modes: int = eqx.field(static=True)
    n_inputs: int = eqx.field(static=True)
    n_outputs: int = eqx.field(static=True)
    feedthrough: bool = eqx.field(static=True, default=False)
    reference_input: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.n_modes < 1:
            raise ValueError("n_modes: at least one mode is needed.")
        if not 0 <= self.reference_input < self.n_inputs:
            raise ValueError(
                f"reference_input: {self.reference_input} is not one of {self.n_inputs} inputs."
            )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names such as `mode 1 log frequency` and `mode 1 C[0,1]`."""
        names = []
        others = [j for j in range(self.n_inputs) if j != self.reference_input]
        for mode in range(1, self.n_modes + 1):
            names += [f"mode {mode} log frequency", f"mode {mode} log damping"]
            names += [f"mode {mode} C[{k},{s}]" for k in range(self.n_outputs) for s in (0, 1)]
            names += [f"mode {mode} B[{s},{j}]" for s in (0, 1) for j in others]
        if self.feedthrough:
            names += [f"D[{k},{j}]" for k in range(self.n_outputs) for j in range(self.n_inputs)]
        return tuple(names)

    @property
    def _per_mode(self) -> int:
        return 2 + 2 * self.n_outputs + 2 * (self.n_inputs - 1)

    def split(self, parameters: Parameters) -> tuple[Array, Array, Array, Array, Array]:
        """ϑ as frequencies (rad/s), damping ratios, C blocks, free B blocks (each mode) and D."""
        count = self.n_modes * self._per_mode
        modes = parameters[:count].reshape(self.n_modes, self._per_mode)
        shapes = modes[:, 2 : 2 + 2 * self.n_outputs].reshape(self.n_modes, self.n_outputs, 2)
        inputs = modes[:, 2 + 2 * self.n_outputs :].reshape(self.n_modes, 2, self.n_inputs - 1)
        direct = (
            parameters[count:] if self.feedthrough else jnp.zeros(self.n_outputs * self.n_inputs)
        )
        frequency, damping = jnp.exp(modes[:, 0]), jnp.exp(modes[:, 1])
        return frequency, damping, shapes, inputs, direct.reshape(self.n_outputs, -1)

    def matrices(self, parameters: Parameters) -> StateSpace:
        """Block-diagonal model of order 2·n_modes."""
        frequency, damping, shapes, inputs, direct = self.split(parameters)
        nx = 2 * self.n_modes
        upper, lower = jnp.arange(0, nx, 2), jnp.arange(1, nx, 2)
        A = jnp.zeros((nx, nx))
        A = A.at[upper, lower].set(frequency).at[lower, upper].set(-frequency)
        A = A.at[lower, lower].set(-2.0 * damping * frequency)
        reference = jnp.tile(jnp.array([[0.0], [1.0]]), (self.n_modes, 1))
        free = inputs.reshape(nx, self.n_inputs - 1)
        r = self.reference_input
        B = jnp.concatenate([free[:, :r], reference, free[:, r:]], axis=1)
        C = jnp.moveaxis(shapes, 0, 1).reshape(self.n_outputs, nx)
        return StateSpace(A, B, C, direct)

    def parameters_of(self, model: StateSpace) -> Parameters:
        """ϑ of a continuous-time model of order 2·n_modes, from its eigenvectors (eager).

        Real poles are paired from the slowest. An unstable mode is given a small positive damping:
        the structure holds stable models only. Needs simple poles.

        Raises:
            ValueError: order or channels differ, a pole lies at zero, or the reference input
                leaves a mode unexcited.
        """
        nx = 2 * self.n_modes
        if model.nx != nx or model.dt != 0:
            raise ValueError(
                f"model: a continuous-time model of order {nx} is needed, got order {model.nx} "
                f"and dt={model.dt}; identify with order={nx} and convert with d2c."
            )
        if (model.nu, model.ny) != (self.n_inputs, self.n_outputs):
            raise ValueError(
                f"model: {self.n_inputs} inputs and {self.n_outputs} outputs are needed, got "
                f"{model.nu} and {model.ny}."
            )
        poles, vectors = np.linalg.eig(np.asarray(model.A))
        rows = np.linalg.solve(vectors, np.asarray(model.B, complex))
        columns = np.asarray(model.C) @ vectors
        blocks = []
        for pair in _pole_pairs(poles):
            blocks.append(self._block(poles[pair], rows[pair], columns[:, pair]))
        blocks.sort(key=lambda block: block[0])
        direct = np.asarray(model.D).ravel() if self.feedthrough else np.zeros(0)
        return jnp.asarray(np.concatenate([*blocks, direct]))

    def _block(self, poles, rows, columns) -> np.ndarray:
        frequency = float(np.sqrt(np.abs(poles[0] * poles[1])))
        if frequency == 0.0:
            raise ValueError("model: a pole at zero has no frequency; remove the integrator first.")
        damping = max(float(-np.real(poles[0] + poles[1]) / (2 * frequency)), _LEAST_DAMPING)
        A = np.array([[0, frequency], [-frequency, -2 * damping * frequency]])
        # The same pair of poles in the structure's basis: B = T [0, 1]' there fixes T, as T
        # commutes with A up to two free numbers, one for each pole.
        target_poles, target_vectors = np.linalg.eig(A.astype(complex))
        order = np.argmin(np.abs(target_poles[:, None] - poles[None]), axis=1)
        if sorted(order) != [0, 1]:
            order = np.array([0, 1])
        target = np.linalg.solve(target_vectors, np.array([0.0, 1.0]))
        r = self.reference_input
        reference = rows[order, r]
        if np.min(np.abs(reference)) < 1e-12 * max(np.max(np.abs(rows)), 1e-300):
            raise ValueError(
                f"reference_input: input {r} does not excite the mode at {frequency:.4g} rad/s; "
                "take another reference input."
            )
        gain = reference / target
        C = np.real((columns[:, order] * gain[None]) @ np.linalg.inv(target_vectors))
        others = [j for j in range(self.n_inputs) if j != r]
        B = np.real(target_vectors @ (rows[order][:, others] / gain[:, None]))
        return np.concatenate([[np.log(frequency), np.log(damping)], C.ravel(), B.ravel()])

    def align(self, parameters: Parameters, neighbour: Parameters) -> Parameters:
        """The modes in the order of a neighbour's: by frequency, damping and shape (eager).

        Sorted by frequency alone, modes that cross between two points would change places.
        """
        count = self.n_modes * self._per_mode
        modes = np.asarray(parameters[:count]).reshape(self.n_modes, self._per_mode)
        others = np.asarray(neighbour[:count]).reshape(self.n_modes, self._per_mode)
        shapes, other_shapes = modes[:, 2:], others[:, 2:]
        size = np.linalg.norm(shapes, axis=1)[:, None]
        size = size + np.linalg.norm(other_shapes, axis=1)[None] + np.finfo(float).tiny
        apart = np.linalg.norm(shapes[:, None] - other_shapes[None], axis=2) / size
        frequency = np.abs(modes[:, None, 0] - others[None, :, 0])
        damping = np.abs(modes[:, None, 1] - others[None, :, 1])
        rows, columns = scipy.optimize.linear_sum_assignment(frequency + 0.1 * damping + apart)
        order = rows[np.argsort(columns)]
        return jnp.concatenate([jnp.asarray(modes[order].reshape(-1)), parameters[count:]])

    def starts(self, key: PRNGKeyArray, count: int, black_box: StateSpace) -> Starts:
        """The black box's own modes (reduced to the strongest n_modes), then scatter about them."""
        best = self.parameters_of(self._strongest(black_box))
        scatter = 0.1 * jax.random.normal(key, (count, self.n_parameters)).at[0].set(0.0)
        logarithmic = np.zeros(self.n_parameters, bool)
        first = np.arange(self.n_modes) * self._per_mode
        logarithmic[first] = logarithmic[first + 1] = True
        # Frequencies are known far better than dampings and shapes.
        scatter = scatter.at[:, first].multiply(0.1).at[:, first + 1].multiply(5.0)
        return best[None] + jnp.where(jnp.asarray(logarithmic)[None], 1.0, best[None]) * scatter

    def _strongest(self, model: StateSpace) -> StateSpace:
        if model.nx == 2 * self.n_modes:
            return model
        poles, vectors = np.linalg.eig(np.asarray(model.A))
        rows = np.linalg.solve(vectors, np.asarray(model.B, complex))
        columns = np.asarray(model.C) @ vectors
        pairs = _pole_pairs(poles)
        if len(pairs) < self.n_modes:
            raise ValueError(
                f"black_box: order {model.nx} has {len(pairs)} modes, the structure "
                f"{self.n_modes}; identify with a higher order or lower n_modes."
            )

        def peak(pair):
            at = 1j * np.sqrt(abs(np.prod(poles[pair])))
            response = (columns[:, pair] / (at - poles[pair])[None]) @ rows[pair]
            return -np.linalg.norm(response)

        keep = np.concatenate(sorted(pairs, key=peak)[: self.n_modes])
        # Real coordinates for the kept pairs: columns Re and Im of the eigenvectors.
        A = np.diag(poles[keep])
        T = np.zeros((len(keep), len(keep)), complex)
        for k in range(0, len(keep), 2):
            complex_pair = np.imag(poles[keep[k]]) != 0
            T[k : k + 2, k : k + 2] = [[1, 1j], [1, -1j]] if complex_pair else np.eye(2)
        inverse = np.linalg.inv(T)
        return StateSpace(
            np.real(inverse @ A @ T),
            np.real(inverse @ rows[keep]),
            np.real(columns[:, keep] @ T),
            model.D,
        )


def _pole_pairs(poles: np.ndarray) -> list[np.ndarray]:
    """Conjugate pairs, and real poles two by two from the slowest; an odd one is left out."""
    upper = [k for k in range(len(poles)) if poles[k].imag > 0]
    pairs = []
    for k in upper:
        partner = int(np.argmin(np.abs(poles - np.conj(poles[k]))))
        pairs.append(np.array([k, partner]))
    real = sorted(
        (k for k in range(len(poles)) if poles[k].imag == 0), key=lambda k: -poles[k].real
    )
    pairs += [np.array(real[k : k + 2]) for k in range(0, len(real) - 1, 2)]
    return pairs
