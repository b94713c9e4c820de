"""How policies are trained: recipes, and what they learn from."""
