"""Hand-written compiled kernels, and the templates of generated ones."""
