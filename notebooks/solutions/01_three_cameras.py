# %% [markdown]
# # Solution 1: three copies of the newest picture

# %%
import numpy as np

import madviz
from madviz import teaching
from madviz.teaching.show import table

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-light")
now = teaching.moment_at(policy, seed=2000, step=20)
still = np.tile(now.stack[:, -3:], (1, 3, 1, 1))
everything = np.ones((1, 3), bool)
action = policy.read(policy.encode(still, now.state), everything).action[0]
rows = [
    ["nothing moves in the pictures", float(np.linalg.norm(action - now.action()))],
    ["Third A dropped", float(np.linalg.norm(now.action("first+third_b") - now.action()))],
]
table(["what was changed", "distance of the action"], rows)

# %% [markdown]
# The two are of the same kind: both take something away that the policy is used to. Motion is
# also in the 24 numbers of the robot itself (its hand now and one simulator step before, for
# three frames), so the pictures are not its only source of it.
