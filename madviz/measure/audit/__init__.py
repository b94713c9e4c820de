"""Does a policy use its cameras? Every camera removed and alone, and what that says."""
