"""Shaped aliases used in annotations; the tests enforce them, the user's run does not."""

from typing import TypeAlias

from jaxtyping import Array, Bool, Complex, Float, Int

Scalar: TypeAlias = Float[Array, ""]
Signal: TypeAlias = Float[Array, "time channel"]
Schedule: TypeAlias = Float[Array, "time scheduling"]
Vector: TypeAlias = Float[Array, " entry"]
Matrix: TypeAlias = Float[Array, "row column"]
ComplexMatrix: TypeAlias = Complex[Array, "row column"]
Response: TypeAlias = Complex[Array, "frequency output input"]

__all__ = [
    "Array",
    "Bool",
    "Complex",
    "ComplexMatrix",
    "Float",
    "Int",
    "Matrix",
    "Response",
    "Scalar",
    "Schedule",
    "Signal",
    "Vector",
]
