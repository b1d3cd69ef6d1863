"""Size of factors, and the error of matrices that have none."""

from maplab_py.errors import EstimationError
from maplab_py.report import Report


class NotPositiveDefinite(EstimationError):
    """The matrix has a pivot that is not positive; `node` is the block row where it showed."""

    def __init__(self, node: int) -> None:
        super().__init__(f"the matrix is not positive definite at node {node}")
        self.node = node


class FactorStatistics(Report):
    """Size and cost of a factorisation."""

    num_nodes: int
    node_size: int
    nonzeros: int  # stored numbers of the factor
    flops: float  # of one numeric factorisation
    supernodes: int
    largest_front: int  # rows of the largest dense matrix
