"""restructure."""
