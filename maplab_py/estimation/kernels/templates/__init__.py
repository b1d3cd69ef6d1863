"""Kernels that are compiled together with a generated residual function (see `codegen.modules`)."""
