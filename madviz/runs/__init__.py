"""Shared by trainings of all recipes: data, run folders, evaluation, state to go on from."""
