"""ManiSkill3 on SAPIEN."""
