"""State-space models, their simulation, conversion and structured parameterisations."""

from lpvid.models._state_space import StateSpace as StateSpace
