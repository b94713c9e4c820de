"""Environments behind one protocol (``madviz.types.Environment``): Meta-World on MuJoCo, ManiSkill
on SAPIEN, a toy drawn with NumPy, and a user's own. ``registry.make_env`` builds each of them."""
