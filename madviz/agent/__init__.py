"""The learner: networks, merges, augmentation, objectives, and the policy that acts from them."""
