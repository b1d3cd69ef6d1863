"""Update of a map with new sessions: evidence, existence of landmarks, budgets."""
