"""The flexible-manipulator thesis (002) end to end: identify, reduce, validate, control."""
