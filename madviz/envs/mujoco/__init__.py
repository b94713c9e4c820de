"""Code that all tasks on MuJoCo share."""
