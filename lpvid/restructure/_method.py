"""Options of the stages."""

import equinox as eqx


class HinfMatching(eqx.Module):
    """How to restructure: least squares, L-BFGS on smooth surrogates, a non-smooth bundle.

    Attributes:
        frequencies: size of the logarithmic grid (the poles' frequencies are added to it).
        match_steps: Levenberg–Marquardt steps from each start.
        log2_powers: exponents of the surrogate, round after round, as powers of two.
        descent_steps: L-BFGS steps of each round.
        passes: how often the rounds are gone through, each time with the exact peak added; 0
            leaves them out.
        bundle_steps: limit on the trials of the non-smooth stage, which ends at a certified point;
            0 leaves it out, and the result without a certificate.
        tolerance: of the certificate: to first order, no step that changes the response by as much
            as the error that is left lowers the norm by more than this share.

    Raises:
        ValueError: a count is too small, the tolerance out of range, or there is no exponent.

    Example:
        >>> HinfMatching(passes=0).match_steps
        80
    """

    frequencies: int = eqx.field(static=True, default=60)
    match_steps: int = eqx.field(static=True, default=80)
    log2_powers: tuple[int, ...] = eqx.field(static=True, default=(1, 3, 5, 7))
    descent_steps: int = eqx.field(static=True, default=60)
    passes: int = eqx.field(static=True, default=1)
    bundle_steps: int = eqx.field(static=True, default=150)
    tolerance: float = eqx.field(static=True, default=1e-4)

    def __check_init__(self):
        for name in ("frequencies", "match_steps", "descent_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: at least 1 is needed, got {getattr(self, name)}.")
        for name in ("passes", "bundle_steps"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: a number from 0 is needed, got {getattr(self, name)}.")
        if not 1e-7 <= self.tolerance <= 0.1:
            raise ValueError(
                f"tolerance: the certificate's, between 1e-7 and 0.1; got {self.tolerance}."
            )
        if not self.log2_powers or min(self.log2_powers) < 0:
            raise ValueError(f"log2_powers: numbers from 0 are needed, got {self.log2_powers}.")
