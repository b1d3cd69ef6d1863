"""From symbolic residual to compiled kernel: lowering, generated modules, the cache of both."""
