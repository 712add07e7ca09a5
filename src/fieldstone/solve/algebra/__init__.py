"""Small algebra, compiled: what the solvers stand on."""
