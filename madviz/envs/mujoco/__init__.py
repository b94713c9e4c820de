"""What all tasks on MuJoCo share."""
