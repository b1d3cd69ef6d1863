"""Cost terms: residuals and Jacobians of one kind of measurement each."""
