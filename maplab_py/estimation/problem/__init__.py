"""The least-squares problem, its solver, gauge and marginal covariances."""
