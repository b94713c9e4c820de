"""What trainings of all recipes share: data, run folders, evaluation, state to go on from."""
