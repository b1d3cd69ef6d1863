"""The least-squares problem of motion segments and its solution."""
