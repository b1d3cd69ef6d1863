"""Terms of the plugin residuals that `--ba_residuals` names."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.vi_optimization.data_selection import Selection
from maplab_py.algorithms.vi_optimization.options import DataOptions
from maplab_py.errors import UserError
from maplab_py.estimation.terms.extension import REGISTERED, ExpressionTerm, ResidualRows
from maplab_py.progress import Progress
from maplab_py.vimap import VIMap


def extension_terms(
    vi_map: VIMap, selection: Selection, options: DataOptions, progress: Progress
) -> list[ExpressionTerm]:
    """Return the terms of measurements at the selected vertices.

    Raises:
        UserError: There is no residual of that name, or its rows do not fit.
    """
    terms = []
    for name in filter(None, (part.strip() for part in options.residuals.split(","))):
        if name not in REGISTERED:
            known = ", ".join(sorted(REGISTERED)) or "none"
            raise UserError(
                f"--ba_residuals: no plugin has a residual '{name}'; there are: {known}"
            )
        definition = REGISTERED[name]
        rows = definition.rows_of(vi_map)
        vertices = selection.rows(rows.vertices)
        inside = (vertices >= 0).all(axis=1)
        if not inside.any():
            continue
        sigma = np.asarray(rows.sigma, dtype=np.float64)
        if sigma.ndim == 2:
            sigma = sigma[inside]
        chosen = ResidualRows(vertices[inside], rows.data[inside], sigma)
        terms.append(ExpressionTerm(definition, definition.kernel(progress), chosen))
    return terms
