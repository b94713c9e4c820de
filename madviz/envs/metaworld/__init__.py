"""Meta-World v3 on MuJoCo."""
