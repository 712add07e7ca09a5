"""The order of the stages, and where a run keeps what it makes."""
