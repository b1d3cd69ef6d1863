"""Rotations, rigid motions, alignment, triangulation and interpolation on arrays.

Conventions used in the whole project:

- Quaternions are [x y z w], Hamilton, unit; `q_A_B` rotates vectors from B to A.
- Poses are rows [qx qy qz qw px py pz] of T_A_B: ``p_A = R(q) p_B + p``.
- Perturbations act on the right: ``R <- R exp(d)``, ``p <- p + d``; a pose tangent is
  [dp (3), dtheta (3)], position first, as the covariances of the map format.
- All functions take and return arrays with any number of leading batch axes.
"""
